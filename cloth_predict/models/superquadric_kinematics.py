"""Where the points of a deformable superquadric are, and what its coordinates do to them.

x = c + R (s + d), x' = L q' (Metaxas & Terzopoulos 1993, eq. 8 and 9).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from cloth_predict.models import rotation, superquadric_shape
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.types import FloatArray, IntArray

TRANSLATION, ROTATION, GLOBAL = slice(0, 3), slice(3, 7), slice(7, 18)
LOCAL = 18
"""First of the local displacements, which are the last of the coordinates q (eq. 10)."""
COMPLEX_STEP = 1e-30
"""Imaginary change whose square vanishes: derivatives are exact but for rounding."""


def within_ranges(q: FloatArray) -> FloatArray:
    """Coordinates q, (dim_q,), or the 18 that all nodes share, put back to where they may be.

    That is a unit quaternion, which moves nothing, and parameters in their ranges.
    """
    q = q.copy()
    q[ROTATION] /= np.linalg.norm(q[ROTATION])
    q[GLOBAL] = np.clip(q[GLOBAL], superquadric_shape.LOW, superquadric_shape.HIGH)
    return q


class Kinematics:
    """The nodes of a mesh as functions of q = (c 3, theta 4, q_s 11, q_d 3N).

    c and q_d in metres; q_s in the order of `superquadric_shape.PARAMETERS`. Node-major vectors
    of the nodes are those of the inertial frame, shape (N, 3).
    """

    def __init__(self, mesh: ClosedMesh) -> None:
        self.mesh, self.nodes = mesh, len(mesh)
        self.dim_q = LOCAL + 3 * self.nodes
        shared = np.broadcast_to(np.arange(LOCAL), (self.nodes, LOCAL))
        own = LOCAL + np.arange(3 * self.nodes).reshape(-1, 3)
        columns = np.repeat(np.concatenate([shared, own], axis=1), 3, axis=0)
        # each row of L has the same number of entries
        self._columns, self._starts = (
            columns.ravel(),
            columns.shape[1] * np.arange(len(columns) + 1),
        )

    def local(self, q: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """Displacements d or their rate, shape (m, 3), in the frame of the body."""
        d = q[LOCAL:].reshape(-1, 3)
        return d if nodes is None else d[nodes]

    def position(self, q: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """Positions [m] (eq. 8), shape (m, 3)."""
        turn = rotation.matrix(q[ROTATION])
        return np.asarray(q[TRANSLATION] + self._in_body(q, nodes) @ turn.T)

    def velocity(self, q: FloatArray, rate: FloatArray) -> FloatArray:
        """L q' [m/s] (eq. 9), shape (N, 3)."""
        turn = rotation.matrix(q[ROTATION])
        return np.asarray(self.global_jacobian(q) @ rate[:LOCAL] + self.local(rate) @ turn.T)

    def transport(
        self, q: FloatArray, rate: FloatArray, nodes: IntArray | None = None
    ) -> FloatArray:
        """L' q' [m/s^2], the acceleration at steady rates, shape (m, 3).

        R'' p + 2 R' p' + R J' q_s'. The last term is missing in eq. 43; R'' p is the centrifugal
        part where the quaternion keeps its length.
        """
        theta, turning = q[ROTATION], rate[ROTATION]
        shape = superquadric_shape.motion(q[GLOBAL], rate[GLOBAL], self._coordinates(nodes))
        turn_rate = rotation.derivative(theta) @ turning
        return np.asarray(
            (shape.value + self.local(q, nodes)) @ rotation.second_rate(theta, turning).T
            + (shape.first + self.local(rate, nodes)) @ (2.0 * turn_rate).T
            + shape.second @ rotation.matrix(theta).T
        )

    def global_jacobian(self, q: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """The part [I B RJ] of L, shape (m, 3, 18); the rest is R at the node itself."""
        shape = superquadric_shape.jacobian(q[GLOBAL], self._coordinates(nodes))
        result = np.empty((len(shape), 3, LOCAL))
        result[:, :, TRANSLATION] = np.eye(3)
        result[:, :, ROTATION] = rotation.turned_jacobian(q[ROTATION], self._in_body(q, nodes))
        result[:, :, GLOBAL] = np.einsum('ab,nbk->nak', rotation.matrix(q[ROTATION]), shape)
        return result

    def jacobian(self, q: FloatArray) -> sparse.csr_array:
        """L of all nodes, shape (3N, dim_q)."""
        return self._by_coordinates(self.global_jacobian(q), rotation.matrix(q[ROTATION]))

    def pulled_back(self, q: FloatArray, force: FloatArray) -> FloatArray:
        """Generalised force L'F [N ...] of forces on the nodes [N], (N, 3), shape (dim_q,)."""
        local = force @ rotation.matrix(q[ROTATION])
        shared = np.einsum('nak,na->k', self.global_jacobian(q), force)
        return np.concatenate([shared, local.ravel()])

    def pulled_back_slope(self, q: FloatArray, force: FloatArray) -> sparse.csr_array:
        """Derivative of L'F by q with F held, (dim_q, dim_q): symmetric, as L'F is a gradient."""
        theta, q_s = q[ROTATION], q[GLOBAL]
        coordinates = self.mesh.coordinates
        turns = rotation.derivative(theta)
        by_theta = np.einsum('na,abk->nbk', force, turns)
        shape = superquadric_shape.jacobian(q_s, coordinates)
        local = force @ rotation.matrix(theta)
        both = np.zeros((LOCAL, LOCAL))
        both[ROTATION, ROTATION] = rotation.curvature(theta, force.T @ self._in_body(q))
        both[ROTATION, GLOBAL] = np.einsum('nbk,nbm->km', by_theta, shape)
        both[GLOBAL, ROTATION] = both[ROTATION, GLOBAL].T
        for m, change in enumerate(COMPLEX_STEP * 1j * np.eye(len(q_s))):
            bent = superquadric_shape.jacobian(q_s + change, coordinates).imag / COMPLEX_STEP
            both[GLOBAL, LOCAL - len(q_s) + m] = np.einsum('nbm,nb->m', bent, local)
        across = np.zeros((LOCAL, 3 * self.nodes))
        across[ROTATION] = by_theta.reshape(-1, 4).T
        return sparse.csr_array(sparse.bmat([[both, across], [across.T, None]]))

    def transport_slopes(
        self, q: FloatArray, rate: FloatArray
    ) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Derivatives of L' q' by q and by q', (3N, dim_q) each, by complex steps."""
        theta, turning = q[ROTATION], rate[ROTATION]
        by_q, by_rate = np.zeros((2, self.nodes, 3, LOCAL))
        for k, change in enumerate(COMPLEX_STEP * 1j * np.eye(self.dim_q)[:LOCAL]):
            by_q[:, :, k] = self.transport(q + change, rate).imag / COMPLEX_STEP
            by_rate[:, :, k] = self.transport(q, rate + change).imag / COMPLEX_STEP
        return (
            self._by_coordinates(by_q, rotation.second_rate(theta, turning)),
            self._by_coordinates(by_rate, 2.0 * rotation.derivative(theta) @ turning),
        )

    def _coordinates(self, nodes: IntArray | None) -> FloatArray:
        coordinates = self.mesh.coordinates
        return coordinates if nodes is None else coordinates[nodes]

    def _in_body(self, q: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """Positions p = s + d [m] in the frame of the body (eq. 2), shape (m, 3)."""
        shape = superquadric_shape.positions(q[GLOBAL], self._coordinates(nodes))
        return np.asarray(shape + self.local(q, nodes))

    def _by_coordinates(self, by_global: FloatArray, by_own: FloatArray) -> sparse.csr_array:
        """A derivative, (3N, dim_q), from (N, 3, 18) and one (3, 3) by each node's own d."""
        own = np.broadcast_to(by_own, (self.nodes, 3, 3))
        values = np.concatenate([by_global, own], axis=2)
        shape = (3 * self.nodes, self.dim_q)
        return sparse.csr_array((values.ravel(), self._columns, self._starts), shape=shape)
