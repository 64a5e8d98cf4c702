"""What an optimiser takes to identify a towel of known parameters, and a gradient beside its cost.

Evaluations of the cost, a gradient by its price, until each optimiser has the best cost that
annealing finds, and the parameters that come out. The numbers of test/test_identification.py and
the price of a gradient are from here.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cloth_predict.evaluation.cases import labelled_case
from cloth_predict.identification.objectives.parallel import Called, Parallel, Summed
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.objectives.stretches import trajectories
from cloth_predict.identification.optimisers.family import OPTIMISERS
from cloth_predict.identification.optimisers.result import Result
from cloth_predict.performance import one_core

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from shaken import NAMES, TRUE, first_guess, recording

BUDGETS = {'annealing': 2000, 'cma': 500, 'gradient': 300}
SEED = 0
REPEATS = 10


def objective(names: tuple[str, ...], seconds: float) -> Parallel:
    """Costs on a recording of the shaken towel."""
    config = first_guess()
    case = labelled_case(recording(1, seconds), config, 'towel')
    summed = Summed((trajectories(case, Space.of(config, names), 9.0),))
    return Parallel(summed, lambda work: map(Called(summed), work))


def seconds_of(call: Callable[[], object]) -> float:
    """Time of a call [s], the shortest of several."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def prices() -> None:
    """Print what a gradient takes beside its cost."""
    for label, names in (
        ('one value for each family', NAMES),
        ('one for each spring, damper, mass and load', tuple(
            f'model.{name}' for name in ('springs', 'dampers', 'masses', 'loads')
        )),
    ):  # fmt: skip
        costs = objective(names, 1.5)
        start = costs.objective.space.start
        alone = seconds_of(lambda c=costs, s=start: c.values([s]))  # type: ignore[misc]
        both = seconds_of(lambda c=costs, s=start: c.gradient(s))  # type: ignore[misc]
        print(
            f'{label} ({len(start)}): cost {1e3 * alone:.1f} ms, with gradient {both / alone:.2f} '
            f'times that'
        )


def race() -> None:
    """Print what each optimiser takes for the best cost of annealing."""
    costs = objective(NAMES, 1.5)
    space, weight = costs.objective.space, costs.objective.weight
    found: dict[str, Result] = {}
    for name, budget in BUDGETS.items():
        rng = np.random.default_rng(SEED)
        found[name] = OPTIMISERS[name](costs, space.start, space.bounds, budget, rng)
    target = found['annealing']
    for name, result in found.items():
        reached = [number for number, cost in result.trace if cost <= target.cost]
        values = ', '.join(
            f'{n[6:]} {100 * (v / TRUE[n[6:]] - 1):+.1f} %'
            for n, v in zip(NAMES, space.values(result.best), strict=True)
        )
        print(
            f'{name}: {1e3 * np.sqrt(result.cost / weight):.4f} mm in {result.evaluations} '
            f'evaluations; that of annealing after {reached[0] if reached else "none"} '
            f'({100 * reached[0] / target.trace[-1][0]:.1f} %); {values}'
        )


if __name__ == '__main__':
    with one_core():
        prices()
        race()
