"""The continuous Kalman filter of Metaxas & Terzopoulos 1993 (eq. 37 and 38), and its steps.

A measurement acts all the time: its noise V is a spectral density, [m^2 s] of positions, and z is
held over a frame. Both steps serve a full covariance and one of blocks (section V.C).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.decoupled import Decoupled
from cloth_predict.filters.node_update import Seen, updated
from cloth_predict.integrators.exponential import Exponential
from cloth_predict.types import Dynamics, FloatArray, Observation

Rates = tuple[FloatArray, FloatArray, FloatArray]
"""Of the mean, (dim_x,), and of the covariances of the blocks, (g, g) and (nodes, m, m)."""


@dataclass(frozen=True)
class Continuous:
    """The filter on these blocks, in steps of at most `step` [s].

    `euler` is eq. 39: of first order, and unstable where a step times a rate of P H' V^-1 H or
    of F is above 2. `splitting` moves by the model for half a step, takes the measurement, and
    moves for the rest: exact in the linear part of the model, and in the measurement where that is
    linear, whatever the rates. It is of second order with a full covariance, of first where
    correlations are dropped, as it drops them once in a step.
    """

    blocks: Blocks
    step: float
    scheme: Literal['splitting', 'euler'] = 'splitting'

    def follow(
        self,
        belief: BlockGaussian,
        model: Dynamics,
        u: FloatArray,
        q: FloatArray,
        obs: Observation,
        z: FloatArray,
        duration: float,
    ) -> BlockGaussian:
        """Belief `duration` [s] later, while z is measured.

        u, shape (dim_u,), and the spectral density of the process noise q, shape (dim_x,), are
        held too; the variances of the observation are the spectral density of its noise.
        """
        steps = ceil(duration / self.step - 1e-6)  # but for rounding of the quotient
        dt = duration / steps
        for _ in range(steps):
            if self.scheme == 'euler':
                mean, shared, own = rates(belief, model, u, q, obs, z)
                belief = self.blocks.belief(
                    belief.mean + dt * mean, belief.shared + dt * shared, belief.own + dt * own
                )
            else:
                belief = self._split(belief, model, u, q, obs, z, dt)
        return belief

    def _split(
        self,
        belief: BlockGaussian,
        model: Dynamics,
        u: FloatArray,
        q: FloatArray,
        obs: Observation,
        z: FloatArray,
        dt: float,
    ) -> BlockGaussian:
        """Half a step of the model, all of the measurement, and the other half."""
        kalman = Decoupled(Exponential(), self.blocks)
        half = kalman.predict(belief, model, u, q, dt / 2)
        seen = Seen.of(half, obs, z, half.mean)
        # linearised in its middle, the measurement is of second order too
        middle = (half.mean + updated(half, over(seen, dt))[0].mean) / 2
        after, _ = updated(half, over(Seen.of(half, obs, z, middle), dt))
        return kalman.predict(after, model, u, q, dt / 2)


def over(seen: Seen, dt: float) -> Seen:
    """What a measurement tells that acts for dt [s]: eq. 37 and 38 without F are an update by it.

    P^-1 grows by H' V^-1 H dt, as of a measurement with the noise V / dt.
    """
    return seen._replace(variance=seen.variance / dt)


def rates(
    belief: BlockGaussian,
    model: Dynamics,
    u: FloatArray,
    q: FloatArray,
    obs: Observation,
    z: FloatArray,
) -> Rates:
    """Right-hand sides of eq. 37 and of the blocks of eq. 38."""
    blocks, seen = belief.blocks, Seen.of(belief, obs, z, belief.mean)
    mean = model.f(belief.mean, u) + force(belief, seen)
    jac = model.jac(belief.mean, u)
    drift = jac[blocks.shared][:, blocks.shared] @ belief.shared
    noise, own_noise = blocks.diagonal(q)
    weighted = seen.shared / np.sqrt(seen.variance)[:, :, None]
    known = weighted.reshape(-1, len(blocks.shared)) @ belief.shared
    shared = drift + drift.T + noise - known.T @ known
    own = own_noise
    if len(blocks.own):
        dense = jac.toarray()
        moved = dense[blocks.own[:, :, None], blocks.own[:, None]] @ belief.own
        own = moved + moved.transpose(0, 2, 1) + own_noise
        told = seen.by_own(belief) / np.sqrt(seen.variance)[:, :, None]
        own[seen.nodes] -= told.transpose(0, 2, 1) @ told
    return mean, shared, own


def force(belief: BlockGaussian, seen: Seen) -> FloatArray:
    """P H' V^-1 (z - h), shape (dim_x,): for P = I the force of the data on the model (eq. 16)."""
    blocks, pull = belief.blocks, seen.residual / seen.variance
    result = np.zeros(blocks.dim_x)
    result[blocks.shared] = belief.shared @ np.einsum('nkg,nk->g', seen.shared, pull)
    if len(blocks.own):
        result[blocks.own[seen.nodes]] = np.einsum('nkm,nk->nm', seen.by_own(belief), pull)
    return result
