"""The kinematic filters at their best: the noise that serves them best on the recording itself."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from cloth_predict.config import Config
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.judging import asked_at
from cloth_predict.evaluation.predictors import Kinematic
from cloth_predict.evaluation.runs import Run, follow
from cloth_predict.surface.layout import free_markers
from cloth_predict.types import FloatArray

DECADES = np.arange(-3.0, 3.5, 0.5)
"""Spectral densities tried first, in powers of ten of the configured one."""
FARTHEST = 9.0
"""Powers of ten beyond which the search goes no farther."""
REFINED = (0.25, 0.125)
"""Steps, in powers of ten, to both sides of the best so far."""
ALIKE = 1e-4
"""Share by which a larger error counts as the same: where more noise changes nothing any more, as
of a filter that only takes differences, that nearest to the configured one is chosen."""


class Choice(NamedTuple):
    """The best noise for a horizon: spectral density, and what the filter then said."""

    noise: float
    run: Run


def best_noise(case: Case, config: Config, horizons: Sequence[float]) -> dict[str, list[Choice]]:
    """Find the spectral density of the least error of each kinematic filter at each horizon [s].

    It is found on the recording on which the methods are then compared, in favour of these two;
    the error is that of the free nodes, by which they are compared.
    """
    found = {}
    for name, motion, usual in (
        ('kf_cv', 'constant_velocity', config.baseline.cv_noise),
        ('kf_ca', 'constant_acceleration', config.baseline.ca_noise),
    ):
        search = _Search(case, config, horizons, motion, usual)
        search.run()
        runs = {
            at: follow(Kinematic(config, motion, search.density(at)), case, horizons)
            for at in set(search.at)
        }
        found[name] = [Choice(search.density(at), runs[at][i]) for i, at in enumerate(search.at)]
    return found


class _Search:
    """Tries spectral densities of one kind of filter; `at` is the best of each horizon."""

    def __init__(
        self, case: Case, config: Config, horizons: Sequence[float], motion: str, usual: float
    ) -> None:
        self._case, self._config, self._horizons, self._motion = case, config, horizons, motion
        self._usual = usual
        self._tried: dict[float, FloatArray] = {}
        self.at = [0.0] * len(horizons)
        stamps = case.markers.stamps[case.ahead]
        self._asked = [asked_at(stamps, horizon, case.reference) for horizon in horizons]

    def density(self, decades: float) -> float:
        """Spectral density, this many powers of ten above the configured one."""
        return float(self._usual * 10.0**decades)

    def run(self) -> None:
        """Try the usual ones, others while the best is the last of them, and some between."""
        self._try(DECADES.tolist())
        while beyond := self._beyond():
            self._try(beyond)
        for step in REFINED:
            self._try([at + side * step for at in self.at for side in (-1, 1)])

    def _beyond(self) -> list[float]:
        low, high = min(self._tried), max(self._tried)
        more = [low - 0.5] * (low in self.at) + [high + 0.5] * (high in self.at)
        return [power for power in more if abs(power) <= FARTHEST]

    def _try(self, decades: Sequence[float]) -> None:
        chosen = sorted(set(decades) - set(self._tried))
        if not chosen:
            return
        errors = self._errors(np.array([self.density(power) for power in chosen]))
        self._tried |= dict(zip(chosen, errors.T, strict=True))
        nearest = sorted(self._tried, key=abs)
        every = np.array([self._tried[power] for power in nearest])
        good = every <= (1 + ALIKE) ** 2 * every.min(axis=0)
        self.at = [nearest[k] for k in good.argmax(axis=0)]

    def _errors(self, densities: FloatArray) -> FloatArray:
        """Mean squares of the errors [m^2] of the free nodes, shape (horizons, densities)."""
        case, markers = self._case, self._case.markers
        filters = Kinematic(self._config, self._motion, densities)
        free = free_markers(self._config)
        total = np.zeros((len(self._horizons), len(densities)))
        count = np.zeros(len(self._horizons))
        rows = {int(k): row for row, k in enumerate(np.flatnonzero(case.ahead))}
        for k, stamp in enumerate(markers.stamps.tolist()):
            filters.step(stamp, *case.frame(k, associates=False))
            for i, (actual, asked) in enumerate(self._asked):
                if (row := rows.get(k)) is not None and asked[row].any():
                    found = filters.predict(self._horizons[i]).position
                    off = found.reshape(len(densities), -1, 3) - actual[row]
                    counted = asked[row] & np.isfinite(off[0, :, 0]) & free
                    total[i] += np.square(off[:, counted]).sum(axis=(1, 2))
                    count[i] += counted.sum()
        return np.divide(total, count[:, None], out=total * nan, where=count[:, None] > 0)
