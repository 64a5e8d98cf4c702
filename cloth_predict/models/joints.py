"""Points that bodies share, and the forces that keep them together (M. & T. 1993, section III.A).

A joint is a constraint C = x_A - x_B = 0 (eq. 31).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from cloth_predict.errors import ConfigError
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.types import FloatArray, Solver

DEPENDENT = 1e-12
"""Share of a direction of a joint, squared, that the joints before it have to leave open. That of
what is held twice is rounding, some 1e-16, where it does not come out negative."""
NAMED = 1e-3
"""Share in a motion that is held twice from which on a joint is named."""


@dataclass(frozen=True)
class Joint:
    """Node `node_a` of part `part_a` and node `node_b` of part `part_b` stay at one point."""

    part_a: int
    node_a: int
    part_b: int
    node_b: int

    def __str__(self) -> str:
        return (
            f'node {self.node_a} of part {self.part_a} at node {self.node_b} of part {self.part_b}'
        )

    @property
    def ends(self) -> tuple[tuple[int, int, float], tuple[int, int, float]]:
        """Part, node, and sign in C, of both points."""
        return (self.part_a, self.node_a, 1.0), (self.part_b, self.node_b, -1.0)


class Joints:
    """k joints between bodies, whose coordinates are stacked: q = [q_1 .. q_n]."""

    def __init__(self, bodies: Sequence[Superquadric], joints: Sequence[Joint]) -> None:
        """Take the bodies and joints; ConfigError where a joint names what is missing."""
        self.bodies, self.joints = tuple(bodies), tuple(joints)
        for index, joint in enumerate(self.joints):
            self._check(index, joint)
        self.coordinates = _slices([body.dim_q for body in self.bodies])
        """Where the coordinates of each body are in q."""
        self.inputs = _slices([body.dim_u for body in self.bodies])
        """Where the forces on each body's nodes are in those on all."""

    @property
    def dim_q(self) -> int:
        """Number of coordinates of all bodies."""
        return sum(body.dim_q for body in self.bodies)

    @property
    def dim_u(self) -> int:
        """Three forces per node."""
        return sum(body.dim_u for body in self.bodies)

    @cached_property
    def incidence(self) -> sparse.csr_array:
        """Signs of the nodes' coordinates in C, shape (3k, dim_u)."""
        result = sparse.dok_array((3 * len(self.joints), self.dim_u))
        for j, joint in enumerate(self.joints):
            for part, node, sign in joint.ends:
                column = self.inputs[part].start + 3 * node
                for axis in range(3):
                    result[3 * j + axis, column + axis] = sign
        return result.tocsr()

    def position(self, q: FloatArray) -> FloatArray:
        """Positions [m] of the nodes, one body after the other, shape (nodes, 3)."""
        return np.concatenate([body.position(q[at]) for body, at in self._each])

    def violation(self, q: FloatArray) -> FloatArray:
        """C [m], shape (3k,)."""
        return np.asarray(self.incidence @ self.position(q).ravel())

    def jacobian(self, q: FloatArray) -> FloatArray:
        """C_q, shape (3k, dim_q)."""
        result = np.zeros((len(self.joints), 3, self.dim_q))
        for j, joint in enumerate(self.joints):
            for part, node, sign in joint.ends:
                body, at = self._each[part]
                result[j, :, at] += sign * body.node_jacobian(q[at], node)
        return result.reshape(-1, self.dim_q)

    def transport(self, q: FloatArray, rate: FloatArray) -> FloatArray:
        """C_q' q' [m/s^2], shape (3k,)."""
        nodes = [body.kinematics.transport(q[at], rate[at]) for body, at in self._each]
        return np.asarray(self.incidence @ np.concatenate(nodes).ravel())

    def transport_slopes(self, q: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of C_q' q' by q and by q', (3k, dim_q) each."""
        slopes = [body.kinematics.transport_slopes(q[at], rate[at]) for body, at in self._each]
        by_q, by_rate = (sparse.block_diag(half) for half in zip(*slopes, strict=True))
        return (self.incidence @ by_q).toarray(), (self.incidence @ by_rate).toarray()

    def velocity_slope(self, q: FloatArray, rate: FloatArray) -> FloatArray:
        """Derivative of C_q q' by q with the rates q' held, shape (3k, dim_q).

        C_q' q' is a quadratic form of the rates: twice this is its derivative by them.
        """
        return 0.5 * self.transport_slopes(q, rate)[1]

    def on_nodes(self, force: FloatArray) -> FloatArray:
        """The joints' forces f_c [N], (3k,), as forces on the nodes, shape (dim_u,)."""
        return np.asarray(self.incidence.T @ force)

    def pulled_back_slope(self, q: FloatArray, force: FloatArray) -> sparse.csr_array:
        """Derivative of C_q'f by q with the joints' forces f [N], (3k,), held, (dim_q, dim_q)."""
        on_nodes = self.on_nodes(force)
        slopes = [
            body.kinematics.pulled_back_slope(q[at], on_nodes[own].reshape(-1, 3))
            for (body, at), own in zip(self._each, self.inputs, strict=True)
        ]
        return sparse.block_diag(slopes, format='csr')

    def at(self, q: FloatArray, mobility: FloatArray) -> Linkage:
        """The joints at q, where a generalised force moves q by the mobility, (dim_q,)."""
        return Linkage(self.joints, self.jacobian(q), mobility)

    @property
    def _each(self) -> list[tuple[Superquadric, slice]]:
        return list(zip(self.bodies, self.coordinates, strict=True))

    def _check(self, index: int, joint: Joint) -> None:
        for part, node, _ in joint.ends:
            if not 0 <= part < len(self.bodies):
                raise ConfigError(
                    f'joint {index}: there is no part {part}, '
                    f'the parts are 0 to {len(self.bodies) - 1}'
                )
            if not 0 <= node < self.bodies[part].nodes:
                raise ConfigError(
                    f'joint {index}: part {part} has no node {node}, '
                    f'its nodes are 0 to {self.bodies[part].nodes - 1}'
                )
        if (joint.part_a, joint.node_a) == (joint.part_b, joint.node_b):
            raise ConfigError(
                f'joint {index}: node {joint.node_a} of part {joint.part_a} is joined to itself'
            )


@dataclass(frozen=True)
class Linkage:
    """Joints in one configuration: what their forces do, and how large they have to be."""

    joints: tuple[Joint, ...]
    rows: FloatArray
    """C_q, shape (3k, dim_q)."""
    mobility: FloatArray
    """Diagonal of M^-1, or of D^-1 where there is no inertia, shape (dim_q,)."""

    @cached_property
    def solve(self) -> Solver:
        """Solver of N = C_q M^-1 C_q' (eq. 33); ConfigError where N is singular."""
        matrix = (self.rows * self.mobility) @ self.rows.T
        if not len(matrix):
            return np.array  # no joints, no forces; LAPACK takes no empty matrix in older scipy
        try:
            factor = linalg.cholesky(matrix, lower=True)
        except linalg.LinAlgError:
            raise self._dependent(matrix) from None
        if np.any(np.diag(factor) ** 2 < DEPENDENT * np.diag(matrix)):
            raise self._dependent(matrix)
        return lambda b: np.asarray(linalg.cho_solve((factor, True), b))

    def moved(self, force: FloatArray) -> FloatArray:
        """M^-1 C_q' f: what forces of the joints, (3k,), do to the coordinates, (dim_q,)."""
        return np.asarray(self.mobility * (self.rows.T @ force))

    def held(self, change: sparse.csr_array, steady: FloatArray | float = 0.0) -> sparse.csr_array:
        """A change of q'' without joints, (dim_q, m), less what the joints do not let happen.

        steady, shape (3k, m): change of what else counts in r (eq. 34).
        """
        force = self.solve(self.rows @ change + steady)
        pull = sparse.csr_array(self.mobility[:, None] * self.rows.T)
        return (change - pull @ sparse.csr_array(force)).tocsr()

    def _dependent(self, matrix: FloatArray) -> ConfigError:
        scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
        null = linalg.eigh(scale * matrix * scale[:, None])[1][:, 0].reshape(-1, 3)
        share = np.linalg.norm(null, axis=1)
        named = np.flatnonzero(share > NAMED * share.max())
        names = ', '.join(str(j) for j in named)
        held = '; '.join(str(self.joints[j]) for j in named)
        return ConfigError(
            f'joints {names} depend on each other, or hold what cannot move: {held}'
        )


def _slices(sizes: Sequence[int]) -> list[slice]:
    return [slice(*pair) for pair in itertools.pairwise(np.cumsum([0, *sizes]).tolist())]
