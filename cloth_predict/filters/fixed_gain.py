"""An observer with a small covariance of its own for every node: cost linear in the nodes.

The mean moves by the whole model's step; what a marker tells goes to its own node only. The gain
of a node that stays visible becomes the constant one of the discrete Riccati equation. That of a
node which was hidden is larger on its return, as its covariance has grown meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cloth_predict.filters.linear import symmetric
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Integrator,
    Observation,
    read_only,
)

SLOWEST = 1e-9
"""Rate [1/s] added to the damping, so that the effective one exists where there is none."""


@dataclass(frozen=True)
class NodeMotion:
    """One coordinate of each node by itself: y' = A y + noise, y = (position, velocity, force..).

    drift A, shape (nodes, order, order): p' = v, v' = -c v + F / m, and the process of the force.
    c is the damping that a push on this node alone meets while its neighbours follow,
    1 / (D^-1)_ii of the model's damping matrix D [1/s], averaged over the axes.

    Springs are left out: with its neighbours held a node would be far stiffer than the surface is,
    and the gain too small to follow it. Across a hanging sheet a node is nearly free over a tenth
    of a second; along the sheet the variance is too large, which is on the safe side.
    """

    drift: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, 'drift', read_only(self.drift))

    @classmethod
    def of(cls, model: Dynamics, x: FloatArray, u: FloatArray, nodes: int) -> NodeMotion:
        """Read it off a model's Jacobian; states are [p; v; ...], each of shape (3 nodes,)."""
        jac, size = model.jac(x, u), 3 * nodes
        order = model.dim_x // size
        drift = np.empty((nodes, order, order))
        for row in range(order):
            for col in range(order):
                entries = jac.diagonal((col - row) * size)[min(row, col) * size :][:size]
                drift[:, row, col] = entries.reshape(-1, 3).mean(axis=1)
        velocity = jac[size : 2 * size, size : 2 * size]
        damping = -sum(velocity[axis::3, axis::3].toarray() for axis in range(3)) / 3
        follow = np.linalg.inv(damping + SLOWEST * np.eye(nodes))
        drift[:, 1, :2] = 0.0
        drift[:, 1, 1] = -1.0 / np.diag(follow)
        return cls(drift)

    def per_node(self, values: FloatArray) -> FloatArray:
        """Mean over the axes of values of the states, shape (dim_x,), as (nodes, order)."""
        nodes, order, _ = self.drift.shape
        return np.asarray(values.reshape(order, nodes, 3).mean(axis=2).T)

    def ahead(self, cov: FloatArray, noise: FloatArray, dt: float, steps: int) -> FloatArray:
        """Covariances (nodes, order, order) after implicit Euler steps of dt [s].

        noise, shape (nodes, order): spectral densities; half before and half after a step, as in
        `linear.propagate`.
        """
        identity = np.eye(self.drift.shape[1])
        step = np.linalg.inv(identity - dt * self.drift)
        half = 0.5 * dt * noise[:, :, None] * identity
        for _ in range(steps):
            cov = symmetric(step @ (cov + half) @ step.transpose(0, 2, 1)) + half
        return cov


@dataclass(frozen=True)
class NodeBelief:
    """Mean, shape (dim_x,), and of each node the covariance of one coordinate and its rates.

    cov, shape (nodes, order, order), serves all three axes; between axes and nodes it is zero.
    """

    mean: FloatArray
    cov: FloatArray
    motion: NodeMotion

    def __post_init__(self) -> None:
        object.__setattr__(self, 'mean', read_only(self.mean))
        object.__setattr__(self, 'cov', read_only(self.cov))

    def marginals(self, rows: IntArray) -> FloatArray:
        """Covariances of k groups of m states each, rows of shape (k, m), shape (k, m, m)."""
        return node_marginals(self.cov, rows)


@dataclass(frozen=True)
class FixedGain:
    """The observer of a surface with this many free `nodes`."""

    integrator: Integrator
    nodes: int

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> NodeBelief:
        """Belief before the first measurement: the prior's variances, averaged over the axes."""
        motion = NodeMotion.of(model, prior.mean, u, self.nodes)
        variance = motion.per_node(np.diag(prior.cov))
        return NodeBelief(prior.mean, variance[:, :, None] * np.eye(variance.shape[1]), motion)

    def predict(
        self, belief: NodeBelief, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> NodeBelief:
        """Belief dt [s] later: the mean by the model's step, each covariance by `NodeMotion`."""
        motion = belief.motion
        mean = self.integrator.step(model, belief.mean, u, dt)
        return NodeBelief(mean, motion.ahead(belief.cov, motion.per_node(q), dt, 1), motion)

    def forecast(
        self,
        belief: NodeBelief,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (dim_x,), and covariances of `rows` after one step of dt [s] per input."""
        mean, motion = belief.mean, belief.motion
        for u in inputs:
            mean = self.integrator.step(model, mean, u, dt)
        cov = motion.ahead(belief.cov, motion.per_node(q), dt, len(inputs))
        return mean, node_marginals(cov, rows)

    def update(
        self, belief: NodeBelief, obs: Observation, z: FloatArray
    ) -> tuple[NodeBelief, Innovation]:
        """Belief given z: the Kalman update of every node seen by its own marker.

        The innovation's covariance is diagonal. Raises ValueError where the observation is not of
        whole nodes, FloatingPointError where a variance is not positive.
        """
        nodes, noise = whole_nodes(obs, belief.mean)
        residual, prior = z - obs.h(belief.mean), belief.cov[nodes]
        variance = prior[:, 0, 0] + noise
        if not (variance > 0).all():
            raise FloatingPointError('the innovation covariance is not positive definite')
        sigma = np.sqrt(variance)[:, None]
        white, gain_root = residual.reshape(-1, 3) / sigma, prior[:, :, 0] / sigma
        cov, mean = belief.cov.copy(), belief.mean.copy()
        cov[nodes] = prior - gain_root[:, :, None] * gain_root[:, None, :]
        mean.reshape(cov.shape[1], -1, 3)[:, nodes] += gain_root.T[:, :, None] * white
        learnt = Innovation(residual, np.diag(np.repeat(variance, 3)), float((white**2).sum()))
        return NodeBelief(mean, cov, belief.motion), learnt


def node_marginals(cov: FloatArray, rows: IntArray) -> FloatArray:
    """Covariances (k, m, m) of states `rows`, (k, m), from those of nodes, see `NodeBelief`."""
    order, coordinate = np.divmod(rows, 3 * len(cov))
    same = coordinate[:, :, None] == coordinate[:, None, :]
    node = coordinate[:, :, None] // 3
    return np.where(same, cov[node, order[:, :, None], order[:, None, :]], 0.0)


def whole_nodes(obs: Observation, mean: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the nodes whose positions are seen, shape (m,), and their noise variances [m^2].

    Raises ValueError where the observation is something else, or correlates what it sees.
    """
    rows = obs.jac(mean)
    nodes = np.asarray(rows.ravel()[::3] // 3, np.int64)
    if not np.array_equal(rows, (3 * nodes[:, None] + np.arange(3)).ravel()) or obs.cov.ndim > 1:
        raise ValueError('this filter takes the positions of whole nodes with independent noise')
    return nodes, obs.cov.reshape(-1, 3).mean(axis=1)
