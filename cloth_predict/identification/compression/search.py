"""A coarse sheet that moves as a dense one does (Gomes 2016, section 5.1, eq. 5.4-5.16)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import sqrt

import numpy as np

from cloth_predict.config import Config
from cloth_predict.identification.compression.falling import times
from cloth_predict.identification.compression.task import Task
from cloth_predict.identification.failing import or_none
from cloth_predict.identification.objectives.parallel import Called, Parallel
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.objectives.trajectory import Trajectory
from cloth_predict.identification.optimisers.family import Method
from cloth_predict.identification.optimisers.result import Bounds, Callback, Result
from cloth_predict.identification.workers import workers
from cloth_predict.types import FloatArray

USUAL = Method('gradient', 2000)
"""How to search, where nothing else is asked for."""
HEAVIEST = 10.0
"""Factor to both sides of 1 beyond which the factor of gravity G_i is not searched."""


@dataclass(frozen=True)
class Followed:
    """How a coarse sheet follows a motion: cost (5.13) and, at each time, its error.

    error [m^2], shape (frames,): mean over the free nodes of the squared distance; NaN where the
    model does not get to the end.
    """

    cost: float
    error: FloatArray

    @property
    def rms(self) -> float:
        """RMS distance [m] over all times."""
        return float(np.sqrt(self.error.mean()))


@dataclass(frozen=True)
class Compression:
    """What came of a task: the configuration, and how it follows each motion by name.

    before: the same with all parameters equal; neither where it was not judged, as after Ctrl-C.
    result: of the search, over the trained motions; found: number of parameters.
    """

    task: Task
    method: Method
    found: int
    config: Config
    result: Result
    before: Mapping[str, Followed] = field(default_factory=dict)
    after: Mapping[str, Followed] = field(default_factory=dict)

    @property
    def trace(self) -> list[tuple[int, float]]:
        """Evaluations, and the best RMS distance [mm] over the trained motions after them."""
        task = self.task
        later = np.exp(task.alpha * times(task.duration))
        free = self.config.model.count - len(self.config.anchors.nodes)
        weight = len(task.trained) * free * later.sum()
        return [(number, 1e3 * sqrt(cost / weight)) for number, cost in self.result.trace]

    def share_left(self, name: str) -> float:
        """Cost by that with all parameters equal."""
        return self.after[name].cost / self.before[name].cost


def searched(
    task: Task,
    method: Method = USUAL,
    jobs: int = 1,
    callback: Callback = lambda evaluations, best: None,
) -> Compression:
    """Search the parameters of the coarse sheet, from all equal (Gomes 2016, section 5.1).

    Ctrl-C keeps the best so far. Raises DivergedError where no valid cost was found.
    """
    objective = task.objective(task.trained, task.alpha)
    space = objective.space
    with workers(Called(objective), jobs) as do:
        costs = Parallel(objective, do)
        found = method.search(costs, space.start, bounds(space), task.facts, callback)
    return Compression(task, method, len(space), weighed(space.apply(found.best)), found)


def judged(found: Compression) -> Compression:
    """Let the coarse sheet follow every motion, as it was found and with all equal."""
    task = found.task
    return replace(found, before=follow(task, task.equal), after=follow(task, found.config))


def bounds(space: Space) -> Bounds:
    """Lowest and highest vector; a factor of gravity stays nearer to 1 than the rest to theirs."""
    low, high = space.bounds
    of_load = np.array([parameter.field == 'loads' for parameter in space.parameters])
    reach = np.where(of_load, np.log(HEAVIEST), np.inf)
    return np.maximum(low, space.start - reach), np.minimum(high, space.start + reach)


def weighed(config: Config) -> Config:
    """Scale springs, dampers and masses so that the masses add up to `model.mass`.

    Under gravity alone the motion tells their ratios only; a force from elsewhere tells more.
    """
    model = config.model
    factor = model.mass / sum(model.masses)
    springs, dampers, masses = (
        tuple(factor * value for value in values)
        for values in (model.springs, model.dampers, model.masses)
    )
    return replace(config, model=replace(model, springs=springs, dampers=dampers, masses=masses))


def follow(task: Task, config: Config) -> dict[str, Followed]:
    """Let a coarse sheet follow all motions of a task."""
    found = {}
    for k, name in enumerate(task.names):
        objective = replace(task.objective(task.names, 0.0), space=Space(config, ()))
        scenario = objective.scenarios[k]
        off = or_none(partial(_squares, objective, k))
        if off is None or not np.isfinite(off).all():
            off = np.full(len(scenario.times), np.nan)
        free = config.model.count - len(config.anchors.nodes)
        found[name] = Followed(float(scenario.weights(task.alpha) @ off), off / free)
    return found


def _squares(objective: Trajectory, k: int) -> FloatArray:
    """Squared distances of a motion, summed over the nodes [m^2], shape (frames,)."""
    return np.asarray(np.square(objective.residuals(k, np.zeros(0))).sum(axis=1))
