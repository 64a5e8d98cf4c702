"""The protocol of the optimisers: a cost to lower, what came of it, and what it cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from cloth_predict.errors import ClothPredictError
from cloth_predict.types import FloatArray

Bounds = tuple[FloatArray, FloatArray]
"""Lowest and highest vector, each of shape (n,)."""


class DivergedError(ClothPredictError):
    """A search that found not one valid cost."""


class Costs(Protocol):
    """What is to be lowered; a cost that is not finite counts as none."""

    def values(self, vectors: Sequence[FloatArray]) -> list[float]:
        """Costs of vectors of shape (n,), which may be evaluated side by side."""

    def gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Cost and its derivative, shape (n,)."""

    @property
    def gradient_price(self) -> int:
        """What a derivative takes, with its cost, in evaluations of the cost alone."""


@dataclass(frozen=True)
class Plain:
    """A cost that is one function, and maybe one with its derivative."""

    cost: Callable[[FloatArray], float]
    with_gradient: Callable[[FloatArray], tuple[float, FloatArray]] | None = None
    gradient_price: int = 1

    def values(self, vectors: Sequence[FloatArray]) -> list[float]:
        """Evaluate one by one."""
        return [float(self.cost(vector)) for vector in vectors]

    def gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Evaluate with the derivative."""
        if self.with_gradient is None:
            raise ClothPredictError('this cost has no gradient; choose another optimiser')
        return self.with_gradient(vector)


@dataclass(frozen=True)
class Result:
    """What a search found: the best vector, shape (n,), and its cost.

    evaluations: of the cost, a gradient by its price; refused: how many of them were not finite;
    trace: evaluations so far and best cost, at the first and whenever it fell;
    stopped: why it ended.
    """

    best: FloatArray
    cost: float
    evaluations: int
    refused: int
    trace: tuple[tuple[int, float], ...]
    stopped: str

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it."""
        return self.stopped == INTERRUPTED


INTERRUPTED = 'interrupted'

Callback = Callable[[int, float], None]
"""Called after each evaluation with their number and the best cost, infinite before the first."""


class Optimiser(Protocol):
    """A way to lower a cost within a budget of evaluations; Ctrl-C keeps the best so far."""

    def __call__(
        self,
        costs: Costs,
        start: FloatArray,
        bounds: Bounds,
        budget: int,
        rng: np.random.Generator,
        callback: Callback = lambda evaluations, best: None,
    ) -> Result:
        """Return the best vector found. Raises DivergedError where no cost is finite."""


class SpentError(Exception):
    """The budget is spent."""


@dataclass
class Search:
    """Counts evaluations and keeps the best; every optimiser evaluates through one."""

    costs: Costs
    budget: int
    callback: Callback
    best: FloatArray | None = None
    cost: float = np.inf
    evaluations: int = 0
    refused: int = 0
    trace: list[tuple[int, float]] = field(default_factory=list)

    def value(self, vector: FloatArray) -> float:
        """Return the cost of one vector, infinite where it is not finite."""
        return self.values([vector])[0]

    def values(self, vectors: Sequence[FloatArray]) -> list[float]:
        """Costs of several. Raises SpentError where the budget does not allow all of them."""
        if self.evaluations + len(vectors) > self.budget:
            raise SpentError
        found = self.costs.values(vectors)
        return [self._take(*pair, 1) for pair in zip(vectors, found, strict=True)]

    def gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Cost and derivative of one; where it is not finite the cost is infinite."""
        if self.evaluations + self.costs.gradient_price > self.budget:
            raise SpentError
        cost, slope = self.costs.gradient(vector)
        finite = bool(np.isfinite(slope).all())
        return self._take(vector, cost if finite else np.nan, self.costs.gradient_price), slope

    def _take(self, vector: FloatArray, cost: float, price: int) -> float:
        self.evaluations += price
        if not np.isfinite(cost):
            self.refused += 1
            cost = np.inf
        if cost < self.cost:
            self.best, self.cost = np.array(vector, float), cost
            self.trace.append((self.evaluations, cost))
        self.callback(self.evaluations, self.cost)
        return cost

    def run(self, work: Callable[[], str]) -> Result:
        """Let an optimiser work until it, the budget or Ctrl-C ends it; `work` says why it did.

        Before there is a result, Ctrl-C is left to the caller.
        """
        try:
            stopped = work()
        except SpentError:
            stopped = 'the budget is spent'
        except KeyboardInterrupt:
            if self.best is None:
                raise
            stopped = INTERRUPTED
        if self.best is None:
            raise DivergedError(
                f'no valid result: none of {self.evaluations} evaluations has a finite cost '
                f'({stopped})'
            )
        trace = tuple(self.trace)
        return Result(self.best, self.cost, self.evaluations, self.refused, trace, stopped)
