"""Our estimator on the paper's data: a discrete filter of the second-order model, true noise.

Its noise was set on other motions of the object than those of the tables.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cloth_predict.experiments.metaxas1993.recipe import Attach
from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.decoupled import Decoupled, position_covariances
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models.superquadric import GLOBAL, LOCAL, ROTATION, TRANSLATION, Superquadric
from cloth_predict.models.superquadric_shape import PARAMETERS
from cloth_predict.observations import NodePositions
from cloth_predict.types import FloatArray, IntArray

ITERATIONS = 8
"""Linearisations of an update: the first frames turn and stretch the body by much."""
LEAST_NOISE = 1e-3
"""Standard deviation that exact data are taken to have."""


@dataclass(frozen=True)
class Settings:
    """Standard deviations at first, and of what is unknown, in units of a0 and of 1.

    translation, rotation, shape: at first, lengths among the shape parameters by `length`; still:
    rates at first; push, turn, reshape: roots of the spectral densities of the accelerations of
    the centre, the quaternion and the shape; local: displacement of a node in the long run, and
    first: the share of it that there is at first.
    """

    translation: float = 0.5
    rotation: float = 0.2
    shape: float = 0.3
    length: float = 1.0
    still: float = 0.02
    push: float = 0.2
    turn: float = 0.1
    reshape: float = 0.5
    local: float = 0.1
    first: float = 0.3


@dataclass(frozen=True)
class Ours:
    """The filter for points with a noise of sigma on each coordinate, `interval` [s] apart."""

    sigma: float
    interval: float
    settings: Settings = Settings()

    def frames(
        self,
        body: Superquadric,
        x: FloatArray,
        points: Sequence[FloatArray],
        attach: Sequence[IntArray] | Attach,
    ) -> Iterator[BlockGaussian]:
        """Belief after each frame, from a state x at first.

        points, of each frame, (m, 3); attach: their nodes, or what finds them for each frame.
        """
        blocks = Blocks.of_body(body, 'pose')
        kalman = Decoupled(INTEGRATORS['exponential'], blocks, ITERATIONS)
        belief, still = self.start(body, blocks, x), np.zeros(body.dim_u)
        density = self.density(body)
        for k, z in enumerate(points):
            if k:
                belief = kalman.predict(belief, body, still, density, self.interval)
            belief = self._taken(
                kalman, body, belief, z, attach if callable(attach) else attach[k]
            )
            yield belief

    def _taken(
        self,
        kalman: Decoupled,
        body: Superquadric,
        belief: BlockGaussian,
        z: FloatArray,
        attach: IntArray | Attach,
    ) -> BlockGaussian:
        """The belief after a frame; what is attached by nearness is so again until it stays."""
        nodes = attach(body.position(belief.mean), z) if callable(attach) else attach
        for _ in range(ITERATIONS):
            obs = NodePositions(body, nodes, max(self.sigma, LEAST_NOISE))
            after, _ = kalman.update(belief, obs, z.ravel())
            found = attach(body.position(after.mean), z) if callable(attach) else nodes
            if np.array_equal(found, nodes):
                break
            nodes = found
        return after.moved_to(body.admissible(after.mean))

    def start(self, body: Superquadric, blocks: Blocks, x: FloatArray) -> BlockGaussian:
        """Belief before the first frame."""
        s, rates = self.settings, slice(body.dim_q, body.dim_q + LOCAL)
        sigma = np.full(body.dim_x, s.still)
        sigma[TRANSLATION], sigma[ROTATION] = s.translation, s.rotation
        sigma[GLOBAL] = s.shape * np.where(np.isin(PARAMETERS, ('a0', 'b1')), s.length, 1.0)
        sigma[rates] *= body.moving[:LOCAL]
        sigma[:LOCAL] *= body.moving[:LOCAL]
        known, own = blocks.diagonal(sigma**2)
        if len(own):
            heat, springs = self._heat(body)
            own = np.zeros_like(own)
            axes = np.arange(3)
            own[:, axes, axes] = s.first**2 * heat * np.diag(np.linalg.inv(springs))[:, None]
            own[:, 3 + axes, 3 + axes] = s.first**2 * (heat / body.node_mass)[:, None]
        return blocks.belief(x, known, own)

    def density(self, body: Superquadric) -> FloatArray:
        """Spectral density of the process noise, shape (dim_x,).

        That of the displacements is the one with which their motion by K, damped by alpha, has
        the covariance heat K^-1 in the long run.
        """
        s, q = self.settings, np.zeros(body.dim_x)
        rates = q[body.dim_q :]
        rates[TRANSLATION], rates[ROTATION], rates[GLOBAL] = s.push**2, s.turn**2, s.reshape**2
        if body.moving[LOCAL:].any():
            heat, _ = self._heat(body)
            rates[LOCAL:] = np.repeat(2.0 * body.alpha * heat / body.node_mass, 3)
        rates *= body.moving
        return q

    def _heat(self, body: Superquadric) -> tuple[float, FloatArray]:
        """The factor that makes the mean variance of heat K^-1 that of `local`, and K, (N, N)."""
        springs = body.membrane.matrix().toarray()
        return self.settings.local**2 / float(np.diag(np.linalg.inv(springs)).mean()), springs


def spread(body: Superquadric, belief: BlockGaussian) -> float:
    """Mean over the nodes of the root mean square distance that the filter expects."""
    obs = NodePositions(body, np.arange(body.nodes), 0.0)
    return float(np.sqrt(np.trace(position_covariances(belief, obs), axis1=1, axis2=2)).mean())
