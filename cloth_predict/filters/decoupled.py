"""A Kalman filter of a body that drops correlations (Metaxas & Terzopoulos 1993, V.C).

The local displacements of each node are correlated among themselves alone, the states that all
nodes share among themselves, or only within translation, rotation and global deformation. Each
prediction and each update is the exact one of such a belief; the correlations that it makes are
then dropped. Of all beliefs without them that is the nearest one (Kullback & Leibler).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.linear import of_groups, symmetric
from cloth_predict.filters.node_update import Seen, updated
from cloth_predict.integrators.exponential import ExponentialTangent
from cloth_predict.models.superquadric import GLOBAL, LOCAL
from cloth_predict.observations import NodePositions
from cloth_predict.types import (
    Belief,
    Dynamics,
    Filter,
    FloatArray,
    Gaussian,
    Innovation,
    Integrator,
    Observation,
    Tangent,
)


@dataclass(frozen=True)
class Decoupled(Filter[BlockGaussian]):
    """The filter on these blocks.

    iterations: linearisations of an update, each at what the last one found (Gauss-Newton); more
    than one are for measurements that turn or stretch the body by much.
    """

    integrator: Integrator
    blocks: Blocks
    iterations: int = 1

    def start(
        self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray
    ) -> BlockGaussian:
        """Belief before the first measurement: the blocks of the prior."""
        return self.blocks.of(prior.mean, prior.cov)

    def predict(
        self, belief: BlockGaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> BlockGaussian:
        """Belief dt [s] later; noise half before the step and half after, as `linear.propagate`.

        Where the model is linear and its step exponential, the cost is that of the blocks. Else
        the derivative of the step is made as a matrix, as in the full filter.
        """
        mean, tangent = self.integrator.step_tangent(model, belief.mean, u, dt)
        shared, own = self.blocks.diagonal(0.5 * dt * q)
        wider = belief.shared + shared, belief.own + own
        if isinstance(tangent, ExponentialTangent) and tangent.linear:
            after = _by_modes(self.blocks, tangent, *wider)
        else:
            after = _by_matrix(self.blocks, tangent, *wider)
        return self.blocks.belief(mean, after[0] + shared, after[1] + own)

    def update(
        self, belief: BlockGaussian, obs: Observation, z: FloatArray
    ) -> tuple[BlockGaussian, Innovation]:
        """Belief given z, of markers at nodes at a cost linear in their number.

        What is learnt is told by the first linearisation. Raises as `Seen.of` and `updated`.
        """
        if not len(z):
            return belief, Innovation(z, np.zeros((0, 0)), 0.0)
        first = Seen.of(belief, obs, z, belief.mean)
        after, nis = updated(belief, first)
        for _ in range(1, self.iterations):
            at = after.mean
            if isinstance(obs, NodePositions):
                at = np.concatenate(
                    [at[: GLOBAL.start], obs.body.admissible(at)[GLOBAL], at[LOCAL:]]
                )
            after, _ = updated(belief, Seen.of(belief, obs, z, at))
        residual = z - obs.h(belief.mean)
        return after, Innovation(residual, first.spread(belief, obs.cov), nis)


def _by_modes(
    blocks: Blocks, tangent: ExponentialTangent, shared: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Blocks of F P F' for F = exp(dt A): displacements act on each other alone, axis by axis."""
    step = tangent.part.submatrix('exp', tangent.dt, blocks.shared)
    after = symmetric(step @ shared @ step.T)
    if not len(own):
        return after, own
    nodes, size = len(own), blocks.own.shape[1] // 3
    local = next(modes for modes in tangent.part.modes if modes.shapes is not None)
    steps = local.matrix('exp', tangent.dt)
    # sum over nodes j and their states of F[i, j] P[j] F[i, j]', by one product for each pair
    by_axes = own.reshape(nodes, size, 3, size, 3).transpose(1, 3, 0, 2, 4).reshape(-1, 9)
    moved = np.empty((size, size, nodes, 3, 3))
    for k in range(size):
        for m in range(k + 1):
            pairs = steps[k][:, :, None] * steps[m][:, None]
            moved[k, m] = (pairs.reshape(nodes, -1) @ by_axes).reshape(nodes, 3, 3)
            moved[m, k] = moved[k, m].transpose(0, 2, 1)
    return after, moved.transpose(2, 0, 3, 1, 4).reshape(own.shape)


def _by_matrix(
    blocks: Blocks, tangent: Tangent, shared: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Blocks of F P F' for any F."""
    step = tangent.push(np.eye(blocks.dim_x))
    by_shared, by_own = step[:, blocks.shared], step[:, blocks.own]
    moved = (by_own.transpose(1, 0, 2) @ own).transpose(1, 0, 2)
    left = np.hstack([by_shared @ shared, moved.reshape(len(step), -1)])
    right = np.hstack([by_shared, by_own.reshape(len(step), -1)])
    rows = blocks.own.ravel()
    return (
        symmetric(left[blocks.shared] @ right[blocks.shared].T),
        symmetric(of_groups(left[rows], right[rows], blocks.own)),
    )


def position_covariances(belief: Belief, obs: NodePositions) -> FloatArray:
    """Covariance of the position of each node that `obs` sees [m^2], without noise, (m, 3, 3)."""
    shared, own = obs.parts(belief.mean)
    if isinstance(belief, BlockGaussian) and len(belief.own):  # the same, without the zeros
        of_node = own @ belief.own[obs.nodes, :3, :3] @ own.T
        common = belief.shared[:LOCAL, :LOCAL]
        return symmetric(shared @ common @ shared.transpose(0, 2, 1) + of_node)
    jac = np.concatenate([shared, np.broadcast_to(own, (len(shared), 3, 3))], axis=2)
    rows = np.empty((len(shared), LOCAL + 3), np.int64)
    rows[:, :LOCAL] = np.arange(LOCAL)
    rows[:, LOCAL:] = LOCAL + 3 * obs.nodes[:, None] + np.arange(3)
    return symmetric(jac @ belief.marginals(rows) @ jac.transpose(0, 2, 1))
