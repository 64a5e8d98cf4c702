"""A Kalman filter of a body that drops correlations (Metaxas & Terzopoulos 1993, V.C).

The local displacements of each node are correlated among themselves alone, the states that all
nodes share among themselves, or only within translation, rotation and global deformation. Each
prediction and each update is the exact one of such a belief; the correlations that it makes are
then dropped. Of all beliefs without them that is the nearest one (Kullback & Leibler).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cloth_predict.exponential import ExponentialTangent
from cloth_predict.filters.ahead import run_ahead
from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.linear import condition, of_groups, symmetric
from cloth_predict.models.superquadric import GLOBAL, LOCAL
from cloth_predict.observations import NodePositions
from cloth_predict.types import (
    Belief,
    Dynamics,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Integrator,
    Observation,
    Tangent,
)


@dataclass(frozen=True)
class Decoupled:
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

    def forecast(
        self,
        belief: BlockGaussian,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (dim_x,), and covariances of `rows` after one step of dt [s] per input."""
        return run_ahead(self, belief, model, inputs, q, dt, rows)

    def update(
        self, belief: BlockGaussian, obs: Observation, z: FloatArray
    ) -> tuple[BlockGaussian, Innovation]:
        """Belief given z, shape (3m,), of `NodePositions`, at a cost linear in the markers.

        What is learnt is told by the first linearisation. Raises ValueError where the observation
        is another one, FloatingPointError where a variance is not positive.
        """
        if not isinstance(obs, NodePositions):
            raise ValueError('this filter takes positions of nodes of a body')
        if not len(z):
            return belief, Innovation(z, np.zeros((0, 0)), 0.0)
        first = _Seen.of(belief, obs, z, belief.mean)
        after, nis = _updated(belief, first)
        for _ in range(1, self.iterations):
            at = after.mean.copy()
            at[GLOBAL] = obs.body.admissible(at)[GLOBAL]
            after, _ = _updated(belief, _Seen.of(belief, obs, z, at))
        residual = z - obs.h(belief.mean)
        return after, Innovation(residual, first.spread(belief, obs.cov), nis)


class _Seen(NamedTuple):
    """Markers of n nodes, as a measurement that is linear in the state: of each node the mean.

    nodes, shape (n,); which, shape (markers,): of them each marker has; residual at the mean of
    the belief, shape (n, 3), and variance, shape (n, 3); shared, shape (n, 3, g), and own, shape
    (3, 3): the derivatives by the shared states and by a node's displacement; apart: the markers'
    normalised squared distances from the means.
    """

    nodes: IntArray
    which: IntArray
    residual: FloatArray
    variance: FloatArray
    shared: FloatArray
    own: FloatArray
    apart: float

    @classmethod
    def of(cls, belief: BlockGaussian, obs: NodePositions, z: FloatArray, at: FloatArray) -> _Seen:
        """Linearise at a state."""
        blocks, shift = belief.blocks, belief.mean - at
        nodes, which = np.unique(obs.nodes, return_inverse=True)
        residual, weight = (z - obs.h(at)).reshape(-1, 3), 1.0 / obs.cov.reshape(-1, 3)
        total, pooled = np.zeros((2, len(nodes), 3))
        np.add.at(total, which, weight)
        np.add.at(pooled, which, weight * residual)
        pooled /= total
        apart = float((weight * (residual - pooled[which]) ** 2).sum())
        seen = replace(obs, nodes=nodes)
        if len(blocks.own):
            by_coordinates, own = seen.parts(at)
            shared = np.zeros((len(nodes), 3, len(blocks.shared)))
            shared[:, :, :LOCAL] = by_coordinates
            pooled -= shift[blocks.own[nodes, :3]] @ own.T
        else:
            own, shared = np.zeros((3, 3)), seen.jac(at)[:, blocks.shared]
            shared = shared.reshape(len(nodes), 3, -1)
        pooled -= shared @ shift[blocks.shared]
        return cls(nodes, which, pooled, 1.0 / total, shared, own, apart)

    def by_own(self, belief: BlockGaussian) -> FloatArray:
        """Covariance of the nodes' places, as their displacements make them, with their states.

        Shape (n, 3, m).
        """
        if not len(belief.own):
            return np.zeros((len(self.nodes), 3, belief.own.shape[1]))
        return np.asarray(self.own @ belief.own[self.nodes, :3])

    def spread(self, belief: BlockGaussian, noise: FloatArray) -> FloatArray:
        """Covariance S of the markers' residuals, shape (3m, 3m), of noise variances, (3m,)."""
        number, shared = len(self.which), self.shared[self.which]
        rows = shared.reshape(3 * number, -1)
        total = rows @ belief.shared @ rows.T + np.diag(noise)
        i, j = np.nonzero(self.which[:, None] == self.which)
        places = self.by_own(belief)[:, :, :3] @ self.own.T
        total.reshape(number, 3, number, 3)[i, :, j] += places[self.which[i]]
        return total


def _updated(belief: BlockGaussian, seen: _Seen) -> tuple[BlockGaussian, float]:
    """Belief given what is seen, and the normalised innovation squared.

    To the shared states the displacements of the nodes are noise: D = V + R P R' of each node
    whitens its rows, a triangular factor says the same as all of them in g rows. Given the shared
    states each node is updated by itself; what is not known of them adds to its covariance.
    """
    blocks, cross = belief.blocks, seen.by_own(belief)
    noise = seen.variance[:, :, None] * np.eye(3) + cross[:, :, :3] @ seen.own.T
    white = np.linalg.inv(_roots(noise))
    gain_root, rows = white @ cross, white @ seen.shared
    residual = (white @ seen.residual[:, :, None])[:, :, 0]
    size = len(blocks.shared)
    stacked = np.column_stack([rows.reshape(-1, size), residual.ravel()])
    factor = np.asarray(np.linalg.qr(stacked, mode='r'))
    prior = Gaussian(np.zeros(size), belief.shared)
    told = factor[:size]
    found, learnt = condition(prior, told[:, :size], np.ones(len(told)), told[:, size])
    mean, own = belief.mean.copy(), belief.own.copy()
    mean[blocks.shared] += found.mean
    if len(own):
        left = residual - rows @ found.mean
        mean[blocks.own[seen.nodes]] += (gain_root.transpose(0, 2, 1) @ left[:, :, None])[:, :, 0]
        follow = gain_root.transpose(0, 2, 1) @ rows
        own[seen.nodes] -= gain_root.transpose(0, 2, 1) @ gain_root
        own[seen.nodes] += symmetric(follow @ found.cov @ follow.transpose(0, 2, 1))
    nis = learnt.nis + float((factor[size:, size] ** 2).sum()) + seen.apart
    return blocks.belief(mean, found.cov, own), nis


def _roots(noise: FloatArray) -> FloatArray:
    """Lower triangular roots, (n, 3, 3). Raises FloatingPointError where there is none."""
    try:
        return np.asarray(np.linalg.cholesky(noise))
    except np.linalg.LinAlgError:
        raise FloatingPointError('the innovation covariance is not positive definite') from None


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
    jac = np.concatenate([shared, np.broadcast_to(own, (len(shared), 3, 3))], axis=2)
    rows = np.empty((len(shared), LOCAL + 3), np.int64)
    rows[:, :LOCAL] = np.arange(LOCAL)
    rows[:, LOCAL:] = LOCAL + 3 * obs.nodes[:, None] + np.arange(3)
    return symmetric(jac @ belief.marginals(rows) @ jac.transpose(0, 2, 1))
