"""The command `identify` as one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path

import numpy as np

from cloth_predict.evaluation.cases import Case
from cloth_predict.formats.files import make_folder
from cloth_predict.identification.cost_curve import draw
from cloth_predict.identification.identified import (
    Identified,
    Outputs,
    Scores,
    Settings,
)
from cloth_predict.identification.objectives.determined import determined
from cloth_predict.identification.objectives.parallel import Called, Objective, Parallel
from cloth_predict.identification.optimisers.family import BUDGETS, OPTIMISERS
from cloth_predict.identification.optimisers.result import Result
from cloth_predict.identification.optimisers.study import Study
from cloth_predict.identification.provenance import (
    HELD_OUT,
    TRAINED,
    read_cases,
    write_configuration,
)
from cloth_predict.identification.task import USUAL, Task
from cloth_predict.identification.workers import workers
from cloth_predict.types import FloatArray

Progress = Callable[[int, int, float], None]
"""Called with evaluations done, their budget, and the best RMS distance [mm]."""


def identify(
    sources: Sequence[Path],
    output: Path,
    task: Task,
    held_out: Sequence[Path] = (),
    settings: Settings | None = None,
    progress: Progress = lambda done, budget, best: None,
) -> Identified:
    """Identify the parameters of a task on recordings and write them, with their provenance.

    Ctrl-C writes the best so far. What is held out has no say in the search.
    """
    settings = settings or Settings()
    cases, names = read_cases(sources, task.config)
    others, held = read_cases(held_out, task.config)
    optimiser = settings.optimiser or USUAL[task.objective]
    files, cost = Outputs.at(output), task.objective_on(cases, every=False)
    seen = cost if task.objective == 'trajectory' else task.objective_on(cases)
    every = {TRAINED: seen} | ({HELD_OUT: task.objective_on(others)} if others else {})
    for objective in (cost, *every.values()):
        _ = objective.weight  # complains before the search takes its time
    with workers(Called(cost), settings.jobs) as do:
        costs = Parallel(cost, do)
        result = _searched(task, costs, cases, optimiser, settings, files, progress)
        found = Identified(
            task,
            optimiser,
            settings,
            task.space.apply(result.best),
            result,
            cost.weight,
            names,
            held,
            settings.resume or files.study,
        )
        _write(found, files)  # before what takes longer, and may be cut off
        if result.interrupted:
            return found
        residuals, slopes = costs.linearised(result.best)
    sure = determined(slopes, residuals, cost.blocks, task.config.filter.measurement_noise)
    scores = {where: _scored(of, result.best, settings.jobs) for where, of in every.items()}
    found = replace(found, determined=sure, scores=scores)
    _write(found, files)
    return found


def _searched(
    task: Task,
    costs: Parallel,
    cases: Sequence[Case],
    optimiser: str,
    settings: Settings,
    files: Outputs,
    progress: Progress,
) -> Result:
    space, weight = task.space, costs.objective.weight
    facts = {**task.facts(cases), 'optimiser': optimiser, 'seed': str(settings.seed)}
    resumed = settings.resume is not None
    make_folder(files.configuration.parent)
    study = Study(costs, settings.resume or files.study, facts, resumed)
    budget = settings.budget or BUDGETS[optimiser]

    def show(done: int, best: float) -> None:
        progress(done, budget, 1e3 * sqrt(best / weight))

    rng = np.random.default_rng(settings.seed)
    return OPTIMISERS[optimiser](study, space.start, space.bounds, budget, rng, show)


def _scored(objective: Objective, best: FloatArray, jobs: int) -> Scores:
    """RMS distances with the first parameters and those found; NaN where a model fails."""
    with workers(Called(objective), jobs) as do:
        costs = Parallel(objective, do).values([objective.space.start, best])
    before, after = (1e3 * sqrt(max(cost, 0.0) / objective.weight) for cost in costs)
    return Scores(before, after)


def _write(found: Identified, files: Outputs) -> None:
    write_configuration(files.configuration, found.file())
    draw(found.trace, found.optimiser, found.result.evaluations, files.curve)
