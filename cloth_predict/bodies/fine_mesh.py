"""The nodes that are published of a body: as many as one likes, between those of the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.models import rotation
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric_kinematics import LOCAL, ROTATION, Kinematics
from cloth_predict.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class FineMesh:
    """A closed mesh whose local displacements are those of a coarse one: d = S q_d (eq. 5).

    kinematics: of the fine nodes; shapes S, shape (fine, coarse): linear on the triangles of the
    coarse mesh, on the sphere of the material coordinates; node, shape (coarse,): the fine node
    nearest to each coarse one. The global shape is exact at every node.
    """

    kinematics: Kinematics
    shapes: sparse.csr_array
    node: IntArray

    @classmethod
    def of(cls, mesh: ClosedMesh, coarse: ClosedMesh) -> FineMesh:
        """Lay a mesh over a coarser one."""
        found = nearest_on_surface(mesh.directions, coarse.directions, coarse.triangles)
        rows = np.repeat(np.arange(len(mesh)), 3)
        columns = coarse.triangles[found.triangle].ravel()
        shapes = sparse.csr_array(
            (found.weight.ravel(), (rows, columns)), shape=(len(mesh), len(coarse))
        )
        node = (coarse.directions @ mesh.directions.T).argmax(axis=1)
        return cls(Kinematics(mesh), shapes, node)

    @property
    def mesh(self) -> ClosedMesh:
        """The fine mesh."""
        return self.kinematics.mesh

    def coordinates(self, q: FloatArray) -> FloatArray:
        """Coordinates q, their rates, or these once more, of the fine body by the coarse one's."""
        fine = self.shapes @ q[LOCAL:].reshape(-1, 3)
        return np.concatenate([q[:LOCAL], fine.ravel()])

    def position(self, q: FloatArray) -> FloatArray:
        """Positions of the fine nodes [m], shape (fine, 3), by the coarse coordinates."""
        return self.kinematics.position(self.coordinates(q))

    def motion(
        self, q: FloatArray, rate: FloatArray, second: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position [m], velocity [m/s] and acceleration [m/s^2] (eq. 42), each (fine, 3)."""
        fine, first, twice = (self.coordinates(values) for values in (q, rate, second))
        kinematics = self.kinematics
        shared, turn = kinematics.global_jacobian(fine), rotation.matrix(fine[ROTATION])
        velocity, change = (
            shared @ values[:LOCAL] + kinematics.local(values) @ turn.T
            for values in (first, twice)
        )
        return kinematics.position(fine), velocity, change + kinematics.transport(fine, first)

    def covariance(self, of_coarse: FloatArray) -> FloatArray:
        """Covariances of the fine nodes [m^2], as if those around each erred alike, (fine, 3, 3).

        of_coarse, shape (coarse, 3, 3).
        """
        flat = self.shapes @ of_coarse.reshape(len(of_coarse), 9)
        return np.asarray(flat.reshape(-1, 3, 3))
