"""How uncertain a surface near its rest can still get: a bound for all steps to come."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cloth_predict.filters.linear import root, symmetric
from cloth_predict.types import FloatArray, Gaussian, IntArray

SETTLED = 1e-6
"""Share by which a variance may still grow when it is taken to be the last one."""


def adding_up(step_jac: FloatArray, noise: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Yield 1, 2, 4, ... and the covariance that noise has after as many steps, from none.

    step_jac F and the noise N of a step, shape (dim_x, dim_x): N + F N F' + F F N F' F' + ...,
    by twice as many terms each time (Smith 1968), until no variance grows any more.
    """
    cov, power, count, growing = noise, step_jac, 1, True
    while growing:
        yield count, cov
        more = power @ cov @ power.T
        growing = not (np.diagonal(more) <= SETTLED * np.diagonal(cov)).all()
        cov, power, count = symmetric(cov + more), power @ power, 2 * count


@dataclass(frozen=True)
class Envelope:
    """A covariance W in balance with noise: W = fade^2 F W F' + N, shape (dim_x, dim_x).

    It plays the part that energy has without noise: a covariance P <= k W with k >= 1 is no more
    than k W / fade^2 a step later, as F P F' + N <= k (F W F' + N) <= k W / fade^2. With fade just
    below 1 there is such a W though some motions hardly die away, or not at all.

    reach [m]: the largest sigma of a marker by W, in any direction.
    """

    cov: FloatArray
    reach: float

    @classmethod
    def of(cls, cov: FloatArray, rows: IntArray) -> Envelope:
        """Take W and the rows of k markers, shape (k, 3)."""
        return cls(cov, float(worst_sigma(Gaussian(cov[0], cov).marginals(rows)).max()))

    def keeps(self, cov: FloatArray, most: float) -> bool:
        """Whether the sigma of every marker stays within `most` [m] from this covariance on.

        Over n steps, `most` is to be taken fade^n times as large.
        """
        share = most / self.reach
        if not share >= 1.0:  # nor for NaN
            return False
        try:
            root(share**2 * self.cov - cov, 'rest')
        except FloatingPointError:
            return False
        return True


def worst_sigma(cov: FloatArray) -> FloatArray:
    """Sigma [m] along the worst direction, shape (..., k), of covariances (..., k, 3, 3).

    Raises FloatingPointError where one is not finite.
    """
    if not np.isfinite(cov).all():
        raise FloatingPointError('a covariance is not finite')
    return np.asarray(np.sqrt(np.linalg.eigvalsh(cov)[..., -1].clip(min=0.0)))
