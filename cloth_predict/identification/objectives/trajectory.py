"""The thesis' objective: how far the model, left to itself, strays from what was (eq. 5.13)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.identification.failing import or_none
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.objectives.physics import Directions, gravity_factors
from cloth_predict.identification.objectives.sensitivity import StepSlopes
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.implicit import LinearisedSurface
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.surface.topology import Topology
from cloth_predict.types import BoolArray, FloatArray, IntArray, Solver, Tangent

GRADIENT_PRICE = 3
"""A cost with its gradient takes 2.2 to 2.7 times as long as the cost alone, whatever the number
of parameters (benchmarks/bench_identify.py); rounded up."""


@dataclass(frozen=True)
class Scenario:
    """A motion that the model is to follow from its start.

    times [s], shape (steps + 1,), the implicit steps lie between; position [m] and velocity [m/s]
    of all nodes of the model at the first, each of shape (nodes, 3); driven [m], shape
    (steps + 1, driven, 3): where the driven nodes are; target [m], shape (steps + 1, compared, 3),
    NaN where unknown, of the nodes `compared`, shape (compared,), which is A of (5.4).
    """

    name: str
    times: FloatArray
    position: FloatArray
    velocity: FloatArray
    driven: FloatArray
    target: FloatArray
    compared: IntArray

    def weights(self, alpha: float) -> FloatArray:
        """Weight exp(alpha i dT) of each time, shape (steps + 1,)."""
        return np.asarray(np.exp(alpha * (self.times - self.times[0])))

    def inputs(self, mesh: MassSpring) -> list[FloatArray]:
        """Input of each step: the driven nodes at its start, and their mean velocity over it."""
        velocity = np.diff(self.driven, axis=0) / np.diff(self.times)[:, None, None]
        pairs = zip(self.driven[:-1], velocity, strict=True)
        return [mesh.input(place, speed) for place, speed in pairs]

    def start(self, mesh: MassSpring) -> FloatArray:
        """First state, shape (dim_x,)."""
        free = mesh.free
        return np.concatenate([self.position[free].ravel(), self.velocity[free].ravel()])


def simulate(mesh: MassSpring, scenario: Scenario) -> FloatArray:
    """States of the open loop, shape (steps + 1, dim_x).

    Raises FloatingPointError where the model does not get to the end.
    """
    x = scenario.start(mesh)
    states = [x]
    for u, dt in zip(scenario.inputs(mesh), np.diff(scenario.times).tolist(), strict=True):
        x = ImplicitEuler().step(mesh, x, u, dt)
        states.append(x)
    if not np.isfinite(states[-1]).all():
        raise FloatingPointError(f'{scenario.name}: the model diverges')
    return np.array(states)


Build = Callable[[Config], MassSpring]
"""Makes the model of a configuration: all but the parameters stays."""


@dataclass(frozen=True)
class Trajectory:
    """C(theta) = sum_i exp(alpha i dT) |z_i - A x_i|^2 [m^2], summed over scenarios (5.13, 5.16).

    joined: which nodes of the model are joined.
    """

    space: Space
    scenarios: tuple[Scenario, ...]
    build: Build
    joined: Topology
    alpha: float = 0.0

    gradient_price = GRADIENT_PRICE

    @property
    def parts(self) -> int:
        """Number of scenarios, whose costs add up."""
        return len(self.scenarios)

    @property
    def weight(self) -> float:
        """Weights of all that is known, so that cost by weight is a mean squared distance."""
        mesh = self.build(self.space.config)
        known = [np.isfinite(_target(mesh, s)).sum(axis=1) / 3.0 for s in self.scenarios]
        pairs = zip(self.scenarios, known, strict=True)
        return float(sum(scenario.weights(self.alpha) @ count for scenario, count in pairs))

    @property
    def blocks(self) -> IntArray:
        """Which residuals belong together: those of a scenario."""
        mesh = self.build(self.space.config)
        sizes = [len(s.times) * len(_rows(mesh, s)) for s in self.scenarios]
        return np.repeat(np.arange(self.parts), sizes)

    def part(self, k: int, vector: FloatArray) -> float:
        """Cost of a scenario; not finite where the model does not get to its end."""
        cost = or_none(lambda: float(np.square(self.residuals(k, vector)).sum()))
        return float('nan') if cost is None else cost

    def residuals(self, k: int, vector: FloatArray) -> FloatArray:
        """Weighted offsets [m] of a scenario, shape (steps + 1, m); 0 where unknown.

        Their squares add up to the cost. Raises FloatingPointError as `simulate`.
        """
        mesh, scenario = self.build(self.space.apply(vector)), self.scenarios[k]
        root = np.sqrt(scenario.weights(self.alpha))
        return root[:, None] * _offsets(mesh, scenario, simulate(mesh, scenario))

    def part_gradient(self, k: int, vector: FloatArray) -> tuple[float, FloatArray]:
        """Cost of a scenario and its derivative by the vector, by the adjoint of the steps."""
        found = or_none(lambda: self._part_gradient(k, vector))
        return (float('nan'), np.zeros(len(self.space))) if found is None else found

    def sensitivity(self, k: int, vector: FloatArray) -> FloatArray:
        """Derivative of `residuals`, shape (steps + 1, m, n), by tangents forwards."""
        motion = self._motion(k, vector)
        rows = _rows(motion.mesh, self.scenarios[k])
        pairs = list(zip(motion.along.kinds, motion.along.along, strict=True))
        columns = np.zeros((motion.mesh.dim_x, len(self.space)))
        found = [columns[rows]]
        for step in motion.steps:
            slopes = step.slopes(motion.factor)
            own = step.solver(np.stack([slopes.push(*pair) for pair in pairs], axis=1))
            columns = step.tangent.push(columns) + np.concatenate([step.dt * own, own])
            found.append(columns[rows])
        root = np.sqrt(self.scenarios[k].weights(self.alpha))[:, None, None]
        known = np.isfinite(_target(motion.mesh, self.scenarios[k]))[..., None]
        return np.where(known, root * np.array(found) * self.space.slope(vector), 0.0)

    def _part_gradient(self, k: int, vector: FloatArray) -> tuple[float, FloatArray]:
        motion, scenario = self._motion(k, vector), self.scenarios[k]
        mesh, rows, weight = (
            motion.mesh,
            _rows(motion.mesh, scenario),
            scenario.weights(self.alpha),
        )
        off = _offsets(mesh, scenario, motion.states)
        adjoint, n = np.zeros(mesh.dim_x), mesh.dim_x // 2
        total: dict[str, FloatArray] = {}
        for i in range(len(motion.steps), 0, -1):
            step = motion.steps[i - 1]
            adjoint[rows] += 2.0 * weight[i] * off[i]
            own = step.solver(adjoint[n:] + step.dt * adjoint[:n])
            for kind, slope in step.slopes(motion.factor).pull(own).items():
                total[kind] = total.get(kind, 0.0) + slope
            adjoint = step.tangent.pull(adjoint[None])[0].copy()
        cost = float((weight[:, None] * np.square(off)).sum())
        return cost, motion.along.collect(total) * self.space.slope(vector)

    def _motion(self, k: int, vector: FloatArray) -> _Motion:
        """Open loop of a scenario with all that its derivatives need."""
        scenario, config = self.scenarios[k], self.space.apply(vector)
        mesh = self.build(config)
        x, steps = scenario.start(mesh), []
        states = [x]
        for u, dt in zip(scenario.inputs(mesh), np.diff(scenario.times).tolist(), strict=True):
            at = mesh.linearise(x, u)
            solver = at.solver(dt)
            change = at.change(dt, solver)
            steps.append(_Step(at, solver, dt, change))
            x = x + change
            states.append(x)
        if not np.isfinite(x).all():
            raise FloatingPointError(f'{scenario.name}: the model diverges')
        along = Directions.of(self.space, config, mesh, self.joined)
        return _Motion(mesh, along, gravity_factors(config, mesh), steps, np.array(states))


@dataclass(frozen=True)
class _Step:
    at: LinearisedSurface
    solver: Solver
    dt: float
    change: FloatArray

    @property
    def tangent(self) -> Tangent:
        return self.at.tangent(self.dt, self.solver, self.change)

    def slopes(self, factor: FloatArray) -> StepSlopes:
        return StepSlopes.of(self.at, factor, self.dt, self.change)


@dataclass(frozen=True)
class _Motion:
    mesh: MassSpring
    along: Directions
    factor: FloatArray
    steps: list[_Step]
    states: FloatArray


def _free(mesh: MassSpring, scenario: Scenario) -> BoolArray:
    """Which of the compared nodes are free; the driven ones are where they are."""
    return np.isin(scenario.compared, mesh.free)


def _rows(mesh: MassSpring, scenario: Scenario) -> IntArray:
    """Rows of the state that are compared, shape (m,)."""
    number = np.searchsorted(mesh.free, scenario.compared[_free(mesh, scenario)])
    return np.asarray((3 * number[:, None] + np.arange(3)).ravel())


def _target(mesh: MassSpring, scenario: Scenario) -> FloatArray:
    """Where they were [m], shape (steps + 1, m)."""
    return scenario.target[:, _free(mesh, scenario)].reshape(len(scenario.times), -1)


def _offsets(mesh: MassSpring, scenario: Scenario, states: FloatArray) -> FloatArray:
    """How far the compared nodes are off [m], shape (steps + 1, m); 0 where unknown."""
    target = _target(mesh, scenario)
    off = states[:, _rows(mesh, scenario)] - target
    return np.where(np.isfinite(target), off, 0.0)
