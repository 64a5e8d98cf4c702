"""Recordings with known truth: a dense surface, integrated far below its own error bound.

The surface is a finer mesh than any filter of this project runs. Wind is a smooth function of time
and place, so that a smaller step converges to the same motion; test/test_simulate.py measures it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from cloth_predict.formats.bag import Recording, Truth
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import grid_springs
from cloth_predict.simulation.bodies import balloon, insect, insect_labels
from cloth_predict.simulation.filming import Progress, film, frame_stamps
from cloth_predict.simulation.ruler import ruler, ruler_labels
from cloth_predict.simulation.surroundings import Air, Draught, Fan, Gusts, Rail
from cloth_predict.surface.equilibrium import settled
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

AIR_DENSITY = 1.2
"""Density of air [kg/m^3]."""


class Scene:
    """A grid of cloth, hung by its first row, in moving air; time is its last state.

    hung: input of the cloth at the start; a rail carries what it hangs from.
    """

    def __init__(
        self,
        cloth: MassSpring,
        rows: int,
        cols: int,
        shape: FloatArray,
        fan: Air | None,
        rail: Rail | None = None,
    ) -> None:
        self.cloth, self.fan, self.rail = cloth, fan, rail
        self._grid = (rows, cols)
        self.hung = cloth.input(shape[cloth.driven])

    @property
    def dim_x(self) -> int:
        """States of the cloth, and the time."""
        return self.cloth.dim_x + 1

    @property
    def dim_u(self) -> int:
        """Inputs of the cloth."""
        return self.cloth.dim_u

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        u = self.carried(u, float(x[-1]))
        if self.fan is not None:
            u = u.copy()
            u[6 * len(self.cloth.driven) :] = self.wind_force(x, u).ravel()
        return np.append(self.cloth.f(x[:-1], u), 1.0)

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input at the start, at any time: where the rail has carried it, the time state says."""
        return u

    def carried(self, u: FloatArray, time: float) -> FloatArray:
        """Input of the cloth at a time [s], where `u` is that at the start."""
        if self.rail is None:
            return u
        carried, size = u.copy(), 3 * len(self.cloth.driven)
        place, velocity = self.rail(time)
        carried[:size:3] += place
        carried[size : 2 * size : 3] += velocity
        return carried

    def positions(self, x: FloatArray) -> FloatArray:
        """Positions of all nodes [m], shape (nodes, 3)."""
        return self.cloth.surface(x[:-1], self.carried(self.hung, float(x[-1])))[0]

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Not needed by an explicit step, and not offered."""
        raise TypeError('a scene is simulated by explicit steps only')

    jac_input = jac

    def wind_force(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Force of the wind on the free nodes [N], shape (free, 3).

        The viscous force along the normal (Gomes 2016, eq. 6.14), with the dynamic pressure of the
        air on the node's own area instead of a constant: F = rho/2 A |n (u - v)| (n (u - v)) n.
        """
        position, velocity = self.cloth.surface(x[:-1], u)
        assert self.fan is not None
        area = vertex_areas(position.reshape(*self._grid, 3)).reshape(-1, 3)
        size = np.linalg.norm(area, axis=1)
        normal = area / size[:, None]
        through = np.einsum('ni,ni->n', normal, self.fan(position, float(x[-1])) - velocity)
        force = (0.5 * AIR_DENSITY * size * np.abs(through) * through)[:, None] * normal
        return np.asarray(force[self.cloth.free])


def vertex_areas(grid: FloatArray) -> FloatArray:
    """Normal times area [m^2] of each node of a grid [m], shape (rows, cols, 3).

    Each cell gives a quarter of the cross product of its diagonals, halved, to each corner.
    """
    across = grid[1:, 1:] - grid[:-1, :-1]
    down = grid[1:, :-1] - grid[:-1, 1:]
    quarter = np.cross(down, across) / 8.0
    areas = np.zeros_like(grid)
    for corner in (np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[:-1, 1:], np.s_[1:, 1:]):
        areas[corner] += quarter
    return areas


def hung_cloth(
    shape: FloatArray, mass: float, stiffness: dict[str, float], damping: float
) -> MassSpring:
    """Build a grid hung by its first row, at rest in `shape` [m], shape (rows, cols, 3)."""
    rows, cols = shape.shape[:2]
    springs = grid_springs(rows, cols, shape.reshape(-1, 3), stiffness, damping)
    return MassSpring(springs, np.full(rows * cols, mass / (rows * cols)), np.arange(cols))


def run(
    scene: Scene, start: FloatArray, times: FloatArray, step: float, progress: Progress
) -> FloatArray:
    """Positions [m] of all nodes at times [s], (times, nodes, 3), by steps of at most `step`."""
    x = np.append(np.concatenate([start[scene.cloth.free].ravel(), np.zeros(scene.dim_x // 2)]), 0)
    return film(scene, x, times, step, progress)


def towel_fan(
    rng: np.random.Generator, duration: float, progress: Progress, step: float = 1e-3
) -> Truth:
    """A towel hung by its top row before a fan."""
    cloth, nodes = towel()
    fan = Fan(Gusts.draw(rng), middle=nodes.mean(axis=0))
    return _filmed(Scene(cloth, 17, 13, nodes, fan), nodes, duration, progress, step)


def crossing(
    rng: np.random.Generator, duration: float, progress: Progress, step: float = 1e-3
) -> Truth:
    """A towel hung from a bar that goes to and fro at 1 m/s along a rail, in a draught."""
    cloth, nodes = towel()
    draught = Draught(Gusts.draw(rng))
    return _filmed(Scene(cloth, 17, 13, nodes, draught, Rail()), nodes, duration, progress, step)


def towel() -> tuple[MassSpring, FloatArray]:
    """A towel of 0.51 x 0.80 m and 0.34 kg, 17 x 13 nodes, and where they are when flat [m]."""
    shape = np.zeros((17, 13, 3))
    shape[..., 0] = np.linspace(0.0, 0.51, 13)
    shape[..., 1] = 1.5 - np.linspace(0.0, 0.80, 17)[:, None]
    stiffness = {'structural': 400.0, 'shear': 80.0, 'flexion': 20.0}
    return hung_cloth(shape, 0.34, stiffness, damping=0.02), shape.reshape(-1, 3)


def _filmed(
    scene: Scene, nodes: FloatArray, duration: float, progress: Progress, step: float
) -> Truth:
    """Let a towel go from where it hangs at rest."""
    stamps = frame_stamps(duration)
    start = settled(scene.cloth, scene.hung, nodes)
    surface = run(scene, start, stamps / 1e9, step, progress)
    return Truth(stamps, surface.reshape(-1, 17, 13, 3), marker_grid(17, 13, 4))


def falling_cloth(
    rng: np.random.Generator, duration: float, progress: Progress, step: float = 1e-3
) -> Truth:
    """A 21 x 21 cloth of 1.5 m, dropped from level, held by a row (Gomes 2016, section 3.3)."""
    shape = np.zeros((21, 21, 3))
    shape[..., 0] = np.linspace(0.0, 1.5, 21)
    shape[..., 1] = 2.0
    shape[..., 2] = np.linspace(0.0, 1.5, 21)[:, None]
    stiffness = {'structural': 300.0, 'shear': 300.0, 'flexion': 300.0}
    cloth = hung_cloth(shape, 441 * 0.025, stiffness, damping=0.08)
    nodes = shape.reshape(-1, 3)
    stamps = frame_stamps(duration)
    surface = run(Scene(cloth, 21, 21, nodes, None), nodes, stamps / 1e9, step, progress)
    return Truth(stamps, surface.reshape(-1, 21, 21, 3), marker_grid(21, 21, 5))


SCENARIOS: dict[str, Callable[[np.random.Generator, float, Progress], Truth]] = {
    'towel_fan': towel_fan,
    'crossing': crossing,
    'falling_cloth': falling_cloth,
    'balloon': balloon,
    'insect': insect,
    'ruler': ruler,
}
LABELS: dict[str, Callable[[int], tuple[str, ...]]] = {
    'insect': insect_labels,
    'ruler': ruler_labels,
}
"""How markers are called, where they belong to parts."""


def marker_grid(rows: int, cols: int, every: int) -> IntArray:
    """Marker on each node, or -1: markers sit on every `every`-th row and column."""
    ids = np.full((rows, cols), -1, np.int64)
    chosen = ids[::every, ::every]
    chosen[...] = np.arange(chosen.size).reshape(chosen.shape)
    return ids


def numbered(markers: int) -> tuple[str, ...]:
    """Label of each marker of one surface."""
    return tuple(f'cloth:{i}' for i in range(markers))


def unlabelled(markers: int) -> tuple[str, ...]:
    """Names of markers that the mocap system did not identify."""
    return tuple(f'Unlabeled {i}' for i in range(markers))


def measure(
    truth: Truth,
    rng: np.random.Generator,
    noise: float = 3e-4,
    dropout: float = 0.02,
    labels: Callable[[int], tuple[str, ...]] = numbered,
) -> MarkerSequence:
    """Markers as a mocap system would see them: noise [m] on each coordinate, markers left out."""
    nodes = np.flatnonzero(truth.ids.ravel() >= 0)
    exact = truth.surface.reshape(len(truth.stamps), -1, 3)[:, nodes]
    visible = rng.random(exact.shape[:2]) >= dropout
    visible[0] = True  # a take starts with every marker in view
    positions = exact + rng.normal(0.0, noise, exact.shape)
    positions[~visible] = np.nan
    return MarkerSequence(truth.stamps, labels(len(nodes)), positions, visible)


def simulate(
    scenario: str, seed: int, duration: float, progress: Progress, labelled: bool = True
) -> Recording:
    """Make a recording with its truth; the same seed gives the same recording."""
    wind_rng, sensor_rng = np.random.default_rng(seed).spawn(2)
    truth = SCENARIOS[scenario](wind_rng, duration, progress)
    labels = LABELS.get(scenario, numbered) if labelled else unlabelled
    return Recording(measure(truth, sensor_rng, labels=labels), truth)
