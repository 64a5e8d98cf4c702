"""CMA-ES, the covariance matrix adaptation evolution strategy (Hansen 2016), of library cma."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cloth_predict.errors import ClothPredictError
from cloth_predict.identification.optimisers.result import Bounds, Callback, Costs, Result, Search
from cloth_predict.types import FloatArray

WIDTH = 0.3
"""Standard deviation of the first generation, on the scale of the search: 30 % of a positive
parameter."""
MOST_FULL = 100
"""Number of parameters up to which the full covariance is adapted; above it, its diagonal."""


def evolve(
    costs: Costs,
    start: FloatArray,
    bounds: Bounds,
    budget: int,
    rng: np.random.Generator,
    callback: Callback = lambda evaluations, best: None,
) -> Result:
    """Sample generations round the best so far. A cost that is not finite ranks last."""
    search, cma = Search(costs, budget, callback), _library()

    def work() -> str:
        search.value(start)
        width = np.minimum(WIDTH, (bounds[1] - bounds[0]) / 4)
        options = {
            'bounds': [bound.tolist() for bound in bounds],
            'CMA_stds': width / WIDTH,
            'CMA_diagonal': len(start) > MOST_FULL,
            'seed': 1 + int(rng.integers(2**31 - 1)),  # 0 is the time
            'verbose': -9,
            'verb_log': 0,
            'verb_disp': 0,
        }
        inside = np.clip(start, *(bounds[0] + 1e-9, bounds[1] - 1e-9))
        strategy = cma.CMAEvolutionStrategy(inside, WIDTH, options)
        while not strategy.stop():
            vectors = strategy.ask()
            found = search.values([np.asarray(vector, float) for vector in vectors])
            worst = max((cost for cost in found if math.isfinite(cost)), default=1.0)
            last = 10.0 * abs(worst) + 1.0
            strategy.tell(vectors, [c if math.isfinite(c) else last for c in found])
        return 'converged: ' + ', '.join(strategy.stop())

    return search.run(work)


def _library() -> Any:
    try:
        import cma
    except ImportError:
        raise ClothPredictError(
            'the optimiser cma needs the package cma: pip install cma'
        ) from None
    return cma
