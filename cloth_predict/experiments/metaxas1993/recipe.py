"""The paper's own estimator: the continuous filter with decoupled blocks, frame after frame.

Without inertia, as D is the unit matrix and no mass is told: (37) and (38) with (19).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.continuous import over
from cloth_predict.filters.node_update import Seen, updated
from cloth_predict.models.first_order import FirstOrder
from cloth_predict.models.superquadric import LOCAL, Superquadric
from cloth_predict.models.superquadric_kinematics import within_ranges
from cloth_predict.observations import NodePositions
from cloth_predict.types import FloatArray, IntArray

STEP = 4e-5
"""Step [s] of the paper's explicit Euler method."""
RESTING = 1e-4
"""Change of every estimated parameter in such a step below which the paper takes the next frame:
that of a rate of 2.5 in a second."""
BETWEEN_AXES = 0.4
"""Covariance of two components of a node's displacement at first, where each has the variance 1:
the paper's "off-diagonal entries used in the estimation of local deformations". Between nodes that
are joined they would make P(0) indefinite: its least eigenvalue would be -0.11."""
LONGER, LONGEST = 1.1, 2e-3
"""Factor from step to step, and the longest of them [s]: forces of the data are strong at first
and fade as P falls. Exact in the measurement, they are as close to the solution as Euler's."""
MOST = 1.0
"""Time [s] after which a frame is left as it is."""

T = TypeVar('T')
Attach = Callable[[FloatArray, FloatArray], IntArray]
"""From positions of the nodes, shape (N, 3), and points, (m, 3), to the node of each point."""


@dataclass(frozen=True)
class Recipe:
    """The filter with V = v I and Q = q I.

    resting: change of a parameter in a step of the paper below which the next frame is taken;
    exact: whether it takes no other steps than those.
    """

    v: float = 0.1
    q: float = 0.1
    resting: float = RESTING
    exact: bool = False

    def start(self, body: Superquadric, q: FloatArray) -> BlockGaussian:
        """Belief before the first frame: P(0) = I, at coordinates q, shape (dim_q,)."""
        blocks = Blocks.of_coordinates(body)
        own = np.eye(3) + BETWEEN_AXES * (1.0 - np.eye(3))
        shared = np.diag(body.moving[:LOCAL].astype(float))
        return blocks.belief(q, shared, np.tile(own, (len(blocks.own), 1, 1)))

    def frames(
        self,
        body: Superquadric,
        q: FloatArray,
        points: Sequence[FloatArray],
        attach: Sequence[IntArray] | Attach,
    ) -> Iterator[tuple[BlockGaussian, int]]:
        """Belief after each frame, and how many steps it took.

        points, of each frame, (m, 3); attach: their nodes, or what finds them anew in each step.
        """
        belief = self.start(body, q)
        for k, z in enumerate(points):
            nodes = attach if callable(attach) else attach[k]
            belief, steps = self._rested(body, belief, z, nodes)
            yield belief, steps

    def _rested(
        self, body: Superquadric, belief: BlockGaussian, z: FloatArray, attach: IntArray | Attach
    ) -> tuple[BlockGaussian, int]:
        """Follow the forces of a frame until nothing moves any more."""

        def advance(belief: BlockGaussian, dt: float) -> BlockGaussian:
            nodes = attach(body.position(belief.mean), z) if callable(attach) else attach
            return self.step(body, belief, z, nodes, dt)

        return self.rested(belief, advance, lambda belief: belief.mean)

    def rested(
        self,
        state: T,
        advance: Callable[[T, float], T],
        coordinates: Callable[[T], FloatArray],
    ) -> tuple[T, int]:
        """What is left in a frame when no coordinate moves any more, and after how many steps."""
        dt, time, steps = STEP, 0.0, 0
        while time < MOST:
            before = coordinates(state)
            state = advance(state, dt)
            time, steps = time + dt, steps + 1
            if np.abs(coordinates(state) - before).max() * STEP < self.resting * dt:
                break
            if not self.exact:
                dt = min(dt * LONGER, LONGEST)
        return state, steps

    def step(
        self, body: Superquadric, belief: BlockGaussian, z: FloatArray, nodes: IntArray, dt: float
    ) -> BlockGaussian:
        """Belief dt [s] later: Euler's step of the membrane and of Q, then the measurement."""
        blocks, model = belief.blocks, FirstOrder(body)
        mean = belief.mean + dt * model.f(belief.mean, np.zeros(model.dim_u))
        noise, own_noise = blocks.diagonal(np.full(len(mean), dt * self.q) * body.moving)
        own = belief.own
        if len(own):
            springs = dt * body.membrane.matrix().diagonal()
            own = own - 2.0 * springs[:, None, None] * own + own_noise
        moved = blocks.belief(mean, belief.shared + noise, own)
        obs = NodePositions(body, nodes, np.sqrt(self.v))
        after, _ = updated(moved, over(Seen.of(moved, obs, z.ravel(), mean), dt))
        return after.moved_to(within_ranges(after.mean))


def nearest(position: FloatArray, points: FloatArray) -> IntArray:
    """The node nearest to each point, as the paper couples model and data, shape (m,)."""
    return np.asarray(cKDTree(position).query(points)[1])
