"""Which noise to try next: values over decades, one parameter after the other."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import NamedTuple, Protocol

from cloth_predict.identification.tuning.noise import Range

Values = dict[str, float]


class Best(NamedTuple):
    """The values of the smallest cost so far."""

    values: Values
    cost: float


class Proposals(Protocol):
    """Says what to try; a cost that is NaN is that of no valid result."""

    def ask(self, count: int) -> list[Values]:
        """Return up to `count` sets of values; none where all was tried."""

    def tell(self, costs: Sequence[float]) -> None:
        """Take the costs of what was asked for last, or of its first where it was cut off."""

    @property
    def best(self) -> Best | None:
        """The best so far, if any is valid."""


class Sweep:
    """The search of Gomes 2016, section 6.3: Q over decades with R fixed, then R with the best Q.

    Then the other parameters likewise, each once. The first to be tried are the given values.
    """

    def __init__(self, ranges: dict[str, Range]) -> None:
        self._left = list(ranges.items())
        self._here = {name: around.centre for name, around in ranges.items()}
        self._cost = inf
        self._waiting: list[Values] = [dict(self._here)]
        self._asked: list[Values] = []

    @property
    def best(self) -> Best | None:
        """The best so far, if any is valid."""
        return Best(dict(self._here), self._cost) if isfinite(self._cost) else None

    def ask(self, count: int) -> list[Values]:
        """Return some more values of the parameter whose turn it is."""
        while not self._waiting and self._left:
            name, around = self._left.pop(0)
            others = [value for value in around.grid if value != around.centre]
            self._waiting = [{**self._here, name: value} for value in others]
        self._asked, self._waiting = self._waiting[:count], self._waiting[count:]
        return self._asked

    def tell(self, costs: Sequence[float]) -> None:
        """Keep the best."""
        for values, cost in zip(self._asked, costs, strict=False):
            if cost < self._cost:  # not of NaN
                self._here, self._cost = values, cost
