"""The command `identify` as one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path

from cloth_predict.identification.cost_curve import draw
from cloth_predict.identification.identified import Identified, Outputs, Scores
from cloth_predict.identification.objectives.determined import determined
from cloth_predict.identification.objectives.parallel import Called, Objective, Parallel
from cloth_predict.identification.optimisers.family import Method
from cloth_predict.identification.provenance import (
    HELD_OUT,
    TRAINED,
    check_output,
    write_configuration,
)
from cloth_predict.identification.recordings import read_apart
from cloth_predict.identification.task import Task
from cloth_predict.identification.workers import workers
from cloth_predict.types import FloatArray

Progress = Callable[[int, int, float], None]
"""Called with evaluations done, their budget, and the best RMS distance [mm]."""


def identify(
    sources: Sequence[Path],
    output: Path,
    task: Task,
    method: Method,
    jobs: int = 1,
    held_out: Sequence[Path] = (),
    progress: Progress = lambda done, budget, best: None,
) -> Identified:
    """Identify the parameters of a task on recordings and write them, with their provenance.

    Ctrl-C writes the best so far. What is held out has no say in the search.
    """
    files = Outputs.at(output)
    check_output(files.configuration)
    trained, others = read_apart(sources, held_out, task.config)
    cost = task.objective_on(trained.cases, every=False)
    seen = cost if task.objective == 'trajectory' else task.objective_on(trained.cases)
    every = {TRAINED: seen}
    if others.cases:
        every[HELD_OUT] = task.objective_on(others.cases)
    for objective in (cost, *every.values()):
        _ = objective.weight  # complains before the search takes its time
    space, weight = task.space, cost.weight

    def show(done: int, best: float) -> None:
        progress(done, method.budget, 1e3 * sqrt(best / weight))

    with workers(Called(cost), jobs) as do:
        costs = Parallel(cost, do)
        result = method.search(costs, space.start, space.bounds, task.facts(trained.cases), show)
        config = space.apply(result.best)
        lines = trained.lines, others.lines
        found = Identified(task, method, config, result, weight, *lines)
        _write(found, files)  # before what takes longer, and may be cut off
        if result.interrupted:
            return found
        residuals, slopes = costs.linearised(result.best)
    sure = determined(slopes, residuals, cost.blocks, task.config.filter.measurement_noise)
    scores = {where: _scored(of, result.best, jobs) for where, of in every.items()}
    found = replace(found, determined=sure, scores=scores)
    _write(found, files)
    return found


def _scored(objective: Objective, best: FloatArray, jobs: int) -> Scores:
    """RMS distances with the first parameters and those found; NaN where a model fails."""
    with workers(Called(objective), jobs) as do:
        costs = Parallel(objective, do).values([objective.space.start, best])
    before, after = (1e3 * sqrt(max(cost, 0.0) / objective.weight) for cost in costs)
    return Scores(before, after)


def _write(found: Identified, files: Outputs) -> None:
    write_configuration(files.configuration, found.file())
    draw(found.trace, found.method.optimiser, found.result.evaluations, files.curve)
