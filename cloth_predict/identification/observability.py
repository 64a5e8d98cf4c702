"""What measurements can tell of states and parameters along a run: the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cloth_predict.models.differences import steps_of
from cloth_predict.types import FloatArray


def sensitivities(
    simulate: Callable[[FloatArray], FloatArray], at: FloatArray, scale: float = 1.0
) -> FloatArray:
    """Derivatives of what a simulation gives by the n unknowns `at`, shape (..., n).

    simulate: takes many vectors of unknowns at once, shape (2 n, n), and gives an array of shape
    (2 n, ...). By central differences; scale: size of an unknown that is small or zero.
    """
    steps = steps_of(at, scale)
    found = simulate(np.concatenate([at + np.diag(steps), at - np.diag(steps)]))
    up, down = np.split(np.moveaxis(found, 0, -1), 2, axis=-1)
    return np.asarray((up - down) / (2.0 * steps))


def bounds(slopes: FloatArray, sigma: FloatArray, prior: FloatArray) -> FloatArray:
    """Least covariance of the unknowns after each frame, shape (frames, n, n).

    slopes, shape (frames, m, n): derivatives of the m numbers that a frame measures, of sigma,
    shape (m,); prior, shape (n,): sigmas before the first frame, finite. No estimator that is
    right on average does better (Rao 1945), nor any on average over the prior, as far as the
    motion is linear in the unknowns (van Trees 1968).
    """
    white = slopes / sigma[:, None]
    information = np.cumsum(np.einsum('fmi,fmj->fij', white, white), axis=0)
    information += np.diag(prior**-2.0)
    scale = np.sqrt(np.einsum('fii->fi', information))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(information / outer) / outer)
