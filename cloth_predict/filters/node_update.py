"""What markers tell of a belief without most correlations: the exact update, node by node."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.linear import condition, symmetric
from cloth_predict.models.superquadric import LOCAL
from cloth_predict.observations import NodePositions
from cloth_predict.types import FloatArray, Gaussian, IntArray, Observation


class Seen(NamedTuple):
    """Measurements, k values (3, or 1) at each of n places, linear in the state.

    Of several markers at a node it is their mean. nodes, shape (n,): the nodes; which, shape
    (markers,): the place of each marker; residual at the mean of the belief and variance, shape
    (n, k) each; shared, shape (n, k, g), and own, shape (k, 3): derivatives by the shared states
    and by a node's displacement; apart: normalised squared distances of the markers from the mean.
    """

    nodes: IntArray
    which: IntArray
    residual: FloatArray
    variance: FloatArray
    shared: FloatArray
    own: FloatArray
    apart: float

    @classmethod
    def of(cls, belief: BlockGaussian, obs: Observation, z: FloatArray, at: FloatArray) -> Seen:
        """Linearise an observation with independent noise at a state.

        Raises ValueError where it is not of `NodePositions`, and nodes have states of their own.
        """
        blocks, shift = belief.blocks, belief.mean - at
        if not len(blocks.own):
            return cls._of_shared(blocks, obs, z - obs.h(at), at, shift)
        if not isinstance(obs, NodePositions):
            raise ValueError('this filter takes positions of nodes of a body')
        nodes, which = np.unique(obs.nodes, return_inverse=True)
        residual, weight = (z - obs.h(at)).reshape(-1, 3), 1.0 / obs.cov.reshape(-1, 3)
        total, pooled = np.zeros((2, len(nodes), 3))
        np.add.at(total, which, weight)
        np.add.at(pooled, which, weight * residual)
        pooled /= total
        apart = float((weight * (residual - pooled[which]) ** 2).sum())
        by_coordinates, own = replace(obs, nodes=nodes).parts(at)
        shared = np.zeros((len(nodes), 3, len(blocks.shared)))
        shared[:, :, :LOCAL] = by_coordinates
        pooled -= shared @ shift[blocks.shared] + shift[blocks.own[nodes, :3]] @ own.T
        return cls(nodes, which, pooled, 1.0 / total, shared, own, apart)

    @classmethod
    def _of_shared(
        cls,
        blocks: Blocks,
        obs: Observation,
        residual: FloatArray,
        at: FloatArray,
        shift: FloatArray,
    ) -> Seen:
        """Linearise where all states are shared: each value is a place by itself."""
        jac = obs.jac(at)
        full = np.eye(blocks.dim_x)[jac] if np.issubdtype(jac.dtype, np.integer) else jac
        shared, each = np.asarray(full[:, blocks.shared], float), np.arange(len(residual))
        residual = residual - shared @ shift[blocks.shared]
        return cls(
            each, each, residual[:, None], obs.cov[:, None], shared[:, None], np.zeros((1, 3)), 0.0
        )

    def by_own(self, belief: BlockGaussian) -> FloatArray:
        """Covariance of the nodes' places, as their displacements make them, with their states.

        Shape (n, k, m).
        """
        if not len(belief.own):
            return np.zeros((*self.residual.shape, belief.own.shape[1]))
        return np.asarray(self.own @ belief.own[self.nodes, :3])

    def spread(self, belief: BlockGaussian, noise: FloatArray) -> FloatArray:
        """Covariance S of the residuals of all markers, of their noise variances, (k m,)."""
        rows = self.shared[self.which].reshape(len(noise), -1)
        total = rows @ belief.shared @ rows.T + np.diag(noise)
        if len(belief.own):
            i, j = np.nonzero(self.which[:, None] == self.which)
            places = self.by_own(belief)[:, :, :3] @ self.own.T
            total.reshape(len(self.which), 3, -1, 3)[i, :, j] += places[self.which[i]]
        return np.asarray(total)


def updated(belief: BlockGaussian, seen: Seen) -> tuple[BlockGaussian, float]:
    """Belief given what is seen, and the normalised innovation squared.

    To the shared states the displacements of the nodes are noise: D = V + R P R' of each node
    whitens its rows, a triangular factor says the same as all of them in g rows. Given the shared
    states each node is updated by itself; what is not known of them adds to its covariance. Raises
    FloatingPointError where a variance is not positive.
    """
    blocks, cross = belief.blocks, seen.by_own(belief)
    noise = (
        seen.variance[:, :, None] * np.eye(seen.variance.shape[1]) + cross[:, :, :3] @ seen.own.T
    )
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
    """Lower triangular roots, (n, k, k). Raises FloatingPointError where there is none."""
    try:
        return np.asarray(np.linalg.cholesky(noise))
    except np.linalg.LinAlgError:
        raise FloatingPointError('the innovation covariance is not positive definite') from None
