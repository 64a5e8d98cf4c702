"""Makes a recording worse on purpose: markers vanish, labels are swapped or lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

import numpy as np

from cloth_predict.evaluation.cases import Case, points_of
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

SPARED = 1.0
"""Seconds at the start that stay as they are, so that every method starts alike."""


@dataclass(frozen=True)
class Degradation:
    """What happens to the markers; the default is nothing.

    drop: share of the samples that are hidden, in bursts of `burst` [s], or frame by frame;
    gone: as many markers at a time vanish for gone_for [s], then all are back for as long;
    swap: share of the frames in which two markers carry each other's label;
    unlabelled: whether all labels are lost, for the methods that associate by themselves.
    """

    drop: float = 0.0
    burst: float = 0.0
    gone: int = 0
    gone_for: float = 0.0
    swap: float = 0.0
    unlabelled: bool = False
    seed: int = 0


NOTHING = Degradation()


def degraded(case: Case, how: Degradation) -> Case:
    """Return the case made worse; what it is compared with stays.

    Where markers are hidden or swapped of which none has a label, only those that the tracker had
    found to be nodes remain as points.
    """
    rng = np.random.default_rng(how.seed)
    markers, stamps = case.markers, case.markers.stamps
    interval = np.median(np.diff(stamps)) / NANOSECONDS if len(stamps) > 1 else 1.0
    shape = markers.visible.shape
    gone_for = max(round(how.gone_for / interval), 1)
    lost = drops(shape, how.drop, max(round(how.burst / interval), 1), rng)
    lost |= long_gaps(shape, how.gone, gone_for, rng)
    lost &= _later(stamps)[:, None]
    markers = swapped(hidden(markers, lost), how.swap, rng)
    changed = markers is not case.markers
    if how.unlabelled or (changed and not case.labelled.any()):
        own = shuffled(points_of(markers), rng)
        others = case.points if case.labelled.any() else tuple(p[:0] for p in case.points)
        points = tuple(np.concatenate(both) for both in zip(own, others, strict=True))
        return replace(case, markers=markers, labelled=np.zeros(shape, bool), points=points)
    return replace(case, markers=markers)


def drops(
    shape: tuple[int, ...], share: float, length: int, rng: np.random.Generator
) -> BoolArray:
    """Which samples are hidden, shape (frames, markers): a share, in bursts of `length` frames.

    Each marker is hidden on its own. The frames between two bursts are a geometric number, so that
    bursts of one frame are independent of each other.
    """
    lost = np.zeros(shape, bool)
    if share <= 0:
        return lost
    begin = share / (share + length * (1 - share))
    for marker in range(shape[1]):
        k = 0
        while k < shape[0]:
            k += int(rng.geometric(begin)) - 1
            lost[k : k + length, marker] = True
            k += length
    return lost


def long_gaps(
    shape: tuple[int, ...], count: int, length: int, rng: np.random.Generator
) -> BoolArray:
    """Which samples are hidden, shape (frames, markers): `count` markers for `length` frames.

    Then all are back for as many frames; each time other markers are drawn.
    """
    lost = np.zeros(shape, bool)
    for k in range(0, shape[0], 2 * length):
        markers = rng.permutation(shape[1])[:count]
        lost[k : k + length, markers] = True
    return lost


def hidden(markers: MarkerSequence, lost: BoolArray) -> MarkerSequence:
    """Hide samples; lost, shape (frames, markers)."""
    if not lost.any():
        return markers
    positions = np.where(lost[..., None], nan, markers.positions)
    return replace(markers, positions=positions, visible=markers.visible & ~lost)


def swapped(markers: MarkerSequence, share: float, rng: np.random.Generator) -> MarkerSequence:
    """Let two visible markers, drawn anew, exchange their places in a share of the frames."""
    if share <= 0:
        return markers
    positions = markers.positions.copy()
    chosen = (rng.random(len(markers)) < share) & _later(markers.stamps)
    for k in np.flatnonzero(chosen):
        seen = np.flatnonzero(markers.visible[k])
        if len(seen) >= 2:
            i, j = rng.choice(seen, 2, replace=False)
            positions[k, [i, j]] = positions[k, [j, i]]
    return replace(markers, positions=positions)


def shuffled(points: tuple[FloatArray, ...], rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Put the points of each frame into an order drawn anew."""
    return tuple(rng.permutation(frame) for frame in points)


def _later(stamps: IntArray) -> BoolArray:
    return np.asarray(stamps >= stamps[0] + SPARED * NANOSECONDS)
