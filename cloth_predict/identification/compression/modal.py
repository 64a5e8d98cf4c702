"""Two ways to make a dense sheet cheap, at what each costs: fewer nodes, or fewer shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ClothPredictError
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.identification.compression.falling import (
    HANGING,
    Motion,
    motion,
    released,
    sheet,
)
from cloth_predict.identification.compression.search import Compression
from cloth_predict.identification.compression.task import Task
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.modes import linear_modes, motion_modes
from cloth_predict.models.reduced import Reduced
from cloth_predict.observations import LinearObservation, VisiblePositions
from cloth_predict.surface.equilibrium import settled
from cloth_predict.types import FloatArray, Gaussian, IntArray, Observation, StiffDynamics

EQUAL, COMPRESSED = 'equal', 'compressed'
"""Coarse sheets: all parameters equal, and as they were found."""
MOTIONS, VIBRATIONS, BOTH = 'shapes of motions', 'vibrations', 'compressed, shapes of motions'
"""What the dense sheet is held to, and the compressed one."""
COUNTS = (10, 20, 60)
"""Numbers of shapes; 60 have as many states as 20 free nodes."""
TIMED = 20
"""Steps that are timed; the fastest counts, which nothing else on the machine has slowed down."""
SIGMA = 3e-4
"""Standard deviation [m] of a coordinate of a marker."""


@dataclass(frozen=True)
class Rival:
    """A model beside the dense one: what it costs, and how it follows each motion by name.

    shapes: how many it is held to, or None where every node moves by itself; step, cycle [s]: of
    the mean alone, and of a prediction and an update of the EKF that sees all compared nodes;
    rms [m], NaN where the model does not get to the end.
    """

    kind: str
    shapes: int | None
    states: int
    step: float
    cycle: float
    rms: dict[str, float]


@dataclass(frozen=True)
class _Model:
    """A model of some nodes of the dense sheet, of which `free`, shape (free,), move.

    project: its state for that of the free nodes; observation, of the compared nodes.
    """

    kind: str
    shapes: int | None
    dynamics: StiffDynamics
    u: FloatArray
    free: IntArray
    project: Callable[[FloatArray], FloatArray]
    observation: Observation

    def start(self, one: Motion) -> FloatArray:
        """State at the first time of a motion."""
        place, velocity = one.position[0, self.free], one.velocity[self.free]
        return self.project(np.concatenate([place.ravel(), velocity.ravel()]))


def rivals(found: Compression, progress: Callable[[str], None] = lambda name: None) -> list[Rival]:
    """Measure the coarse sheets, and reductions to several numbers of shapes.

    Shapes are those of the motions that were trained on, or of small vibrations about the sheet at
    rest. Times are of this machine, at this moment. Raises ClothPredictError for a sheet that has
    no rest.
    """
    task, results = found.task, []
    motions = {name: motion(task.dense, name, task.duration) for name in task.names}
    for model in _models(found):
        progress(model.kind if model.shapes is None else f'{model.kind} {model.shapes}')
        rms = {name: _rms(task, model, one) for name, one in motions.items()}
        times = _times(model, motions[task.names[0]])
        results.append(Rival(model.kind, model.shapes, model.dynamics.dim_x, *times, rms))
    return results


def at_equal_cost(found: Sequence[Rival], by: str) -> dict[str, Rival]:
    """Of each kind of shapes the one with most that costs no more than the compressed sheet.

    by: `step` or `cycle`. A kind all of whose reductions cost more is left out.
    """
    limit = next(getattr(one, by) for one in found if one.kind == COMPRESSED)
    cheap = [one for one in found if one.shapes is not None and getattr(one, by) <= limit]
    return {one.kind: one for one in sorted(cheap, key=lambda one: one.shapes or 0)}


def _models(found: Compression) -> Iterator[_Model]:
    task = found.task
    flat = released(task.dense, HANGING)[0]
    for kind, config in ((EQUAL, task.equal), (COMPRESSED, found.config)):
        yield _coarse(kind, config, task.chosen, flat)
    dense, coarse = sheet(task.dense), sheet(found.config)
    u = dense.input(flat[dense.driven])
    try:
        rest = settled(dense, u, flat)
    except FloatingPointError as error:
        raise ClothPredictError(f'no comparison with modal reduction: {error}') from None
    for kind, mesh, nodes in (
        (MOTIONS, dense, np.arange(dense.nodes)),
        (BOTH, coarse, task.chosen),
    ):
        yield from _reduced(kind, task, mesh, nodes, rest, _of_motions(task, mesh, nodes, rest))
    still = np.concatenate([rest[dense.free].ravel(), np.zeros(dense.dim_x // 2)])
    slow = linear_modes(dense, still, u, min(max(COUNTS), len(still) // 2)).basis
    yield from _reduced(VIBRATIONS, task, dense, np.arange(dense.nodes), rest, slow)


def _coarse(kind: str, config: Config, nodes: IntArray, flat: FloatArray) -> _Model:
    mesh = sheet(config)
    u = mesh.input(flat[nodes[mesh.driven]])
    seen = VisiblePositions.of_nodes(np.arange(len(mesh.free)), SIGMA)
    return _Model(kind, None, mesh, u, nodes[mesh.free], np.asarray, seen)


def _reduced(
    kind: str, task: Task, mesh: MassSpring, nodes: IntArray, rest: FloatArray, basis: FloatArray
) -> Iterator[_Model]:
    """Hold a mesh of these nodes of the dense one to several numbers of shapes.

    rest [m] of the dense sheet, shape (dense nodes, 3).
    """
    free, u = nodes[mesh.free], mesh.input(rest[nodes[mesh.driven]])
    compared = np.searchsorted(free, _compared(task))
    rows = (3 * compared[:, None] + np.arange(3)).ravel()
    for count in COUNTS:
        if count <= basis.shape[1]:
            reduced = Reduced(mesh, rest[free].ravel(), basis[:, :count])
            seen = LinearObservation(*reduced.seen(rows), np.full(len(rows), SIGMA**2))
            yield _Model(kind, count, reduced, u, free, reduced.project, seen)


def _of_motions(task: Task, mesh: MassSpring, nodes: IntArray, rest: FloatArray) -> FloatArray:
    """Shapes of the motions that were trained on, most telling first."""
    free = nodes[mesh.free]
    frames = [motion(task.dense, name, task.duration).position[:, free] for name in task.trained]
    flat = np.concatenate(frames).reshape(-1, 3 * len(free))
    return motion_modes(mesh, rest[free].ravel(), flat, min(max(COUNTS), *flat.shape)).basis


def _compared(task: Task) -> IntArray:
    """Nodes of the dense sheet that are compared and free, shape (m,)."""
    return np.setdiff1d(task.chosen, np.array(task.dense.anchors.nodes))


def _rms(task: Task, model: _Model, one: Motion) -> float:
    """RMS distance [m] of the compared nodes over a motion."""
    x, squares = model.start(one), []
    target = one.position[:, _compared(task)].reshape(len(one.times), -1)
    with np.errstate(all='ignore'):
        for place, dt in zip(target, [*np.diff(one.times), 0.0], strict=True):
            squares.append(np.square(model.observation.h(x) - place).sum())
            try:
                x = ImplicitEuler().step(model.dynamics, x, model.u, dt) if dt else x
            except FloatingPointError:
                return float('nan')
    return float(np.sqrt(3.0 * np.mean(squares) / target.shape[1]))


def _times(model: _Model, one: Motion) -> tuple[float, float]:
    """Time [s] of a step, and of a prediction and an update of the EKF."""
    x, dt, method = model.start(one), float(one.times[1] - one.times[0]), ImplicitEuler()
    ekf, q, steps, cycles = ExtendedKalmanFilter(method), np.ones(len(x)), [], []
    belief = Gaussian(x, 1e-4 * np.eye(len(x)))
    for _ in range(TIMED):
        began = perf_counter()
        x = method.step(model.dynamics, x, model.u, dt)
        steps.append(perf_counter() - began)
        began = perf_counter()
        belief = ekf.predict(belief, model.dynamics, model.u, q, dt)
        belief, _ = ekf.update(belief, model.observation, model.observation.h(x))
        cycles.append(perf_counter() - began)
    return min(steps), min(cycles)
