"""Run ahead by as many predictions as there are inputs: for filters without a shorter way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from cloth_predict.types import Belief, Dynamics, Filter, FloatArray, IntArray

B = TypeVar('B', bound=Belief)


def run_ahead(
    estimator: Filter[B],
    belief: B,
    model: Dynamics,
    inputs: Sequence[FloatArray],
    q: FloatArray,
    dt: float,
    rows: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Mean, shape (dim_x,), and covariances of `rows` after one step of dt [s] per input."""
    for u in inputs:
        belief = estimator.predict(belief, model, u, q, dt)
    return belief.mean, belief.marginals(rows)
