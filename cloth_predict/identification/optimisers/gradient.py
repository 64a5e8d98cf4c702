"""Quasi-Newton descent along the exact gradient: L-BFGS-B of SciPy."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from cloth_predict.identification.optimisers.result import Bounds, Callback, Costs, Result, Search
from cloth_predict.types import FloatArray

FLAT = 1e-10
"""Share of the cost by which a step has to lower it, or the descent ends."""
WALL = 1e3
"""Factor of the first cost that stands for one that is not finite: the line search turns back."""


def descend(
    costs: Costs,
    start: FloatArray,
    bounds: Bounds,
    budget: int,
    rng: np.random.Generator,
    callback: Callback = lambda evaluations, best: None,
) -> Result:
    """Follow the gradient from the start; `rng` has no say.

    The cost is divided by that at the start, so that the first step has a length of about one.
    """
    search = Search(costs, budget, callback)

    def work() -> str:
        scale, _ = search.gradient(start)
        if not np.isfinite(scale):
            return 'the first cost is not finite'
        if scale == 0:
            return 'the first cost is zero'

        def scaled(vector: FloatArray) -> tuple[float, FloatArray]:
            cost, slope = search.gradient(vector)
            if not np.isfinite(cost):
                return WALL, np.zeros_like(vector)
            return cost / scale, slope / scale

        options = {'maxiter': budget, 'maxfun': budget, 'ftol': FLAT, 'maxcor': 20}
        found = minimize(
            scaled, start, jac=True, method='L-BFGS-B', bounds=list(zip(*bounds, strict=True)),
            options=options,
        )  # fmt: skip
        return str(found.message).lower()

    return search.run(work)
