"""Motion of a deformable superquadric under forces on its nodes (Metaxas & Terzopoulos 1993)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy import sparse

from cloth_predict.models import rotation, superquadric_shape
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.linear_part import LinearPart, NormalModes, of_axes
from cloth_predict.models.lumped_mass import lumped_mass
from cloth_predict.models.membrane import Membrane
from cloth_predict.models.superquadric_kinematics import (
    GLOBAL,
    LOCAL,
    ROTATION,
    TRANSLATION,
    Kinematics,
    within_ranges,
)
from cloth_predict.types import BoolArray, FloatArray, IntArray

__all__ = ['GLOBAL', 'LOCAL', 'ROTATION', 'TRANSLATION', 'Superquadric']

PULL = 1.0
"""Central pull on the quaternion [1/s^2]. It turns nothing, as R is made of theta / |theta|, and
bounds the variance of the length, which no marker tells. Being linear it leaves F constant."""


class Superquadric:
    """Second-order motion M q'' + D q' + K q = g_q + f_q (eq. 11), the state being x = [q; q'].

    q = (c 3, theta 4, q_s 11, q_d 3N), see `Kinematics`. The input holds the forces [N] on the
    nodes in the inertial frame, node-major, shape (3N,).

    The mass matrix int mu L'L is singular, as displacements can do all that the other coordinates
    do. So M is its diagonal (section V.A) at a reference shape, and stays. The four masses of the
    rotation are one, that of the mean moment of inertia, so that no direction is special. D =
    alpha M + beta K; K acts on q_d alone. Gravity moves c alone: of coordinates that can do the
    same, each would otherwise fall by itself. Without the inertial forces g_q and without an input
    the motion is linear.
    """

    def __init__(
        self,
        mesh: ClosedMesh,
        *,
        mass: float,
        reference: FloatArray,
        w0: float = 0.1,
        w1: float = 0.5,
        alpha: float = 1.0,
        beta: float = 0.0,
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
        free: BoolArray | None = None,
        local: bool = True,
        inertial: bool = False,
    ) -> None:
        """Take the mass [kg], reference parameters, (11,), w0, w1 [N/m], alpha [1/s], beta [s].

        gravity [m/s^2], shape (3,). Parameters that are not free, shape (11,), and displacements
        that are not `local` keep their values. inertial: with the forces g_q (eq. 49). Raises
        ConfigError where a reference parameter is out of range.
        """
        superquadric_shape.check_parameters(reference)
        self.mesh, self.kinematics = mesh, Kinematics(mesh)
        self.nodes, self.dim_q = len(mesh), self.kinematics.dim_q
        self.membrane = Membrane(mesh, w0, w1)
        self.alpha, self.beta, self.inertial = alpha, beta, inertial
        self.gravity = np.asarray(gravity, float)
        self.node_mass = mass * mesh.shares
        """Mass [kg] of each node, by its share of the unit sphere, shape (N,)."""
        self.mass = lumped_mass(self.node_mass, reference, mesh.coordinates)
        """Diagonal of M, shape (dim_q,)."""
        self.moving = np.ones(self.dim_q, bool)
        """Which coordinates move, shape (dim_q,)."""
        self.moving[GLOBAL] = True if free is None else free
        self.moving[LOCAL:] = local
        self.inverse_mass = self.moving / self.mass
        """Diagonal of M^-1, 0 of what does not move, shape (dim_q,)."""

    @property
    def dim_x(self) -> int:
        """Number of states, two per coordinate."""
        return 2 * self.dim_q

    @property
    def dim_u(self) -> int:
        """Three forces per node."""
        return 3 * self.nodes

    @property
    def linear(self) -> bool:
        """Whether the motion without an input is linear in x."""
        return not self.inertial

    def state(
        self,
        c: FloatArray,
        theta: FloatArray,
        q_s: FloatArray,
        q_d: FloatArray | None = None,
    ) -> FloatArray:
        """State at rest, shape (dim_x,); ConfigError where a parameter is out of range."""
        superquadric_shape.check_parameters(q_s)
        displacements = np.zeros(3 * self.nodes) if q_d is None else np.ravel(q_d)
        return np.concatenate([c, theta, q_s, displacements, np.zeros(self.dim_q)])

    def admissible(self, x: FloatArray) -> FloatArray:
        """The state with a unit quaternion, which moves nothing, and parameters in their ranges.

        A parameter that is put back to an end of its range does not go on beyond it.
        """
        before, rate = x[: self.dim_q], x[self.dim_q :].copy()
        q = within_ranges(before)
        rate[ROTATION] -= q[ROTATION] * (q[ROTATION] @ rate[ROTATION])
        rate[ROTATION] /= np.linalg.norm(before[ROTATION])
        outward = (before[GLOBAL] - q[GLOBAL]) * rate[GLOBAL] > 0.0
        rate[GLOBAL][outward] = 0.0
        return np.concatenate([q, rate])

    def position(self, x: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """Positions [m] (eq. 8) of a state or of q, of all nodes or these, shape (m, 3)."""
        return self.kinematics.position(x[: self.dim_q], nodes)

    def velocity(self, x: FloatArray) -> FloatArray:
        """Velocities [m/s] (eq. 9), shape (N, 3)."""
        return self.kinematics.velocity(*self._split(x))

    def acceleration(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Accelerations [m/s^2] (eq. 42), shape (N, 3)."""
        q, _ = self._split(x)
        steady = self.kinematics.velocity(q, self.generalised_acceleration(x, u))
        return steady + self.transport(x)

    def transport(self, x: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """L' q' [m/s^2] (eq. 43), of all nodes or these, shape (m, 3)."""
        return self.kinematics.transport(*self._split(x), nodes)

    def rotation(self, q: FloatArray) -> FloatArray:
        """R, shape (3, 3), from the frame of the body to the inertial one."""
        return rotation.matrix(q[ROTATION])

    def global_jacobian(self, q: FloatArray, nodes: IntArray | None = None) -> FloatArray:
        """The part [I B RJ] of L, shape (m, 3, 18); the rest is R at the node itself."""
        return self.kinematics.global_jacobian(q[: self.dim_q], nodes)

    def node_jacobian(self, q: FloatArray, node: int) -> FloatArray:
        """L of one node, shape (3, dim_q)."""
        result = np.zeros((3, self.dim_q))
        result[:, :LOCAL] = self.global_jacobian(q, np.array([node]))[0]
        own = LOCAL + 3 * node
        result[:, own : own + 3] = self.rotation(q)
        return result

    def generalised_acceleration(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Accelerations q'' of the coordinates (eq. 11), shape (dim_q,)."""
        q, rate = self._split(x)
        result = self._linear(q, rate)
        force = self._force(q, rate, u)
        if force.any():
            result += self.inverse_mass * self.kinematics.pulled_back(q, force)
        return result

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        _, rate = self._split(x)
        return np.concatenate([rate, self.generalised_acceleration(x, u)])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by x; the same object each time where the motion is linear."""
        q, rate = self._split(x)
        force = self._force(q, rate, u)
        if not force.any():
            return self._linear_jac
        by_q = self.kinematics.pulled_back_slope(q, force)
        by_rate = sparse.csr_array(by_q.shape)
        if self.inertial:
            weighted = self.kinematics.jacobian(q).T * -np.repeat(self.node_mass, 3)
            slopes = self.kinematics.transport_slopes(q, rate)
            by_q, by_rate = by_q + weighted @ slopes[0], weighted @ slopes[1]
        still = sparse.csr_array((self.dim_q, self.dim_x))
        scale = sparse.csr_array(sparse.diags(self.inverse_mass))
        moving = sparse.csr_array(sparse.diags(self.moving.astype(float)))
        lower = scale @ sparse.hstack([by_q, by_rate @ moving])
        return (self._linear_jac + sparse.vstack([still, lower])).tocsr()

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the forces, M^-1 L' in the lower half."""
        shares = (
            sparse.csr_array(sparse.diags(self.inverse_mass))
            @ self.kinematics.jacobian(x[: self.dim_q]).T
        )
        return sparse.vstack([sparse.csr_array(shares.shape), shares], format='csr')

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Forces are held."""
        return u

    @cached_property
    def linear_part(self) -> LinearPart:
        """All of the motion but what gravity, the input and inertial forces do, by its modes."""
        free, pull = np.flatnonzero(self.moving[:LOCAL]), np.zeros(LOCAL)
        pull[ROTATION] = PULL
        rates = np.array([free, free + self.dim_q])
        modes = [NormalModes.oscillators(rates, pull[free], self.alpha)]
        if self.moving[LOCAL:].any():
            rows = of_axes(LOCAL, self.nodes, (0, self.dim_q))
            springs = self.membrane.matrix().toarray()
            modes.append(
                NormalModes.vibrations(rows, springs, self.node_mass, self.alpha, self.beta)
            )
        return LinearPart(self._linear_jac, tuple(modes))

    def _split(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """q, and the rates of what moves."""
        return x[: self.dim_q], np.where(self.moving, x[self.dim_q :], 0.0)

    def _linear(self, q: FloatArray, rate: FloatArray) -> FloatArray:
        """What stiffness, damping and gravity make of q''."""
        result = -self.alpha * rate
        strain = self.kinematics.local(q + self.beta * rate)
        result[LOCAL:] -= self.inverse_mass[LOCAL:] * self.membrane.apply(strain).ravel()
        result[TRANSLATION] += self.gravity
        result[ROTATION] -= PULL * q[ROTATION]
        return np.asarray(result)

    def _force(self, q: FloatArray, rate: FloatArray, u: FloatArray) -> FloatArray:
        """Forces on the nodes [N], with the inertial ones if they count, shape (N, 3)."""
        force = u.reshape(-1, 3)
        if self.inertial:
            force = force - self.node_mass[:, None] * self.kinematics.transport(q, rate)
        return force

    @cached_property
    def stiffness(self) -> sparse.csr_array:
        """K [N/m], shape (dim_q, dim_q), which acts on the displacements alone."""
        local = sparse.kron(self.membrane.matrix(), sparse.csr_array(sparse.eye(3)))
        return sparse.block_diag([sparse.csr_array((LOCAL, LOCAL)), local], format='csr')

    @cached_property
    def _linear_jac(self) -> sparse.csr_array:
        springs = sparse.csr_array(sparse.diags(self.inverse_mass)) @ self.stiffness
        pull = np.zeros(self.dim_q)
        pull[ROTATION] = PULL
        moving = sparse.csr_array(sparse.diags(self.moving.astype(float)))
        slowing = self.alpha * moving + self.beta * springs @ moving
        rows = [[None, moving], [-springs - sparse.csr_array(sparse.diags(pull)), -slowing]]
        return sparse.csr_array(sparse.bmat(rows))
