"""Numbers about predictions; prints nothing."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, nan

import numpy as np

from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

RESAMPLES = 1000
FEWEST_BLOCKS = 5
"""Blocks without which there is no interval: too few to tell chance from motion."""
BINS = 3


@dataclass(frozen=True)
class Score:
    """Prediction errors over frames and markers, 3-D distances [mm]; NaN where there are none."""

    rmse_mm: float
    rmse_free_mm: float
    """Without the driven nodes, whose future is not the model's to know."""
    p95_mm: float
    max_mm: float
    rmse_95_mm: tuple[float, float]
    """95 % interval of `rmse_mm`, or NaN where the recording is too short for one."""


@dataclass(frozen=True)
class SpeedBin:
    """Errors [mm] at speeds [m/s] above those of the bin before, up to and with its own."""

    up_to_m_s: float
    rmse_mm: float


@dataclass(frozen=True)
class Details:
    """Whether a method knows how wrong it is, and where it is wrong; of the free nodes."""

    coverage: tuple[float, ...] | None
    """Share of coordinates within 1, 2 and 3 predicted sigma; 0.683, 0.954 and 0.997 of a normal
    error. None of a method that predicts no sigma."""
    nis: float
    """Mean normalised innovation squared per degree of freedom: 1 of a filter whose noise is that
    of its model; NaN of a method that tells none."""
    by_speed: tuple[SpeedBin, ...]


def score(
    errors: FloatArray,
    counted: BoolArray,
    free: BoolArray,
    block: int,
    rng: np.random.Generator,
) -> Score:
    """Sum up errors [m], shape (frames, markers), where `counted`; free, shape (markers,).

    The interval is that of `rms_interval` with `block` and `rng`.
    """
    every = 1e3 * errors[counted]
    of_free = 1e3 * errors[:, free][counted[:, free]]
    if not every.size:
        return Score(nan, nan, nan, nan, (nan, nan))
    p95, highest = float(np.percentile(every, 95)), float(every.max())
    interval = rms_interval(1e3 * np.where(counted, errors, nan), block, rng)
    return Score(rms(every), rms(of_free), p95, highest, interval)


def rms(values: FloatArray) -> float:
    """Root of the mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else nan


def rms_interval(errors: FloatArray, block: int, rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of the RMS of errors, shape (frames, markers), NaN where not counted.

    Circular block bootstrap (Politis and Romano 1992): errors of one frame and of frames close to
    each other belong together, so what is drawn, 1000 times, are runs of `block` frames, as many
    frames in all as there are. NaN where there are fewer than five blocks.
    """
    judged = errors[np.isfinite(errors).any(axis=1)]
    per_frame = np.stack([np.nansum(judged**2, axis=1), np.isfinite(judged).sum(axis=1)])
    frames = per_frame.shape[1]
    if frames < FEWEST_BLOCKS * block:
        return nan, nan
    blocks = ceil(frames / block)
    starts = rng.integers(frames, size=(RESAMPLES, blocks))
    whole, last = (_runs(per_frame, n) for n in (block, frames - (blocks - 1) * block))
    squared, count = whole[:, starts[:, :-1]].sum(axis=2) + last[:, starts[:, -1]]
    low, high = np.percentile(np.sqrt(squared / count), [2.5, 97.5])
    return float(low), float(high)


def _runs(values: FloatArray, length: int) -> FloatArray:
    """Sums of `length` values in a circle from each place on, shape (..., places)."""
    around = np.concatenate([values, values[..., :length]], axis=-1)
    total = np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(around, axis=-1)], axis=-1)
    places = values.shape[-1]
    return np.asarray(total[..., length : length + places] - total[..., :places])


def coverage(offsets: FloatArray, sigma: FloatArray) -> tuple[float, ...] | None:
    """Share of coordinates whose offset [m] is at most 1, 2 and 3 sigma [m].

    offsets, shape (..., 3), and sigma of each coordinate, shape (...,); what is NaN in either is
    left out. None where nothing is left.
    """
    known = np.isfinite(sigma) & np.isfinite(offsets).all(axis=-1)
    if not known.any():
        return None
    off, limit = np.abs(offsets[known]), sigma[known][:, None]
    return tuple(float(np.mean(off <= k * limit)) for k in (1, 2, 3))


def mean(values: FloatArray) -> float:
    """Mean of the values that are not NaN; NaN of none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else nan


def speeds(sequence: MarkerSequence, times: IntArray, interval: int) -> FloatArray:
    """Speed [m/s] of each marker at times [ns], shape (times, markers), NaN where not known.

    The central difference (p(t + d) - p(t - d)) / 2d, with d the interval [ns] between frames.
    """
    after, seen_after = at_times(sequence, times + interval)
    before, seen_before = at_times(sequence, times - interval)
    speed = distances(after, before) / (2e-9 * interval)
    return np.where(seen_after & seen_before, speed, np.nan)


def by_speed(errors: FloatArray, speed: FloatArray) -> tuple[SpeedBin, ...]:
    """RMS of errors [m] in each third of the speeds [m/s], slowest first; shapes are equal.

    Left out is what is NaN in either. Each bin ends at a speed that occurs.
    """
    known = np.isfinite(errors) & np.isfinite(speed)
    error, fast = 1e3 * errors[known], speed[known]
    if not fast.size:
        return (SpeedBin(nan, nan),) * BINS
    ends = np.quantile(fast, np.arange(1, BINS + 1) / BINS, method='inverted_cdf')
    place = np.searchsorted(ends, fast)
    return tuple(SpeedBin(float(end), rms(error[place == k])) for k, end in enumerate(ends))


def distances(predicted: FloatArray, actual: FloatArray) -> FloatArray:
    """3-D distances [m] along the last axis."""
    return np.asarray(np.linalg.norm(predicted - actual, axis=-1))


def at_times(
    sequence: MarkerSequence, times: IntArray, usual: int | None = None
) -> tuple[FloatArray, BoolArray]:
    """Positions [m], shape (times, markers, 3), and visibility at times [ns].

    A time between two frames is interpolated linearly, where both show the marker and are at most
    two usual frame intervals apart: `usual` [ns], or else the median of the sequence, whose
    stamps must increase strictly.
    """
    stamps = sequence.stamps
    if usual is None:
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
