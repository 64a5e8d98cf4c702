"""How well data fix the parameters that a search found: Fisher information of the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.types import FloatArray, IntArray

LOOSE = 0.3
"""Standard deviation, on the scale of the search, from which on a parameter counts as not fixed:
30 % of a positive one."""
NOTHING = 1e-12
"""Information along a direction, by the greatest, from which on there is none but rounding."""


@dataclass(frozen=True)
class Determined:
    """Standard deviations of parameters, shape (n,), on the scale of the search.

    They are infinite of one that can move, with others, without a change of the residuals.
    loosest, shape (n,): the direction of the least information, of length 1.
    """

    sigma: FloatArray
    loosest: FloatArray

    @property
    def loose(self) -> list[int]:
        """Parameters that the data do not fix."""
        return np.flatnonzero(~(self.sigma <= LOOSE)).tolist()


def determined(
    jacobian: FloatArray, residuals: FloatArray, blocks: IntArray, floor: float
) -> Determined:
    """Standard deviations of a least-squares fit, from its residuals [m], shape (m,).

    jacobian, shape (m, n): their derivative; blocks, shape (m,): which residuals belong together;
    floor [m]: standard deviation of the noise of one residual. With H = J'J the covariance is
    H^-1 (sum over blocks of g g' + floor^2 H) H^-1, with g = J'r of a block: residuals of a model
    that is not the truth are alike for a while, so that each block tells once (the estimator of
    Huber and White, by clusters). Noise alone gives floor^2 H^-1, the bound of Cramer and Rao.
    """
    hessian = jacobian.T @ jacobian
    slopes = np.array(
        [jacobian[blocks == b].T @ residuals[blocks == b] for b in np.unique(blocks)]
    )
    slopes -= slopes.mean(axis=0)  # zero at the minimum, and not quite zero where a search ends
    many = len(slopes)
    spread = slopes.T @ slopes * (many / max(many - 1, 1)) + floor**2 * hessian
    scale = np.sqrt(np.diag(hessian))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    known = values > NOTHING * max(values.max(), 1e-300)
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T / np.outer(scale, scale)
    variance = np.diag(inverse @ spread @ inverse).copy()
    free = (np.square(vectors[:, ~known]) > 1e-6).any(axis=1)  # rounding of a unit vector
    sigma = np.where(free, np.inf, np.sqrt(np.maximum(variance, 0.0)))
    loosest = vectors[:, 0] / scale
    return Determined(sigma, loosest / np.linalg.norm(loosest))
