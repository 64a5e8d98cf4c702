"""A body drawn onto points by their forces (Metaxas & Terzopoulos 1993, eq. 16 and 18)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve

from cloth_predict.models.superquadric import GLOBAL, Superquadric
from cloth_predict.models.superquadric_kinematics import within_ranges
from cloth_predict.models.superquadric_shape import HIGH, LOW
from cloth_predict.observations import NodePositions
from cloth_predict.types import FloatArray, IntArray

Attach = Callable[[FloatArray], IntArray]
"""From the positions of the nodes [m], shape (N, 3), to the node of each point, shape (m,)."""

SETTLING = 0.01
"""First step, and the longest one while points change their nodes, by sigma^2: the point of a node
pulls its displacement by this share of the way. What all nodes share is pulled by all points, and
comes to rest in such steps before displacements follow points that are not theirs."""
LONGEST = 1e12
"""Longest step, by the inverse of the largest stiffness: 1e-4 of it would be lost in rounding."""
LONGER, SHORTER = 5.0, 0.5
"""Factors of the next step, after one that lowers the energy and after one that does not."""


@dataclass(frozen=True)
class Fit:
    """A body at rest under the forces of points.

    q, shape (dim_q,); nodes, shape (m,): the node of each point; residual [m]: root mean square
    distance of the points from their nodes; steps: how many were tried; converged: whether it
    rests, or was stopped before.
    """

    q: FloatArray
    nodes: IntArray
    residual: float
    steps: int
    converged: bool


def fit(
    body: Superquadric,
    q: FloatArray,
    points: FloatArray,
    attach: Attach | IntArray,
    sigma: float,
    *,
    every: int = 1,
    tolerance: float = 1e-6,
    most: int = 1000,
) -> Fit:
    """Let D q' + K q = f_q (eq. 18) come to rest, from q, shape (dim_q,), or a state.

    points [m], shape (m, 3); attach: the node of each, or what finds them anew every so many
    steps; sigma [m]: V = sigma^2 I scales the forces (eq. 16). D is the identity, as in the paper.
    A step is one of linearised implicit Euler: short ones follow the motion, long ones are Gauss
    and Newton's. It grows while the energy falls and no point changes its node. At rest no node
    moves by more than the tolerance [m] in the longest step, and no point changes its node.
    """
    found = attach if callable(attach) else (lambda _: attach)
    q = within_ranges(q[: body.dim_q])
    pull, dt, taken = Pull(body, found(body.position(q)), points, sigma), SETTLING * sigma**2, 0
    rounding = 0.5 * len(points) * (tolerance / sigma) ** 2
    for steps in range(1, most + 1):
        after, longest = pull.step(q, dt)
        moved = np.abs(body.position(after) - body.position(q)).max()
        resting = dt >= longest and moved < tolerance
        if pull.energy(after) > pull.energy(q) + rounding:
            dt *= SHORTER
            continue
        q, dt, taken = after, min(dt * LONGER, longest), taken + 1
        if resting or taken % every == 0:
            nodes = found(body.position(q))
            changed = not np.array_equal(nodes, pull.nodes)
            pull = replace(pull, nodes=nodes)
            if changed:
                dt = min(dt, SETTLING * sigma**2)
            elif resting:
                return Fit(q, nodes, pull.residual(q), steps, True)
    return Fit(q, pull.nodes, pull.residual(q), most, False)


@dataclass(frozen=True)
class Pull:
    """Points [m], shape (m, 3), that pull at nodes, shape (m,), of a body."""

    body: Superquadric
    nodes: IntArray
    points: FloatArray
    sigma: float

    def energy(self, q: FloatArray) -> float:
        """Energy that f_q - K q lowers: of the springs to the points, and of the membrane."""
        strain = 0.5 * float(q @ (self.body.stiffness @ q))
        return strain + 0.5 * len(self.nodes) * (self.residual(q) / self.sigma) ** 2

    def residual(self, q: FloatArray) -> float:
        """Root mean square distance of points and nodes [m]."""
        off = self.body.position(q, self.nodes) - self.points
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))

    def step(self, q: FloatArray, dt: float) -> tuple[FloatArray, float]:
        """Coordinates after dt, and the longest step that the stiffness here allows.

        (1 / dt + K + H' V^-1 H) dq = f_q - K q, for the coordinates that may move; a parameter
        at an end of its range that is pulled beyond it stays.
        """
        obs = NodePositions(self.body, self.nodes, self.sigma)
        jac = obs.jac(q) / self.sigma
        force = jac.T @ (self.points.ravel() - obs.h(q)) / self.sigma - self.body.stiffness @ q
        free = self.body.moving.copy()
        pulled, at = force[GLOBAL], q[GLOBAL]
        free[GLOBAL] &= ~((at <= LOW) & (pulled < 0.0)) & ~((at >= HIGH) & (pulled > 0.0))
        rows = np.flatnonzero(free)
        stiffness = (self.body.stiffness.toarray() + jac.T @ jac)[np.ix_(rows, rows)]
        longest = LONGEST / float(np.max(np.diag(stiffness), initial=0.0))
        dt = min(dt, longest)
        stiffness.flat[:: len(rows) + 1] += 1.0 / dt
        after = q.copy()
        after[rows] += solve(stiffness, force[rows], assume_a='pos')
        return within_ranges(after), longest
