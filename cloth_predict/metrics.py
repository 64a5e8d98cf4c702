"""Numbers about predictions; prints nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence


@dataclass(frozen=True)
class Score:
    """Prediction errors over frames and markers, 3-D distances [mm]; NaN where there are none."""

    rmse_mm: float
    rmse_free_mm: float
    """Without the driven nodes, whose future is not the model's to know."""
    p95_mm: float
    max_mm: float


def score(errors: FloatArray, counted: BoolArray, free: BoolArray) -> Score:
    """Sum up errors [m], shape (frames, markers), where `counted`; free, shape (markers,)."""
    every = 1e3 * errors[counted]
    of_free = 1e3 * errors[:, free][counted[:, free]]
    if not every.size:
        return Score(*[float('nan')] * 4)
    return Score(rms(every), rms(of_free), float(np.percentile(every, 95)), float(every.max()))


def rms(values: FloatArray) -> float:
    """Root of the mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else float('nan')


def distances(predicted: FloatArray, actual: FloatArray) -> FloatArray:
    """3-D distances [m] along the last axis."""
    return np.asarray(np.linalg.norm(predicted - actual, axis=-1))


def at_times(sequence: MarkerSequence, times: IntArray) -> tuple[FloatArray, BoolArray]:
    """Positions [m], shape (times, markers, 3), and visibility at times [ns].

    A time between two frames is interpolated linearly, where both show the marker and are at most
    two usual frame intervals apart. `sequence.stamps` must increase strictly.
    """
    stamps = sequence.stamps
    usual = int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0
    # a stamp within a microsecond of the time is that time: stamps are rounded
    after = np.clip(np.searchsorted(stamps, times - 1000), 0, len(stamps) - 1)
    exact = np.abs(stamps[after] - times) <= 1000
    before = np.where(exact, after, np.maximum(after - 1, 0))
    gap = stamps[after] - stamps[before]
    inside = exact | ((stamps[before] <= times) & (times <= stamps[after]) & (gap <= 2 * usual))
    share = np.where(exact, 0.0, (times - stamps[before]) / np.maximum(gap, 1))[:, None, None]
    positions = (1 - share) * sequence.positions[before] + share * sequence.positions[after]
    visible = inside[:, None] & sequence.visible[before] & sequence.visible[after]
    return positions, visible
