"""A cost that is a sum of parts, such as recordings, evaluated side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.types import FloatArray, IntArray


class Objective(Protocol):
    """A sum of squared residuals [m^2] in parts."""

    @property
    def space(self) -> Space:
        """The parameters."""

    @property
    def parts(self) -> int:
        """Number of parts, whose costs add up."""

    @property
    def gradient_price(self) -> int:
        """See `Costs`."""

    @property
    def weight(self) -> float:
        """By what the cost has to be divided for a mean squared distance [m^2]."""

    @property
    def blocks(self) -> IntArray:
        """Which residuals belong together, shape (residuals,), of all parts after each other."""

    def part(self, k: int, vector: FloatArray) -> float:
        """Cost of a part; NaN where there is none."""

    def part_gradient(self, k: int, vector: FloatArray) -> tuple[float, FloatArray]:
        """The same, with its derivative, shape (n,)."""

    def residuals(self, k: int, vector: FloatArray) -> FloatArray:
        """Residuals [m] of a part, of any shape; their squares add up to its cost."""

    def sensitivity(self, k: int, vector: FloatArray) -> FloatArray:
        """Their derivative, of that shape and, along a further axis, the parameters."""


@dataclass(frozen=True)
class Summed:
    """Several objectives of the same space, such as one for each recording (5.16)."""

    objectives: tuple[Objective, ...]

    @property
    def space(self) -> Space:
        """The parameters."""
        return self.objectives[0].space

    @property
    def parts(self) -> int:
        """Parts of all."""
        return sum(one.parts for one in self.objectives)

    @property
    def gradient_price(self) -> int:
        """See `Costs`."""
        return max(one.gradient_price for one in self.objectives)

    @property
    def weight(self) -> float:
        """See `Objective`."""
        return float(sum(one.weight for one in self.objectives))

    @property
    def blocks(self) -> IntArray:
        """Blocks of all, each numbered on."""
        found, next_ = [], 0
        for one in self.objectives:
            found.append(one.blocks + next_)
            next_ = int(found[-1].max()) + 1
        return np.concatenate(found)

    def part(self, k: int, vector: FloatArray) -> float:
        """See `Objective`."""
        one, k = self._at(k)
        return one.part(k, vector)

    def part_gradient(self, k: int, vector: FloatArray) -> tuple[float, FloatArray]:
        """See `Objective`."""
        one, k = self._at(k)
        return one.part_gradient(k, vector)

    def residuals(self, k: int, vector: FloatArray) -> FloatArray:
        """See `Objective`."""
        one, k = self._at(k)
        return one.residuals(k, vector)

    def sensitivity(self, k: int, vector: FloatArray) -> FloatArray:
        """See `Objective`."""
        one, k = self._at(k)
        return one.sensitivity(k, vector)

    def _at(self, k: int) -> tuple[Objective, int]:
        for one in self.objectives:
            if k < one.parts:
                return one, k
            k -= one.parts
        raise IndexError(k)


Work = tuple[str, int, FloatArray]
"""What to call (`part`, `part_gradient`, `residuals` or `sensitivity`), of which part, and with
which vector."""


@dataclass(frozen=True)
class Called:
    """Does a piece of work on an objective; goes once to each process."""

    objective: Objective

    def __call__(self, work: Work) -> Any:
        """Return what it gives."""
        what, k, vector = work
        return getattr(self.objective, what)(k, vector)


@dataclass(frozen=True)
class Parallel:
    """Costs of an objective, through something that does pieces of work; see `Costs`."""

    objective: Objective
    do: Callable[[Sequence[Work]], Iterator[Any]]

    @property
    def gradient_price(self) -> int:
        """See `Costs`."""
        return self.objective.gradient_price

    def values(self, vectors: Sequence[FloatArray]) -> list[float]:
        """Costs, all parts of all vectors side by side."""
        parts = self.objective.parts
        work = [('part', k, vector) for vector in vectors for k in range(parts)]
        found = np.fromiter(self.do(work), float, len(work))
        return [float(cost) for cost in found.reshape(len(vectors), parts).sum(axis=1)]

    def gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Cost and derivative, all parts side by side."""
        work = [('part_gradient', k, vector) for k in range(self.objective.parts)]
        costs, slopes = zip(*self.do(work), strict=True)
        return float(np.sum(costs)), np.sum(slopes, axis=0)

    def linearised(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals [m] of all parts, shape (m,), and their derivative, shape (m, n)."""
        parts, n = range(self.objective.parts), len(vector)
        residuals = self.do([('residuals', k, vector) for k in parts])
        slopes = self.do([('sensitivity', k, vector) for k in parts])
        return (
            np.concatenate([np.ravel(one) for one in residuals]),
            np.concatenate([one.reshape(-1, n) for one in slopes]),
        )
