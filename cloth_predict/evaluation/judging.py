"""Which of what methods said of a recording is counted, and how wrong it was."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from cloth_predict.errors import FormatError
from cloth_predict.evaluation.bootstrap import Part
from cloth_predict.evaluation.cases import Reference
from cloth_predict.evaluation.runs import Run
from cloth_predict.metrics import at_times, distances, speeds
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.types import BoolArray, FloatArray, IntArray

WARM_UP = 1.0
"""Seconds at the start that are not judged."""
BLOCK = 0.5
"""Seconds of frames that the bootstrap keeps together: longer than errors remember, and short
enough that a few seconds have several."""
FEWEST = 0.95
"""Share of the predictions of the most complete method from which on a method is compared on the
same frames and markers as the others. One that predicts less would take the hard ones away from
them; it is judged by its own, and marked."""


@dataclass(frozen=True)
class Answers:
    """What a method said after the frames that are counted, and how wrong it was.

    predicted, sigma, nis, nees and counts as in `Run`; errors [m], shape (frames, markers), NaN
    where not counted; known: number of predictions where one was asked for; complete: whether they
    are enough to be counted on the same frames and markers as the others; seconds: what it took.
    """

    predicted: FloatArray
    sigma: FloatArray
    nis: FloatArray
    nees: FloatArray
    errors: FloatArray
    known: int
    complete: bool
    seconds: float
    counts: Counter[str]

    @classmethod
    def of(
        cls, run: Run, rows: BoolArray, errors: FloatArray, known: int, complete: bool
    ) -> Answers:
        """Return what was said after the frames of `rows`, shape (frames,)."""
        return cls(
            run.position[rows],
            run.sigma[rows],
            run.nis[rows],
            run.nees[rows],
            errors,
            known,
            complete,
            run.seconds,
            Counter(run.counts),
        )

    @classmethod
    def joined(cls, answers: Sequence[Answers]) -> Answers:
        """Put the answers for several recordings after each other."""
        return cls(
            np.concatenate([one.predicted for one in answers]),
            np.concatenate([one.sigma for one in answers]),
            np.concatenate([one.nis for one in answers]),
            np.concatenate([one.nees for one in answers]),
            np.concatenate([one.errors for one in answers]),
            sum(one.known for one in answers),
            all(one.complete for one in answers),
            sum(one.seconds for one in answers),
            sum((one.counts for one in answers), Counter()),
        )


@dataclass(frozen=True)
class Judged:
    """What is counted of one recording, or of several after each other, at one horizon.

    start [ns]: the first stamp; targets [ns], shape (frames,): the times predicted for;
    actual [m], (frames, markers, 3), speed [m/s], (frames, markers), and noise [m], (frames,), of
    a coordinate of `actual`; answers, by method; asked: number of predictions that were to be
    made; given: number of frames that were given; lengths: frames counted of each recording;
    blocks: frames in each of its blocks; surface: whether what is predicted is the nearest place
    of a surface (`Reference.surface`).
    """

    start: int
    targets: IntArray
    actual: FloatArray
    speed: FloatArray
    noise: FloatArray
    answers: dict[str, Answers]
    asked: int
    given: int
    lengths: tuple[int, ...]
    blocks: tuple[int, ...]
    surface: bool = False

    def parts(self, method: str) -> list[Part]:
        """Errors of each recording, and frames of its blocks."""
        errors = np.split(self.answers[method].errors, np.cumsum(self.lengths)[:-1])
        return list(zip(errors, self.blocks, strict=True))

    def share(self, method: str) -> float:
        """Share of what was to be predicted that was."""
        return self.answers[method].known / self.asked

    @classmethod
    def joined(cls, judged: Sequence[Judged]) -> Judged:
        """Put what is counted of several recordings after each other."""
        return cls(
            judged[0].start,
            np.concatenate([one.targets for one in judged]),
            np.concatenate([one.actual for one in judged]),
            np.concatenate([one.speed for one in judged]),
            np.concatenate([one.noise for one in judged]),
            {
                name: Answers.joined([one.answers[name] for one in judged])
                for name in judged[0].answers
            },
            sum(one.asked for one in judged),
            sum(one.given for one in judged),
            tuple(length for one in judged for length in one.lengths),
            tuple(block for one in judged for block in one.blocks),
            judged[0].surface,
        )


def asked_at(
    stamps: IntArray, horizon: float, reference: Reference
) -> tuple[FloatArray, BoolArray]:
    """What is to be predicted at `stamps` [ns]: positions [m], (frames, markers, 3), and which.

    These are the markers that the reference shows `horizon` [s] later, after the warm-up.
    """
    actual, asked = at_times(reference.markers, stamps + round(horizon * NANOSECONDS))
    return actual, asked & (stamps >= stamps[0] + WARM_UP * NANOSECONDS)[:, None]


def judge(
    stamps: IntArray,
    horizon: float,
    reference: Reference,
    runs: Mapping[str, Run],
    source: str = 'the recording',
) -> Judged:
    """Compare what methods said after the frames at `stamps` [ns], which increase, with what was.

    Counted is what the reference shows after the warm-up and every method predicted; of a method
    that predicted less than `FEWEST`, which has no say in this, what it predicted of it.
    Raises FormatError naming the source where nothing is.
    """
    targets = stamps + round(horizon * NANOSECONDS)
    actual, asked = asked_at(stamps, horizon, reference)
    known = {name: np.isfinite(run.position).all(axis=-1) & asked for name, run in runs.items()}
    common, complete = _common(known)
    rows = np.asarray(common.any(axis=1), bool)
    if not rows.any():
        reasons = [run.reason for run in runs.values() if run.reason and asked.any()]
        raise FormatError(f'{source}: {[*reasons, _why_nothing(stamps, horizon)][0]}')
    actual, targets = actual[rows], targets[rows]
    interval = int(np.median(np.diff(stamps)))
    answers = {}
    for name, run in runs.items():
        wrong = np.where(common[rows], distances(run.position[rows], actual), nan)
        count = int(known[name].sum())
        answers[name] = Answers.of(run, rows, wrong, count, name in complete)
    return Judged(
        int(stamps[0]),
        targets,
        actual,
        speeds(reference.markers, targets, interval),
        np.full(len(targets), reference.noise),
        answers,
        int(asked.sum()),
        len(stamps),
        (len(targets),),
        (max(round(BLOCK * NANOSECONDS / interval), 1),),
        reference.surface,
    )


def _common(known: Mapping[str, BoolArray]) -> tuple[BoolArray, set[str]]:
    """What every complete method predicted, shape (frames, markers), and which methods are."""
    most = max(int(mask.sum()) for mask in known.values())
    complete = {name for name, mask in known.items() if mask.sum() >= FEWEST * most}
    return np.logical_and.reduce([known[name] for name in complete]), complete


def _why_nothing(stamps: IntArray, horizon: float) -> str:
    seconds = (stamps[-1] - stamps[0]) / NANOSECONDS
    return (
        f'no frame can be judged: the recording lasts {seconds:.2f} s, of which the first '
        f'{WARM_UP} s are the warm-up and the last {horizon} s have no later measurement'
    )
