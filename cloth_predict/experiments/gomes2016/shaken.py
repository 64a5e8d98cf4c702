"""The thesis' simulated sheets: dropped from level, held by a row (Gomes 2016, 3.3 and 6.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse

from cloth_predict.integrators.runge_kutta import RK4, RungeKutta
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.simulation.recordings import hung_cloth, vertex_areas
from cloth_predict.types import FloatArray, read_only

SIDE = 1.5
"""Length and width [m] (Gomes 2016, table 6.1)."""
STIFFNESS, DAMPING = 300.0, 0.08
"""Of all springs [N/m] and dampers [N s/m] (Gomes 2016, table 6.1)."""
STEP = 1e-3
"""Step [s] of RK4; at each a new disturbance is drawn."""
INTERVAL = 1e-2
"""Time [s] between two frames."""
HELD_UP = 2.0
"""Height [m] of the row that holds the sheet."""
NOISE = 1e-3
"""Variance of the noise on the derivative of each state (Gomes 2016, section 6.2)."""
VISCOUS = 1.0
"""Constant k_vis [N s/m] of each node (Gomes 2016, eq. 6.14)."""

Draw = Callable[[np.random.Generator], FloatArray]


def sheet(count: int, mass: float) -> tuple[MassSpring, FloatArray]:
    """Build a level sheet of count x count nodes of `mass` [kg], and where they are [m]."""
    shape = np.zeros((count, count, 3))
    shape[..., 0] = np.linspace(0.0, SIDE, count)
    shape[..., 1] = HELD_UP
    shape[..., 2] = np.linspace(0.0, SIDE, count)[:, None]
    stiffness = dict.fromkeys(('structural', 'shear', 'flexion'), STIFFNESS)
    return hung_cloth(shape, count**2 * mass, stiffness, DAMPING), shape.reshape(-1, 3)


def at_rest(cloth: MassSpring, nodes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State and input of a cloth without velocity at positions [m], shape (nodes, 3)."""
    x = np.concatenate([nodes[cloth.free].ravel(), np.zeros(cloth.dim_x // 2)])
    return x, cloth.input(nodes[cloth.driven])


@dataclass
class Shaken:
    """A cloth whose state derivative has an addition that stays for a step, shape (dim_x,)."""

    cloth: MassSpring
    drawn: FloatArray

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        return self.cloth.f(x, u) + self.drawn

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """The row that holds it stands still."""
        return u

    @property
    def dim_x(self) -> int:
        """States of the cloth."""
        return self.cloth.dim_x

    @property
    def dim_u(self) -> int:
        """Inputs of the cloth."""
        return self.cloth.dim_u

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Not needed by an explicit step, and not offered."""
        raise TypeError('what is shaken is simulated by explicit steps only')

    jac_input = jac


@dataclass
class Blown(Shaken):
    """A square sheet in a viscous medium of velocity `drawn` [m/s], shape (3,), for a step."""

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative under F = k_vis (n (u - v)) n at each node (Gomes 2016, eq. 6.14)."""
        position, velocity = self.cloth.surface(x, u)
        side = round(np.sqrt(self.cloth.nodes))
        area = vertex_areas(position.reshape(side, side, 3)).reshape(-1, 3)
        normal = area / np.linalg.norm(area, axis=1, keepdims=True)
        through = np.einsum('ni,ni->n', normal, self.drawn - velocity)
        force = (VISCOUS * through[:, None] * normal)[self.cloth.free]
        pushed = u.copy()
        pushed[6 * len(self.cloth.driven) :] += force.ravel()
        return self.cloth.f(x, pushed)


def small_sheet() -> tuple[MassSpring, FloatArray]:
    """Build the sheet of 5 x 5 nodes of table 6.1."""
    return sheet(5, 0.441)


@lru_cache(maxsize=4)
def noisy(seed: int, duration: float) -> FloatArray:
    """States, (frames, dim_x), of the small sheet with noise on their derivative (6.1-6.3)."""
    cloth, _ = small_sheet()
    size = cloth.dim_x
    return _frames(
        Shaken(cloth, np.zeros(size)), seed, duration, lambda r: r.normal(0, NOISE**0.5, size)
    )


@lru_cache(maxsize=4)
def viscous(seed: int, duration: float, fastest: float) -> FloatArray:
    """States, (frames, dim_x), of the small sheet in a medium of random velocity (6.5-6.9).

    u = (a, 0, b) with a and b from U(1, fastest) [m/s], drawn at every step.
    """
    cloth, _ = small_sheet()

    def draw(rng: np.random.Generator) -> FloatArray:
        a, b = rng.uniform(1.0, fastest, 2)
        return np.array([a, 0.0, b])

    return _frames(Blown(cloth, np.zeros(3)), seed, duration, draw)


def _frames(scene: Shaken, seed: int, duration: float, draw: Draw) -> FloatArray:
    """States at the frames of a sheet that is let go from level, by RK4."""
    rng, method = np.random.default_rng(seed), RungeKutta(RK4)
    _, nodes = small_sheet()
    x, u = at_rest(scene.cloth, nodes)
    found, parts = [x], round(INTERVAL / STEP)
    for _ in range(round(duration / INTERVAL)):
        for _ in range(parts):
            scene.drawn = draw(rng)
            x = method.step(scene, x, u, STEP)
        found.append(x)
    return np.asarray(read_only(np.array(found)))
