"""The stiffness of local displacements: a loaded membrane (Metaxas & Terzopoulos 1993, II.D)."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.types import FloatArray


class Membrane:
    """Energy [J] 1/2 int w0 |d|^2 + w1 |grad d|^2 over the unit sphere, of displacements d [m].

    The sphere is that of the material coordinates, so that w0 and w1 are both in N/m: w0 holds the
    displacements small, w1 smooth. Triangles are linear elements.
    """

    def __init__(self, mesh: ClosedMesh, w0: float, w1: float) -> None:
        self.triangles, self.nodes = mesh.triangles, len(mesh)
        opposite = mesh.on_sphere.opposite
        area = np.linalg.norm(np.cross(opposite[:, 1], opposite[:, 2]), axis=1) / 2.0
        # The gradient of a hat function is its opposite side, turned, by twice the area.
        variation = np.einsum('tai,tbi->tab', opposite, opposite) / (4.0 * area)[:, None, None]
        magnitude = (np.ones((3, 3)) + np.eye(3)) / 12.0 * area[:, None, None]
        self.elements = w0 * magnitude + w1 * variation
        """Stiffness [N/m] of each triangle, shape (t, 3, 3)."""
        corners = self.triangles.ravel()
        self._gather = sparse.csr_array(
            (np.ones(len(corners)), (corners, np.arange(len(corners)))),
            shape=(self.nodes, len(corners)),
        )

    def apply(self, d: FloatArray) -> FloatArray:
        """K d [N] of displacements [m], both (N, 3), one element at a time."""
        return np.asarray(self._gather @ (self.elements @ d[self.triangles]).reshape(-1, 3))

    def matrix(self) -> sparse.csr_array:
        """K [N/m], shape (N, N), the same for x, y and z."""
        rows = np.repeat(self.triangles, 3, axis=1).ravel()
        columns = np.tile(self.triangles, 3).ravel()
        shape = (self.nodes, self.nodes)
        return sparse.coo_array((self.elements.ravel(), (rows, columns)), shape=shape).tocsr()
