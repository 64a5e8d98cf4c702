"""Rounding on a grid, the same on every machine.

Two machines predict alike but for the rounding of their linear algebra. That must not decide
between two whole numbers, so each frame says which offset rounds what is expected, and the encoder
takes one by which no number comes near the next.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from cloth_predict.types import FloatArray, IntArray

OFFSETS = (0.5, 0.25, 0.75)
UNEXPECTED = len(OFFSETS)
"""Stands for no offset: zero is expected."""
MARGIN = 1e-5
"""By how much of a step two machines may differ."""

KEPT = np.array(list(product((0, 1), repeat=3)))
"""Which coordinates of a residual are told; the others are taken as expected."""
REACH = 0.5 * np.sqrt(3.0)
"""How far a point is at most from the nearest whole one."""


def offset_for(expected: FloatArray) -> int:
    """Number of the first offset by which every number keeps its margin."""
    for k, offset in enumerate(OFFSETS):
        above = np.mod(expected + offset, 1.0)
        if ((above > MARGIN) & (above < 1.0 - MARGIN)).all():
            return k
    return UNEXPECTED


def rounded(expected: FloatArray, offset: int) -> IntArray:
    """Whole numbers next to what is expected. Raises ValueError for an offset that is none."""
    if offset == UNEXPECTED:
        return np.zeros(expected.shape, np.int64)
    if not 0 <= offset < UNEXPECTED:
        raise ValueError(f'there is no offset {offset}')
    return np.floor(expected + OFFSETS[offset]).astype(np.int64)


def cheapest(found: FloatArray, expected: IntArray) -> IntArray:
    """Whole points within `REACH` of those found that are least to tell; shape (m, 3) each.

    That is the nearest one, with any of its coordinates as expected that the bound allows.
    """
    residual = np.rint(found).astype(np.int64) - expected
    choices = residual[:, None] * KEPT
    error = np.linalg.norm(found[:, None] - expected[:, None] - choices, axis=-1)
    bits = np.log2(1.0 + np.abs(choices)).sum(axis=-1)
    bits[(error > REACH) & (choices != residual[:, None]).any(axis=-1)] = np.inf
    best = np.lexsort((error, bits))[:, 0]
    return np.asarray(expected + choices[np.arange(len(found)), best])
