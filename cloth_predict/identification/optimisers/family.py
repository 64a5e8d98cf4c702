"""The optimisers by name, and a search by one of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cloth_predict.identification.optimisers.annealing import anneal
from cloth_predict.identification.optimisers.cma_es import evolve
from cloth_predict.identification.optimisers.gradient import descend
from cloth_predict.identification.optimisers.result import (
    Bounds,
    Callback,
    Costs,
    Optimiser,
    Result,
)
from cloth_predict.identification.optimisers.study import Study, StudyFile
from cloth_predict.types import FloatArray

OPTIMISERS: dict[str, Optimiser] = {'annealing': anneal, 'cma': evolve, 'gradient': descend}
BUDGETS = {'annealing': 5000, 'cma': 500, 'gradient': 1000}
"""Evaluations of each, where none are given."""


@dataclass(frozen=True)
class Method:
    """How to search: an optimiser by name, its budget of evaluations, and the seed.

    file: where the search is kept, if it is.
    """

    optimiser: str
    budget: int
    seed: int = 0
    file: StudyFile | None = None

    @property
    def study(self) -> str | None:
        """Name of the file, if any."""
        return None if self.file is None else str(self.file.path)

    @property
    def resumable(self) -> str:
        """How to go on, in words."""
        return 'not kept' if self.file is None else f'{self.study}, to go on with by --resume'

    def search(
        self,
        costs: Costs,
        start: FloatArray,
        bounds: Bounds,
        facts: Mapping[str, str],
        callback: Callback,
    ) -> Result:
        """Lower costs, which depend on the facts, from a start; see `Optimiser` and `Study`."""
        if self.file is not None:
            own = {'optimiser': self.optimiser, 'seed': str(self.seed)}
            costs = Study(costs, self.file, {**facts, **own})
        rng = np.random.default_rng(self.seed)
        return OPTIMISERS[self.optimiser](costs, start, bounds, self.budget, rng, callback)
