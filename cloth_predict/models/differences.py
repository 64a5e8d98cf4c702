"""A derivative by central differences, where a map has none that can be written down."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cloth_predict.types import FloatArray

RELATIVE = 6e-6
"""Step by the size of what is varied: the cube root of the rounding of a double, at which the
errors of the difference and of rounding are alike, about 1e-10 of the derivative."""


def steps_of(at: FloatArray, scale: float = 1.0) -> FloatArray:
    """By how much each argument is varied, shape (n,); scale: size of one small or zero."""
    return RELATIVE * np.maximum(np.abs(at), scale)


def central(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, scale: float = 1.0
) -> FloatArray:
    """Derivative of a function of shape (m,) by its argument, shape (n,), shape (m, n).

    scale: size of an argument that is small or zero.
    """
    steps = steps_of(at, scale)
    columns = []
    for i, step in enumerate(steps):
        moved = np.zeros_like(at)
        moved[i] = step
        columns.append((function(at + moved) - function(at - moved)) / (2.0 * step))
    return np.array(columns).reshape(len(at), -1).T
