"""A Kalman filter whose covariance is full in a few smooth modes and local in what they leave.

P = B C B' + D: the columns of B are smooth spatial modes, the same for every axis, position,
velocity and force; D is one small covariance for each node, as in `fixed_gain`, for the share of
the node's variance that the modes cannot hold. Without modes it is `fixed_gain`, with all the EKF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import eigh, qr

from cloth_predict.filters.fixed_gain import NodeMotion, node_marginals, whole_nodes
from cloth_predict.filters.linear import condition, of_groups, symmetric
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import (
    Dynamics,
    Filter,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Integrator,
    Observation,
    read_only,
)


@dataclass(frozen=True)
class Modes:
    """Spatial modes, orthonormal columns, shape (nodes, rank), applied to every axis and group.

    B is I kron modes kron I3: states are [p; v; ...], each (nodes, 3), amplitudes (rank, 3).
    """

    shapes: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, 'shapes', read_only(self.shapes))

    @classmethod
    def smoothest(cls, mesh: MassSpring, rank: int) -> Modes:
        """Lowest modes of the mesh's Laplacian, with the springs' stiffness as weights and masses.

        Not those of the stiffness matrix: they would hold for one shape alone, with the axes
        mixed, and a flat surface without tension has no stiffness across it at all.
        """
        springs, nodes, free = mesh.springs, mesh.nodes, mesh.free
        weights = (springs.stiffness, (springs.pairs[:, 0], springs.pairs[:, 1]))
        graph = sparse.coo_array(weights, shape=(nodes, nodes))
        laplacian = sparse.csgraph.laplacian(graph + graph.T).toarray()[np.ix_(free, free)]
        last = min(rank, len(free)) - 1
        found = eigh(laplacian, np.diag(mesh.mass[free]), subset_by_index=(0, last))[1]
        return cls(qr(found, mode='economic')[0])

    @property
    def unresolved(self) -> FloatArray:
        """Share of the variance of each node that the modes do not hold, shape (nodes,)."""
        return np.asarray(np.maximum(1.0 - (self.shapes**2).sum(axis=1), 0.0))

    def lift(self, amplitudes: FloatArray) -> FloatArray:
        """Return B a, shape (dim_x, ...), of amplitudes (groups 3 rank, ...)."""
        return self._apply(self.shapes, amplitudes)

    def restrict(self, states: FloatArray) -> FloatArray:
        """Return B' x, shape (groups 3 rank, ...), of states (dim_x, ...)."""
        return self._apply(self.shapes.T, states)

    def covariance(self, variance: FloatArray) -> FloatArray:
        """Return B' diag(variance) B, of variances of the states, shape (dim_x,)."""
        groups, rank = variance.reshape(-1, len(self.shapes), 3), self.shapes.shape[1]
        found = np.zeros((len(groups), rank, 3, len(groups), rank, 3))
        for k, group in enumerate(groups):
            for axis in range(3):
                found[k, :, axis, k, :, axis] = (self.shapes.T * group[:, axis]) @ self.shapes
        return symmetric(found.reshape((3 * rank * len(groups),) * 2))

    @staticmethod
    def _apply(matrix: FloatArray, values: FloatArray) -> FloatArray:
        size, trailing = matrix.shape[1], values.shape[1:]
        each = matrix @ values.reshape(len(values) // (3 * size), size, -1)
        return np.asarray(each.reshape(-1, *trailing))


@dataclass(frozen=True)
class ModalBelief:
    """Mean, shape (dim_x,), and covariance B C B' + D, never made as a matrix.

    cov C, shape (groups 3 rank,) squared, of the modes' amplitudes; local D, shape (nodes, order,
    order), as in `NodeBelief`.
    """

    mean: FloatArray
    cov: FloatArray
    local: FloatArray
    modes: Modes
    motion: NodeMotion

    def __post_init__(self) -> None:
        for name in ('mean', 'cov', 'local'):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def marginals(self, rows: IntArray) -> FloatArray:
        """Covariances of k groups of m states each, rows of shape (k, m), shape (k, m, m)."""
        nodes, rank = self.modes.shapes.shape
        order, coordinate = np.divmod(rows.ravel(), 3 * nodes)
        seen = np.zeros((rows.size, len(self.mean) // (3 * nodes), rank, 3))
        seen[np.arange(rows.size), order, :, coordinate % 3] = self.modes.shapes[coordinate // 3]
        seen = seen.reshape(rows.size, -1)
        return of_groups(seen, seen @ self.cov, rows) + node_marginals(self.local, rows)


@dataclass(frozen=True)
class ReducedRank(Filter[ModalBelief]):
    """The filter on these modes."""

    integrator: Integrator
    modes: Modes

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> ModalBelief:
        """Belief before the first measurement: the prior's variances, shared out."""
        modes, variance = self.modes, np.diag(prior.cov)
        motion = NodeMotion.of(model, prior.mean, u, len(modes.shapes))
        rest = motion.per_node(variance) * modes.unresolved[:, None]
        local = rest[:, :, None] * np.eye(rest.shape[1])
        return ModalBelief(prior.mean, modes.covariance(variance), local, modes, motion)

    def predict(
        self, belief: ModalBelief, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> ModalBelief:
        """Belief dt [s] later: C by the step projected onto the modes, D by `NodeMotion`.

        The modes move by B' F B. The noise is half before and half after, see `linear.propagate`.
        """
        modes, motion = belief.modes, belief.motion
        mean, tangent = self.integrator.step_tangent(model, belief.mean, u, dt)
        step = modes.restrict(tangent.push(modes.lift(np.eye(len(belief.cov)))))
        half = modes.covariance(0.5 * dt * q)
        cov = symmetric(step @ (belief.cov + half) @ step.T) + half
        rest = motion.per_node(q) * modes.unresolved[:, None]
        return ModalBelief(mean, cov, motion.ahead(belief.local, rest, dt, 1), modes, motion)

    def update(
        self, belief: ModalBelief, obs: Observation, z: FloatArray
    ) -> tuple[ModalBelief, Innovation]:
        """Belief given z: first the modes, to which D is noise of the markers, then each node.

        What the modes then leave of the residual goes to the nodes: with S = G C G' + V the means
        move by C G' S^-1 r and D S^-1 r, and S^-1 r = V^-1 (r - G a) for the amplitudes a found.
        The correlation of modes and nodes that an update makes is left out. Raises as `FixedGain`.
        """
        nodes, noise = whole_nodes(obs, belief.mean)
        residual, local = (z - obs.h(belief.mean)).reshape(-1, 3), belief.local[nodes]
        variance, seen = local[:, 0, 0] + noise, belief.modes.shapes[nodes]
        cov = _innovation_cov(seen, belief.cov, variance)
        if not len(nodes):
            return belief, Innovation(residual.ravel(), cov, 0.0)
        found = _amplitudes(belief.cov, seen, variance, residual)
        size = 3 * seen.shape[1]
        left = (residual - seen @ found.mean[:size].reshape(-1, 3)) / variance[:, None]
        mean, rest = belief.mean + belief.modes.lift(found.mean), belief.local.copy()
        mean.reshape(rest.shape[1], -1, 3)[:, nodes] += local[:, :, 0].T[:, :, None] * left
        axes = found.cov[:size, :size].reshape(size // 3, 3, size // 3, 3)
        spread = ((seen @ (np.einsum('iaja->ij', axes) / 3)) * seen).sum(axis=1)
        told = np.maximum(1.0 / variance - spread / variance**2, 0.0)  # diagonal of S^-1
        root = local[:, :, 0] * np.sqrt(told)[:, None]
        rest[nodes] = local - root[:, :, None] * root[:, None, :]
        learnt = Innovation(residual.ravel(), cov, float((residual * left).sum()))
        return ModalBelief(mean, found.cov, rest, belief.modes, belief.motion), learnt


def _amplitudes(
    cov: FloatArray, seen: FloatArray, variance: FloatArray, residual: FloatArray
) -> Gaussian:
    """Change of the amplitudes, and their covariance, given the residual [m], (m, 3), of nodes.

    seen, shape (m, rank): the modes at these nodes; variance [m^2], shape (m,). The triangular
    factor of the white modes says the same in as many rows as there are modes.
    """
    sigma = np.sqrt(variance)[:, None]
    turn, factor = qr(seen / sigma, mode='economic')
    jac = np.zeros((3 * len(factor), len(cov)))
    jac[:, : 3 * seen.shape[1]] = np.kron(factor, np.eye(3))
    prior, white = Gaussian(np.zeros(len(cov)), cov), (turn.T @ (residual / sigma)).ravel()
    return condition(prior, jac, np.ones(len(jac)), white)[0]


def _innovation_cov(seen: FloatArray, cov: FloatArray, variance: FloatArray) -> FloatArray:
    """Return S = G C G' + V of the nodes seen, shape (3 m, 3 m)."""
    rank, size = seen.shape[1], 3 * len(seen)
    positions = cov[: 3 * rank, : 3 * rank].reshape(rank, 3, rank, 3)
    both = np.tensordot(np.tensordot(seen, positions, 1), seen, (2, 1))  # node, axis, axis, node
    return both.transpose(0, 1, 3, 2).reshape(size, size) + np.diag(np.repeat(variance, 3))
