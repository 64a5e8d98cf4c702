"""The fully deformable object of section VI: its motion, and what is measured of it.

Lengths are in the units of a0. The paper tells neither the motion nor the time between frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.integrators.runge_kutta import RK4, RungeKutta
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.models.superquadric_shape import PARAMETERS
from cloth_predict.simulation.bodies import SOFT, Pull, gripped
from cloth_predict.types import FloatArray, IntArray

NODES, FRAMES = 123, 20
INTERVAL = 0.05
"""Time [s] between frames."""
STEP = 2e-3
"""Step [s] of the simulation, by RK4."""
SHAPE = np.array([3.0, 0.18, 0.25, 0.75, 0.9, 1.1, 0.3, -0.2, 0.3, 0.1, 0.4])
"""The object at first: tapered and bent, where the paper's first model is a plain ellipsoid."""
TURNED = np.array([0.98, 0.1, -0.1, 0.14])
"""Its quaternion at first."""
STRENGTH = (0.5, 0.4, 0.4)
"""RMS of the force along each axis, for a mass of 1."""
FIRST_SHAPE = np.array([2.7, 0.1, 0.2, 0.7, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.2])
"""The paper's first model."""
FIRST_CENTRE = np.array([0.4, -0.3, 0.5])
"""Where it is: not at the centre of the data."""


@dataclass(frozen=True)
class Motion:
    """A body and its coordinates q at each frame, shape (frames, dim_q)."""

    body: Superquadric
    q: FloatArray

    @property
    def positions(self) -> FloatArray:
        """Positions of the nodes, shape (frames, nodes, 3)."""
        return np.array([self.body.position(q) for q in self.q])


def moved(seed: int) -> Motion:
    """Let the object go from rest, pulled at its side by a force that comes and goes."""
    mesh = ClosedMesh.even(NODES)
    body = Superquadric(mesh, mass=1.0, reference=SHAPE, w0=0.1, w1=0.5, alpha=1.0, free=SOFT)
    pull = Pull.draw(np.random.default_rng(seed), gripped(mesh, (0.9, 0.0, 0.43)), STRENGTH)
    x, found = body.state(np.zeros(3), TURNED, SHAPE), []
    steps, method = round(INTERVAL / STEP), RungeKutta(RK4)
    for frame in range(FRAMES):
        found.append(body.admissible(x)[: body.dim_q])
        for k in range(steps):
            force = pull(np.zeros((NODES, 3)), INTERVAL * frame + STEP * (k + 0.5)).ravel()
            x = body.admissible(method.step(body, x, force, STEP))
    return Motion(body, np.array(found))


def model(nodes: int = NODES, shape: FloatArray = FIRST_SHAPE) -> Superquadric:
    """The body that is fitted: one of which nothing is known but the first shape; its scale stays.

    Of the scale and the aspect ratios one is superfluous.
    """
    mesh, free = ClosedMesh.even(nodes), np.array([name != 'a0' for name in PARAMETERS])
    return Superquadric(mesh, mass=1.0, reference=shape, w0=0.1, w1=0.5, alpha=1.0, free=free)


def first_state(body: Superquadric, shape: FloatArray = FIRST_SHAPE) -> FloatArray:
    """State from which the fit of the first frame begins, shape (dim_x,)."""
    return body.state(FIRST_CENTRE, np.array([1.0, 0.0, 0.0, 0.0]), shape)


def thinned(rng: np.random.Generator, density: float) -> IntArray:
    """Nodes of which there are data, the same in all frames, shape (m,)."""
    return np.sort(rng.permutation(NODES)[: round(density * NODES)])


def measured(rng: np.random.Generator, places: FloatArray, variance: float) -> FloatArray:
    """Places with normal noise of this variance in each coordinate, in squares of a0's units."""
    return places + rng.normal(0.0, np.sqrt(variance), places.shape)
