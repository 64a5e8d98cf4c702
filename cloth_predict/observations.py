"""What is seen of the state: the position rows of the visible nodes, or a linear map of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.types import FloatArray, IntArray


@dataclass(frozen=True)
class VisiblePositions:
    """Selects the positions of the visible nodes (Gomes 2016, eq. 6.7, for the rows seen).

    rows, shape (m,): the entries of the state that are measured; cov, shape (m,): noise variances
    [m^2].
    """

    rows: IntArray
    cov: FloatArray

    @classmethod
    def of_nodes(cls, nodes: IntArray, sigma: float) -> VisiblePositions:
        """Observe these free nodes with sigma [m] on each coordinate."""
        rows = (3 * np.asarray(nodes, np.int64)[:, None] + np.arange(3)).ravel()
        return cls.of_rows(rows, sigma)

    @classmethod
    def of_rows(cls, rows: IntArray, sigma: float) -> VisiblePositions:
        """Observe these rows of the state, shape (m,), with sigma [m] on each."""
        return cls(rows, np.full(len(rows), sigma**2))

    def h(self, x: FloatArray) -> FloatArray:
        """Positions of the visible nodes [m], shape (m,)."""
        return x[self.rows]

    def jac(self, x: FloatArray) -> IntArray:
        """The rows themselves: H is a selection, never a matrix product."""
        return self.rows


@dataclass(frozen=True)
class LinearObservation:
    """Sees offset + H x: matrix H, shape (m, dim_x), offset, (m,); cov, shape (m,), variances."""

    matrix: FloatArray
    offset: FloatArray
    cov: FloatArray

    def h(self, x: FloatArray) -> FloatArray:
        """Measurement expected at x, shape (m,)."""
        return self.offset + self.matrix @ x

    def jac(self, x: FloatArray) -> FloatArray:
        """H."""
        return self.matrix
