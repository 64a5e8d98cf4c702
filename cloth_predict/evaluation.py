"""Compares predictors on one recording: the same frames and markers for every method."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import isnan, nan
from typing import Any

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.metrics import (
    Details,
    Score,
    at_times,
    by_speed,
    coverage,
    distances,
    mean,
    score,
    speeds,
)
from cloth_predict.predictors import METHODS, Predictor
from cloth_predict.tracker import NANOSECONDS
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

WARM_UP = 1.0
"""Seconds at the start that are not judged."""
BLOCK = 0.5
"""Seconds of frames that the bootstrap keeps together: longer than errors remember, and short
enough that a few seconds have several."""
SEED = 0
"""Of the bootstrap; the same frames are drawn for every method."""


@dataclass(frozen=True)
class Run:
    """What a method said of a whole recording, after each frame.

    position [m], shape (frames, markers, 3); sigma [m], shape (frames, markers); nis, shape
    (frames,), per degree of freedom; NaN where unknown. seconds: what it took.
    """

    position: FloatArray
    sigma: FloatArray
    nis: FloatArray
    seconds: float

    def at(self, frames: BoolArray) -> Run:
        """Return what was said after these frames."""
        return replace(
            self, position=self.position[frames], sigma=self.sigma[frames], nis=self.nis[frames]
        )


@dataclass(frozen=True)
class Evaluation:
    """The comparison at one horizon.

    start [ns]: the first stamp of the recording; errors [m] by method, shape (frames, markers),
    NaN where not counted; targets [ns], shape (frames,): the times predicted for;
    actual [m] and predicted [m] by method, each (frames, markers, 3).
    """

    horizon: float
    scores: dict[str, Score]
    details: dict[str, Details]
    us_per_frame: dict[str, float]
    errors: dict[str, FloatArray]
    start: int
    targets: IntArray
    actual: FloatArray
    predicted: dict[str, FloatArray]

    def summary(self) -> dict[str, object]:
        """Return the numbers as `evaluate --json` prints them."""
        return {
            'horizon_s': self.horizon,
            'frames': len(self.targets),
            'methods': {
                name: {
                    **_plain(asdict(found)),
                    'us_per_frame': self.us_per_frame[name],
                    **_plain(asdict(self.details[name])),
                }
                for name, found in self.scores.items()
            },
        }


def _plain(value: Any) -> Any:
    """Return what JSON can hold: NaN becomes None, a tuple a list."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and isnan(value) else value


def evaluate(
    markers: MarkerSequence,
    config: Config,
    horizon: float,
    reference: MarkerSequence | None = None,
    methods: dict[str, Callable[[Config], Predictor]] | None = None,
    progress: Callable[[int], None] = lambda frames: None,
    source: str = 'the recording',
) -> Evaluation:
    """Run every method over the recording and judge its predictions `horizon` [s] ahead.

    The reference is what the positions are compared with: the truth where there is one, or else
    the markers themselves. Markers must be in node order.
    """
    markers = in_order(markers)
    runs = {
        name: predict_all(make(config), markers, horizon, progress)
        for name, make in (METHODS if methods is None else methods).items()
    }
    return judge(markers, config, horizon, reference, runs, source)


def judge(
    markers: MarkerSequence,
    config: Config,
    horizon: float,
    reference: MarkerSequence | None,
    runs: dict[str, Run],
    source: str = 'the recording',
) -> Evaluation:
    """Compare what methods said after each frame of `markers` with a reference, the truth.

    None of it means the markers themselves. Only what every method predicted and the reference
    shows is counted. Raises FormatError naming the source where that is nothing.
    """
    shown = markers if reference is None else reference
    targets = markers.stamps + round(horizon * NANOSECONDS)
    actual, counted = _counted(markers, shown, targets, runs)
    judged = np.asarray(counted.any(axis=1), bool)
    if not judged.any():
        raise FormatError(f'{source}: {_why_nothing(markers, horizon)}')
    targets, actual, counted = targets[judged], actual[judged], counted[judged]
    runs = {name: run.at(judged) for name, run in runs.items()}
    errors = {
        name: np.where(counted, distances(run.position, actual), nan) for name, run in runs.items()
    }
    interval = int(np.median(np.diff(markers.stamps)))
    free = np.ones(len(markers.labels), bool)
    free[list(config.anchors.nodes)] = False
    noise = config.filter.measurement_noise if reference is None else 0.0
    return Evaluation(
        horizon,
        _scores(errors, free, interval),
        _details(runs, errors, actual, speeds(shown, targets, interval), free, noise),
        {name: 1e6 * run.seconds / len(markers) for name, run in runs.items()},
        errors,
        int(markers.stamps[0]),
        targets,
        actual,
        {name: run.position for name, run in runs.items()},
    )


def _counted(
    markers: MarkerSequence, shown: MarkerSequence, targets: IntArray, runs: dict[str, Run]
) -> tuple[FloatArray, BoolArray]:
    """Actual positions [m] at the targets [ns], and which of them are shown and predicted."""
    actual, counted = at_times(shown, targets)
    counted &= (markers.stamps >= markers.stamps[0] + WARM_UP * NANOSECONDS)[:, None]
    for run in runs.values():
        counted &= np.isfinite(run.position).all(axis=-1)
    return actual, counted


def _why_nothing(markers: MarkerSequence, horizon: float) -> str:
    seconds = (markers.stamps[-1] - markers.stamps[0]) / NANOSECONDS
    return (
        f'no frame can be judged: the recording lasts {seconds:.2f} s, of which the first '
        f'{WARM_UP} s are the warm-up and the last {horizon} s have no later measurement'
    )


def _scores(errors: dict[str, FloatArray], free: BoolArray, interval: int) -> dict[str, Score]:
    """Sum up the errors of each method; interval [ns] between frames."""
    block = max(round(BLOCK * NANOSECONDS / interval), 1)
    return {
        name: score(error, np.isfinite(error), free, block, np.random.default_rng(SEED))
        for name, error in errors.items()
    }


def _details(
    runs: dict[str, Run],
    errors: dict[str, FloatArray],
    actual: FloatArray,
    speed: FloatArray,
    free: BoolArray,
    noise: float,
) -> dict[str, Details]:
    """Judge what each method says of its own errors; noise [m] of a coordinate of `actual`."""
    found = {}
    for name, run in runs.items():
        error = errors[name][:, free]
        sigma = np.where(np.isfinite(error), np.hypot(run.sigma[:, free], noise), nan)
        found[name] = Details(
            coverage((run.position - actual)[:, free], sigma),
            mean(run.nis),
            by_speed(error, speed[:, free]),
        )
    return found


def in_order(markers: MarkerSequence) -> MarkerSequence:
    """Leave out frames whose stamp does not lie after all stamps before it."""
    latest = np.maximum.accumulate(markers.stamps)
    keep = np.append(True, markers.stamps[1:] > latest[:-1])
    if keep.all():
        return markers
    return MarkerSequence(
        markers.stamps[keep],
        markers.labels,
        markers.positions[keep],
        markers.visible[keep],
        markers.frame_id,
    )


def predict_all(
    predictor: Predictor,
    markers: MarkerSequence,
    horizon: float,
    progress: Callable[[int], None] = lambda frames: None,
) -> Run:
    """Let a method follow the markers and predict after each frame."""
    frames, nodes = markers.visible.shape
    run = Run(np.empty((frames, nodes, 3)), np.empty((frames, nodes)), np.empty(frames), 0.0)
    begin = time.perf_counter()
    for k, stamp in enumerate(markers.stamps.tolist()):
        run.nis[k] = predictor.step(stamp, markers.positions[k], markers.visible[k])
        run.position[k], run.sigma[k] = predictor.predict(horizon)
        progress(1)
    return replace(run, seconds=time.perf_counter() - begin)
