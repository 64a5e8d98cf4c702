"""What is seen of the state: positions of nodes, of a sheet or of a body, or a linear map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.models.superquadric import LOCAL, Superquadric
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


@dataclass(frozen=True)
class NodePositions:
    """Sees markers at nodes of a body, at some several (Metaxas & Terzopoulos 1993, eq. 14).

    nodes, shape (m,): the node of each marker; sigma [m] on each coordinate, of all markers or of
    each, shape (m,). What does not move in the body is taken as known. The state may go on after
    that of the body, x = [q; q'; ...].
    """

    body: Superquadric
    nodes: IntArray
    sigma: float | FloatArray

    @property
    def cov(self) -> FloatArray:
        """Noise variances [m^2], shape (3m,)."""
        return np.repeat(np.broadcast_to(np.square(self.sigma), len(self.nodes)), 3)

    def h(self, x: FloatArray) -> FloatArray:
        """Positions [m], shape (3m,)."""
        return self.body.position(x, self.nodes).ravel()

    def parts(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivative by the coordinates that all nodes share, (m, 3, 18), and by a node's own."""
        moving = self.body.moving
        shared = self.body.global_jacobian(x, self.nodes) * moving[:LOCAL]
        return shared, self.body.rotation(x) * moving[LOCAL]

    def jac(self, x: FloatArray) -> FloatArray:
        """H (eq. 17), shape (3m, dim_x)."""
        shared, own = self.parts(x)
        full = np.zeros((len(self.nodes), 3, len(x)))
        full[:, :, :LOCAL] = shared
        columns = LOCAL + 3 * self.nodes[:, None, None] + np.arange(3)
        full[np.arange(len(full))[:, None, None], np.arange(3)[:, None], columns] = own
        return full.reshape(-1, len(x))
