"""Bodies that are joined, followed by the paper's estimator and by ours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cloth_predict.bodies.association import UNNAMED, Attached, attach
from cloth_predict.experiments.metaxas1993.ours import Ours
from cloth_predict.experiments.metaxas1993.recipe import Recipe, nearest
from cloth_predict.filters.blocks import BlockGaussian, Blocks
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.linear import condition
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models.constraints import Articulated
from cloth_predict.models.joints import Joints
from cloth_predict.models.superquadric import GLOBAL, Superquadric
from cloth_predict.models.superquadric_kinematics import within_ranges
from cloth_predict.observations import NodePositions
from cloth_predict.types import FloatArray, Gaussian

Points = Sequence[FloatArray]
"""Points of each part, shape (m, 3)."""
HELD = 1e-6
"""Standard deviation to which a joint is said to hold, in the units of the bodies."""
ROUNDS, FIRST_ROUNDS = 6, 12
"""Linearisations of an update, at each of which points find their nodes anew; and those of the
frame in which points with labels find theirs for good."""

POSE = GLOBAL.start
"""Coordinates of a part that move it as a rigid body: the first ones."""


@dataclass(frozen=True)
class JoinedRecipe:
    """The paper's estimator for each part; forces of the joints make C' + alpha C = 0 (36).

    They act on what the data do in a step: the parts move freely, and then as little as it takes.
    """

    recipe: Recipe
    joints: Joints
    alpha: float

    def frames(
        self, states: Sequence[FloatArray], frames: Sequence[Points]
    ) -> Iterator[list[FloatArray]]:
        """Coordinates of the parts after each frame, from their states at first."""
        bodies = self.joints.bodies
        beliefs = [self.recipe.start(b, x[: b.dim_q]) for b, x in zip(bodies, states, strict=True)]
        for points in frames:
            beliefs, _ = self.recipe.rested(beliefs, partial(self.step, points), _stacked)
            yield [belief.mean for belief in beliefs]

    def step(
        self, points: Points, beliefs: Sequence[BlockGaussian], dt: float
    ) -> list[BlockGaussian]:
        """Beliefs dt [s] later."""
        bodies = self.joints.bodies
        q = _stacked(beliefs)
        free = [
            self.recipe.step(body, belief, z, nearest(body.position(belief.mean), z), dt)
            for body, belief, z in zip(bodies, beliefs, points, strict=True)
        ]
        moved = _stacked(free)
        mobility = np.concatenate([body.moving for body in bodies]).astype(float)
        linkage = self.joints.at(q, mobility)
        closing = -np.expm1(-self.alpha * dt) * self.joints.violation(q)
        moved = moved - linkage.moved(linkage.solve(linkage.rows @ (moved - q) + closing))
        parts = [moved[at] for at in self.joints.coordinates]
        return [
            belief.moved_to(within_ranges(part)) for belief, part in zip(free, parts, strict=True)
        ]


def _stacked(beliefs: Sequence[BlockGaussian]) -> FloatArray:
    """Coordinates of all parts, shape (dim_q,)."""
    return np.concatenate([belief.mean for belief in beliefs])


@dataclass(frozen=True)
class JoinedFilter:
    """Ours: one filter of all parts, to which joints are measurements without noise.

    labelled: whether points come in the same order in all frames. They keep the place on their
    part that they find in the first one, which need not be a node.
    """

    joints: Joints
    ours: Ours
    labelled: bool = False

    def frames(
        self, states: Sequence[FloatArray], frames: Sequence[Points]
    ) -> Iterator[list[FloatArray]]:
        """Coordinates of the parts after each frame, from their states at first."""
        bodies = self.joints.bodies
        model = Articulated(bodies, [], 0.0)
        kalman = ExtendedKalmanFilter(INTEGRATORS['exponential'])
        belief, density = self._start(model, states)
        worn: list[Attached] | None = None
        for k, points in enumerate(frames):
            if k:
                still = np.zeros(model.dim_u)
                belief = kalman.predict(belief, model, still, density, self.ours.interval)
            belief, found = self._taken(model, belief, points, worn)
            worn = found if self.labelled else None
            yield [
                x[: body.dim_q] for body, x in zip(bodies, model.split(belief.mean), strict=True)
            ]

    def _start(
        self, model: Articulated, states: Sequence[FloatArray]
    ) -> tuple[Gaussian, FloatArray]:
        """The belief before the first frame, of parts by themselves, and the noise."""
        variances = []
        for body, x in zip(self.joints.bodies, states, strict=True):
            known = self.ours.start(body, Blocks.of_body(body, 'pose'), x)
            variances.append(known.marginals(np.arange(body.dim_x)[:, None])[:, 0, 0])
        densities = [self.ours.density(body) for body in self.joints.bodies]
        prior = Gaussian(model.join(list(states)), np.diag(model.join(variances)))
        return prior, model.join(densities)

    def _taken(
        self, model: Articulated, belief: Gaussian, points: Points, worn: list[Attached] | None
    ) -> tuple[Gaussian, list[Attached]]:
        """The belief after a frame, linearised where the last one is (Gauss and Newton).

        worn: where the points of each part are on it, if that is known; returned as it was found.
        """
        at, rows, bodies, joined = belief.mean, model.rows, self.joints.bodies, self.joints
        for _ in range(FIRST_ROUNDS if self.labelled and worn is None else ROUNDS):
            jacs, residuals, noise = [], [], []
            states = model.split(at)
            now = worn or [
                self._attached(*each) for each in zip(bodies, states, points, strict=True)
            ]
            for body, own, x, z, there in zip(bodies, rows, states, points, now, strict=True):
                obs = NodePositions(body, there.node, self.ours.sigma)
                jac = np.zeros((z.size, model.dim_x))
                jac[:, own] = obs.jac(x)
                jacs.append(jac)
                residuals.append(there.of_nodes(z, body.rotation(x)).ravel() - obs.h(x))
                noise.append(obs.cov)
            jac = np.zeros((3 * len(joined.joints), model.dim_x))
            jac[:, : model.dim_q] = joined.jacobian(at[: model.dim_q])
            jacs.append(jac)
            residuals.append(-joined.violation(at[: model.dim_q]))
            noise.append(np.full(len(jac), HELD**2))
            H, residual = np.concatenate(jacs), np.concatenate(residuals)
            off = residual - H @ (belief.mean - at)
            found, _ = condition(belief, H, np.concatenate(noise), off)
            at = model.admissible(found.mean)
        return replace(found, mean=closed(model, joined, at)), now

    def _attached(self, body: Superquadric, x: FloatArray, points: FloatArray) -> Attached:
        """Where points, shape (m, 3), are on a part: at the nearest node, or also beside it."""
        nobody = np.full(len(points), UNNAMED)
        if self.labelled:
            return attach(points, nobody, 0, body.mesh, body.position(x), body.rotation(x))
        return Attached(nearest(body.position(x), points), np.zeros_like(points), nobody, nobody)


def closed(model: Articulated, joints: Joints, x: FloatArray) -> FloatArray:
    """The state in which the joints hold, by Newton's method, as parts move as rigid bodies.

    What brings parameters back into their ranges opens them. Shapes stay, which are in range.
    """
    mobility = np.zeros(model.dim_q)
    for at in joints.coordinates:
        mobility[at][:POSE] = model.inverse_mass[at][:POSE]
    for _ in range(ROUNDS):
        q = x[: model.dim_q]
        linkage = joints.at(q, mobility)
        q = q - linkage.moved(linkage.solve(joints.violation(q)))
        x = model.admissible(np.append(q, x[model.dim_q :]))
    return x
