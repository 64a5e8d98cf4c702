"""Recordings with known truth: a dense surface, integrated far below its own error bound.

The surface is a finer mesh than any filter of this project runs. Wind is a smooth function of time
and place, so that a smaller step converges to the same motion; test/test_simulate.py measures it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from cloth_predict.formats.bag import Recording, Truth
from cloth_predict.integrators import RK4, ImplicitEuler, RungeKutta
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import grid_springs
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

AIR_DENSITY = 1.2
"""Density of air [kg/m^3]."""

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Gusts:
    """Turbulence of the fan's jet: a sum of sinusoids carried along with the wind.

    frequency [Hz], phase [rad], size (share of the mean speed), each of shape (waves,); wave
    numbers across and down the cloth [rad/m], shape (waves, 2).
    """

    frequency: FloatArray
    phase: FloatArray
    size: FloatArray
    wave_number: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator, waves: int = 24, intensity: float = 0.3) -> Gusts:
        """Draw waves from 0.2 to 8 Hz whose power falls with the -5/3 power of frequency."""
        frequency = np.exp(rng.uniform(np.log(0.2), np.log(8.0), waves))
        power = frequency ** (-5 / 3) * frequency  # equal numbers per octave
        size = intensity * np.sqrt(2 * power / power.sum())
        return cls(
            frequency,
            rng.uniform(0, 2 * np.pi, waves),
            size,
            rng.normal(0.0, 4.0, (waves, 2)) * np.sqrt(frequency)[:, None],
        )

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Relative change of the speed at positions [m], shape (nodes, 3), at time [s]."""
        angle = position[:, :2] @ self.wave_number.T - 2 * np.pi * self.frequency * time
        return np.asarray(np.cos(angle + self.phase) @ self.size)


@dataclass(frozen=True)
class Fan:
    """A fan behind the cloth that turns from side to side.

    distance [m] from the cloth; middle [m], shape (3,), of the cloth; speed [m/s] in the jet;
    swing [rad] to each side; period [s] of a full swing; spread [rad] of the jet.
    """

    gusts: Gusts
    middle: FloatArray
    distance: float = 1.5
    speed: float = 4.0
    swing: float = 0.6
    period: float = 5.0
    spread: float = 0.3

    def __call__(self, position: FloatArray, time: float) -> FloatArray:
        """Velocity of the air [m/s] at positions [m], shape (nodes, 3), at time [s]."""
        ray = position - (self.middle - np.array([0.0, 0.0, self.distance]))
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        heading = self.swing * np.sin(2 * np.pi * time / self.period - np.pi / 2)
        aim = np.array([np.sin(heading), 0.0, np.cos(heading)])
        angle = np.arccos(np.clip(ray @ aim, -1.0, 1.0))
        rise = 1.0 - np.exp(-time)  # the fan spins up, so that the cloth starts from rest
        speed = rise * self.speed * np.exp(-0.5 * (angle / self.spread) ** 2)
        return np.asarray(ray * (speed * (1.0 + self.gusts(position, time)))[:, None])


class Scene:
    """A grid of cloth, hung by its first row, in moving air; time is its last state."""

    def __init__(
        self, cloth: MassSpring, rows: int, cols: int, shape: FloatArray, fan: Fan | None
    ) -> None:
        self.cloth, self.fan = cloth, fan
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
        if self.fan is not None:
            u = u.copy()
            u[6 * len(self.cloth.driven) :] = self.wind_force(x, u).ravel()
        return np.append(self.cloth.f(x[:-1], u), 1.0)

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the cloth: what it hangs from stands still."""
        return u

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


def settled(cloth: MassSpring, hung: FloatArray, start: FloatArray) -> FloatArray:
    """Positions [m], shape (nodes, 3), at which the cloth hangs at rest.

    Long implicit steps, whose own damping takes the motion out, until a step moves no node.
    """
    x = np.concatenate([start[cloth.free].ravel(), np.zeros(cloth.dim_x // 2)])
    for _ in range(1000):
        before, x = x, ImplicitEuler().step(cloth, x, hung, 0.1)
        if np.abs(x - before).max() < 1e-10:  # m and m/s: far below a float32's last digit
            return cloth.surface(x, hung)[0]
    raise FloatingPointError('the cloth does not come to rest')


def run(
    scene: Scene, start: FloatArray, times: FloatArray, step: float, progress: Progress
) -> FloatArray:
    """Positions [m] of all nodes at times [s], (times, nodes, 3), by steps of at most `step`."""
    x = np.append(np.concatenate([start[scene.cloth.free].ravel(), np.zeros(scene.dim_x // 2)]), 0)
    method = RungeKutta(RK4)
    frames = [scene.cloth.surface(x[:-1], scene.hung)[0]]
    for duration in np.diff(times):
        parts = int(np.ceil(duration / step - 1e-9))
        for _ in range(parts):
            x = method.step(scene, x, scene.hung, duration / parts)
        if not np.isfinite(x).all():
            raise FloatingPointError(f'the simulation diverges with a step of {step} s')
        frames.append(scene.cloth.surface(x[:-1], scene.hung)[0])
        progress(float(duration))
    return np.array(frames)


def towel_fan(
    rng: np.random.Generator, duration: float, progress: Progress, step: float = 1e-3
) -> Truth:
    """A 0.51 x 0.80 m towel of 0.34 kg hung by its top row before a fan, 17 x 13 nodes."""
    shape = np.zeros((17, 13, 3))
    shape[..., 0] = np.linspace(0.0, 0.51, 13)
    shape[..., 1] = 1.5 - np.linspace(0.0, 0.80, 17)[:, None]
    stiffness = {'structural': 400.0, 'shear': 80.0, 'flexion': 20.0}
    cloth = hung_cloth(shape, 0.34, stiffness, damping=0.02)
    fan = Fan(Gusts.draw(rng), middle=shape.reshape(-1, 3).mean(axis=0))
    nodes = shape.reshape(-1, 3)
    scene = Scene(cloth, 17, 13, nodes, fan)
    stamps = _stamps(duration)
    surface = run(scene, settled(cloth, scene.hung, nodes), stamps / 1e9, step, progress)
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
    stamps = _stamps(duration)
    surface = run(Scene(cloth, 21, 21, nodes, None), nodes, stamps / 1e9, step, progress)
    return Truth(stamps, surface.reshape(-1, 21, 21, 3), marker_grid(21, 21, 5))


SCENARIOS: dict[str, Callable[[np.random.Generator, float, Progress], Truth]] = {
    'towel_fan': towel_fan,
    'falling_cloth': falling_cloth,
}


def marker_grid(rows: int, cols: int, every: int) -> IntArray:
    """Marker on each node, or -1: markers sit on every `every`-th row and column."""
    ids = np.full((rows, cols), -1, np.int64)
    chosen = ids[::every, ::every]
    chosen[...] = np.arange(chosen.size).reshape(chosen.shape)
    return ids


def measure(
    truth: Truth, rng: np.random.Generator, noise: float = 3e-4, dropout: float = 0.02
) -> MarkerSequence:
    """Markers as a mocap system would see them: noise [m] on each coordinate, markers left out."""
    nodes = np.flatnonzero(truth.ids.ravel() >= 0)
    exact = truth.surface.reshape(len(truth.stamps), -1, 3)[:, nodes]
    labels = tuple(f'cloth:{i}' for i in range(len(nodes)))
    visible = rng.random(exact.shape[:2]) >= dropout
    visible[0] = True  # a take starts with every marker in view
    positions = exact + rng.normal(0.0, noise, exact.shape)
    positions[~visible] = np.nan
    return MarkerSequence(truth.stamps, labels, positions, visible)


def simulate(scenario: str, seed: int, duration: float, progress: Progress) -> Recording:
    """Make a recording with its truth; the same seed gives the same recording."""
    wind_rng, sensor_rng = np.random.default_rng(seed).spawn(2)
    truth = SCENARIOS[scenario](wind_rng, duration, progress)
    return Recording(measure(truth, sensor_rng), truth)


def _stamps(duration: float, rate: int = 100) -> IntArray:
    return np.arange(round(duration * rate) + 1, dtype=np.int64) * (10**9 // rate)
