"""Intervals of errors that belong together: a bootstrap of blocks of frames.

Circular block bootstrap (Politis and Romano 1992): errors of one frame and of frames close to each
other belong together, so what is drawn, 1000 times, are runs of `block` frames, as many frames in
all as there are. No run goes from one recording into another.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, isfinite, nan

import numpy as np

from cloth_predict.types import FloatArray, IntArray

RESAMPLES = 1000
FEWEST_BLOCKS = 5
"""Blocks of each recording without which there is no interval: too few to tell chance from
motion."""

Part = tuple[FloatArray, int]
"""A recording: errors, shape (frames, markers), NaN where not counted, and frames of a block."""
Interval = tuple[float, float]


def rms_interval(parts: Sequence[Part], rng: np.random.Generator) -> Interval:
    """95 % interval of the RMS of all errors; NaN where a recording has less than five blocks."""
    squared, count = _resampled([(_sums(errors), block) for errors, block in parts], rng)
    return _interval(squared / count)


def ratio_interval(
    parts: Sequence[Part], others: Sequence[Part], rng: np.random.Generator
) -> Interval:
    """95 % interval of the RMS of errors by that of others, of which the same frames are drawn.

    Only what is counted in both counts.
    """
    sums = [
        (np.stack([_sums(mine)[0], _sums(its)[0]]), block)
        for mine, its, block in paired(parts, others)
    ]
    mine, its = _resampled(sums, rng)
    with np.errstate(divide='ignore', invalid='ignore'):  # a draw of frames without any error
        return _interval(mine / its)


def quantile_interval(parts: Sequence[Part], share: float, rng: np.random.Generator) -> Interval:
    """95 % interval of the value below which `share` of all errors is; NaN as `rms_interval`."""
    counts = [np.isfinite(errors).sum(axis=1) > 0 for errors, _ in parts]
    kept = [(errors[some], block) for (errors, block), some in zip(parts, counts, strict=True)]
    if any(len(errors) < FEWEST_BLOCKS * block for errors, block in kept):
        return nan, nan
    weights = np.concatenate([_drawn_frames(len(e), block, rng) for e, block in kept], axis=1)
    every = np.concatenate([errors.ravel() for errors, _ in kept])
    frames = np.repeat(
        np.arange(weights.shape[1]),
        np.concatenate([np.full(len(errors), errors.shape[1]) for errors, _ in kept]),
    )
    order = np.argsort(every)[: np.count_nonzero(np.isfinite(every))]
    found = np.empty(RESAMPLES)
    for k, weight in enumerate(weights):
        below = np.cumsum(weight[frames[order]])
        found[k] = every[order][np.searchsorted(below, share * below[-1])]
    low, high = np.percentile(found, [2.5, 97.5])
    return float(low), float(high)


def paired(
    parts: Sequence[Part], others: Sequence[Part]
) -> list[tuple[FloatArray, FloatArray, int]]:
    """Errors of each recording that are counted in both, without frames that have none."""
    found = []
    for (mine, block), (its, _) in zip(parts, others, strict=True):
        both = np.isfinite(mine) & np.isfinite(its)
        rows = both.any(axis=1)
        a, b = (np.where(both, errors, nan)[rows] for errors in (mine, its))
        found.append((a, b, block))
    return found


def _interval(squares: FloatArray) -> Interval:
    low, high = np.percentile(np.sqrt(squares), [2.5, 97.5])
    return (float(low), float(high)) if isfinite(low) else (nan, nan)


def _sums(errors: FloatArray) -> FloatArray:
    """Sum of squares and number of the errors of each frame that has any, shape (2, frames)."""
    judged = errors[np.isfinite(errors).any(axis=1)]
    return np.stack([np.nansum(judged**2, axis=1), np.isfinite(judged).sum(axis=1)])


def _resampled(sums: Sequence[Part], rng: np.random.Generator) -> FloatArray:
    """Totals of sums per frame, (k, frames) of each recording, in each draw, (k, RESAMPLES)."""
    return np.asarray(sum(_drawn(values, block, rng) for values, block in sums))


def _drawn_frames(frames: int, block: int, rng: np.random.Generator) -> IntArray:
    """How often each frame is in each draw, shape (RESAMPLES, frames)."""
    blocks = ceil(frames / block)
    starts = rng.integers(frames, size=(RESAMPLES, blocks))
    chosen = (starts[:, :, None] + np.arange(block)).reshape(RESAMPLES, -1)[:, :frames] % frames
    return np.array([np.bincount(draw, minlength=frames) for draw in chosen])


def _drawn(values: FloatArray, block: int, rng: np.random.Generator) -> FloatArray:
    frames = values.shape[1]
    if frames < FEWEST_BLOCKS * block:
        return np.full((len(values), RESAMPLES), nan)
    blocks = ceil(frames / block)
    starts = rng.integers(frames, size=(RESAMPLES, blocks))
    whole, last = (_runs(values, n) for n in (block, frames - (blocks - 1) * block))
    return np.asarray(whole[:, starts[:, :-1]].sum(axis=2) + last[:, starts[:, -1]])


def _runs(values: FloatArray, length: int) -> FloatArray:
    """Sums of `length` values in a circle from each place on, shape (..., places)."""
    around = np.concatenate([values, values[..., :length]], axis=-1)
    total = np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(around, axis=-1)], axis=-1)
    places = values.shape[-1]
    return np.asarray(total[..., length : length + places] - total[..., :places])
