"""Simulated annealing as in the thesis (Gomes 2016, section 5.2)."""

from __future__ import annotations

import numpy as np

from cloth_predict.identification.optimisers.result import Bounds, Callback, Costs, Result, Search
from cloth_predict.types import FloatArray

WIDTH = 0.1
"""Standard deviation of W, on the scale of the search: 10 % of a positive parameter."""
WARM = 0.1
"""Temperature at first, by the first cost: a candidate 10 % worse is taken in 1 of 3 cases."""
COOLER = 0.9
"""Factor of the temperature from plateau to plateau."""
PLATEAU = 10
"""Candidates of a plateau for each parameter, but at most `LONGEST` in all."""
LONGEST = 200
COLDEST = 1e-6
"""Temperature, by that at first, at which the search ends."""


def anneal(
    costs: Costs,
    start: FloatArray,
    bounds: Bounds,
    budget: int,
    rng: np.random.Generator,
    callback: Callback = lambda evaluations, best: None,
) -> Result:
    """Take a candidate theta + W (5.11) that is better, or else with probability exp(-dC / T).

    W is normal noise on every parameter. The temperature starts at `WARM` times the first cost and
    falls by `COOLER` after each plateau, whatever the budget, so that a search can be continued.
    """
    search = Search(costs, budget, callback)

    def work() -> str:
        here, cost = start, search.value(start)
        first = temperature = WARM * cost if np.isfinite(cost) else np.inf
        plateau = min(PLATEAU * len(start), LONGEST)
        if cost == 0:
            return 'the first cost is zero'
        while not temperature < COLDEST * first:
            for _ in range(plateau):
                candidate = np.clip(here + rng.normal(0.0, WIDTH, len(start)), *bounds)
                found = search.value(candidate)
                worse = found - cost if np.isfinite(found) else np.inf
                if worse <= 0 or rng.random() < np.exp(-worse / temperature):
                    here, cost = candidate, found
            if np.isfinite(cost) and not np.isfinite(first):
                first = temperature = WARM * cost
            temperature *= COOLER
        return 'cooled down'

    return search.run(work)
