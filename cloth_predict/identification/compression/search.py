"""A coarse sheet that moves as a dense one does (Gomes 2016, section 5.1, eq. 5.4-5.16)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from cloth_predict.config import Config
from cloth_predict.identification.compression.task import Task
from cloth_predict.identification.objectives.parallel import Called, Parallel
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.optimisers.family import OPTIMISERS
from cloth_predict.identification.optimisers.result import Bounds, Callback, Result
from cloth_predict.identification.workers import workers
from cloth_predict.types import FloatArray

BUDGET = 2000
"""Evaluations of the model, where none are given."""
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

    before: the same with all parameters equal; result: of the search, over the trained motions;
    found: number of parameters.
    """

    task: Task
    optimiser: str
    seed: int
    found: int
    config: Config
    result: Result
    before: Mapping[str, Followed]
    after: Mapping[str, Followed]

    @property
    def trace(self) -> list[tuple[int, float]]:
        """Evaluations, and the best RMS distance [mm] over the trained motions after them."""
        task = self.task
        size = len(self.before[task.names[0]].error)
        later = np.exp(task.alpha * np.linspace(0.0, task.duration, size))
        free = self.config.model.count - len(self.config.anchors.nodes)
        weight = len(task.trained) * free * later.sum()
        return [(number, 1e3 * sqrt(cost / weight)) for number, cost in self.result.trace]

    def share_left(self, name: str) -> float:
        """Cost by that with all parameters equal."""
        return self.after[name].cost / self.before[name].cost


def compress(
    task: Task,
    optimiser: str = 'gradient',
    budget: int = BUDGET,
    seed: int = 0,
    jobs: int = 1,
    callback: Callback = lambda evaluations, best: None,
) -> Compression:
    """Search the parameters of the coarse sheet, from all equal (Gomes 2016, section 5.1).

    budget: evaluations of the model, a gradient by its price; Ctrl-C keeps the best so far.
    Raises DivergedError where no valid cost was found.
    """
    objective = task.objective(task.trained, task.alpha)
    space, rng = objective.space, np.random.default_rng(seed)
    with workers(Called(objective), jobs) as do:
        costs = Parallel(objective, do)
        found = OPTIMISERS[optimiser](costs, space.start, bounds(space), budget, rng, callback)
    config = weighed(space.apply(found.best))
    before, after = follow(task, task.equal), follow(task, config)
    return Compression(task, optimiser, seed, len(space), config, found, before, after)


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
        try:
            with np.errstate(all='ignore'):
                off = np.square(objective.residuals(k, np.zeros(0))).sum(axis=1)
        except FloatingPointError:
            off = np.full(len(scenario.times), np.nan)
        if not np.isfinite(off).all():
            off = np.full(len(scenario.times), np.nan)
        free = config.model.count - len(config.anchors.nodes)
        found[name] = Followed(float(scenario.weights(task.alpha) @ off), off / free)
    return found
