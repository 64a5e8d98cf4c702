"""Numbers about predictions; prints nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from cloth_predict.evaluation.bootstrap import Interval, Part, paired, ratio_interval, rms_interval
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

BINS = 3


@dataclass(frozen=True)
class Score:
    """Prediction errors over frames and markers, 3-D distances [mm]; NaN where there are none."""

    rmse_mm: float
    rmse_free_mm: float
    """Without the driven nodes, whose future is not the model's to know."""
    p95_mm: float
    max_mm: float
    rmse_95_mm: Interval
    """95 % interval of `rmse_mm`, or NaN where a recording is too short for one."""


@dataclass(frozen=True)
class Ratio:
    """RMS error of the free nodes by that of the best kinematic filter; less is better."""

    ratio: float
    ratio_95: Interval
    """95 % interval, of the same frames for both; NaN where a recording is too short for one."""


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
    nees: float
    """Mean normalised error squared of the estimate by the truth, e' P^-1 e / 3 of a node: 1 of a
    filter that knows how wrong it is; NaN where either is not known."""
    by_speed: tuple[SpeedBin, ...]


def score(parts: Sequence[Part], free: BoolArray, rng: np.random.Generator) -> Score:
    """Sum up errors [m] of all recordings; free, shape (markers,); rng: for `rms_interval`."""
    parts = [(1e3 * errors, block) for errors, block in parts]
    every = np.concatenate([errors[np.isfinite(errors)] for errors, _ in parts])
    if not every.size:
        return Score(nan, nan, nan, nan, (nan, nan))
    return Score(
        rms(every),
        rms(np.concatenate([errors[:, free].ravel() for errors, _ in parts])),
        float(np.percentile(every, 95)),
        float(every.max()),
        rms_interval(parts, rng),
    )


def ratio(parts: Sequence[Part], others: Sequence[Part], rng: np.random.Generator) -> Ratio:
    """Compare errors with those of another method, where both are counted."""
    pairs = paired(parts, others)
    mine = rms(np.concatenate([mine.ravel() for mine, _, _ in pairs]))
    its = rms(np.concatenate([its.ravel() for _, its, _ in pairs]))
    if not its > 0:
        return Ratio(nan, (nan, nan))
    return Ratio(mine / its, ratio_interval(parts, others, rng))


def rms(values: FloatArray) -> float:
    """Root of the mean square of the values that are not NaN; NaN of none."""
    return float(np.sqrt(mean(np.square(values))))


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


def normalised(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Mean of the squares of normalised errors, e' P^-1 e / 3, shape (markers,).

    errors [m], shape (markers, 3); covariances [m^2], shape (markers, 3, 3). NaN where one is NaN
    or the covariance is singular.
    """
    found = np.full(len(errors), nan)
    finite = np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    known = np.flatnonzero(finite)
    known = known[np.linalg.det(covariances[known]) > 0]
    e = errors[known]
    found[known] = np.sum(e * np.linalg.solve(covariances[known], e[..., None])[..., 0], 1) / 3
    return found


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
