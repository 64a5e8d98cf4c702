"""The kinematic filters at their best: the noise that serves them best on the recording itself."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan
from typing import NamedTuple

import numpy as np

from cloth_predict.cases import Case
from cloth_predict.config import Config
from cloth_predict.judging import Run, follow, judge
from cloth_predict.metrics import rms
from cloth_predict.predictors import Kinematic

DECADES = np.arange(-3.0, 3.5, 0.5)
"""Spectral densities tried first, in powers of ten of the configured one."""
FARTHEST = 9.0
"""Powers of ten beyond which the search goes no farther."""
REFINED = (0.25, 0.125)
"""Steps, in powers of ten, around the best so far: half of the last is an error below 0.1 %."""


class Choice(NamedTuple):
    """The best noise for a horizon: spectral density, and what the filter then said."""

    noise: float
    run: Run


class _Search:
    """Tries spectral densities of one kind of filter; keeps the best for each horizon."""

    def __init__(self, case: Case, config: Config, horizons: Sequence[float], motion: str) -> None:
        self._case, self._config, self._horizons, self._motion = case, config, horizons, motion
        noise = config.baseline
        self._usual = noise.cv_noise if motion == 'constant_velocity' else noise.ca_noise
        self._tried: set[float] = set()
        self._least = [inf] * len(horizons)
        self.at = [nan] * len(horizons)
        self.runs: list[Run | None] = [None] * len(horizons)

    def density(self, decades: float) -> float:
        """Spectral density, this many powers of ten above the configured one."""
        return float(self._usual * 10.0**decades)

    def try_all(self, decades: Sequence[float]) -> None:
        """Let a filter of each of these powers of ten follow the recording."""
        for power in sorted(set(decades) - self._tried):
            self._tried.add(power)
            filter_ = Kinematic(self._config, self._motion, self.density(power))
            for i, run in enumerate(follow(filter_, self._case, self._horizons)):
                error = self._error(run, self._horizons[i])
                if self.runs[i] is None or error < self._least[i]:
                    self._least[i], self.at[i], self.runs[i] = error, power, run

    def beyond(self) -> list[float]:
        """Powers of ten beyond those tried, where the best so far is the last of them."""
        low, high = min(self._tried), max(self._tried)
        more = [low - 0.5] * (low in self.at) + [high + 0.5] * (high in self.at)
        return [power for power in more if abs(power) <= FARTHEST]

    def _error(self, run: Run, horizon: float) -> float:
        """RMS error [m] of the free nodes, which is what the methods are compared by."""
        case, driven = self._case, list(self._config.anchors.nodes)
        stamps = case.markers.stamps[case.ahead]
        judged = judge(stamps, horizon, case.reference, {'it': run}, case.name)
        return rms(np.delete(judged.answers['it'].errors, driven, axis=1))


def best_noise(case: Case, config: Config, horizons: Sequence[float]) -> dict[str, list[Choice]]:
    """Find the spectral density of the least error of each kinematic filter at each horizon [s].

    It is found on the recording on which the methods are then compared, in favour of these two.
    """
    found = {}
    for name, motion in (('kf_cv', 'constant_velocity'), ('kf_ca', 'constant_acceleration')):
        search = _Search(case, config, horizons, motion)
        search.try_all(DECADES.tolist())
        while more := search.beyond():
            search.try_all(more)
        for step in REFINED:
            search.try_all([at + side * step for at in search.at for side in (-1, 1)])
        found[name] = [
            Choice(search.density(at), run)
            for at, run in zip(search.at, search.runs, strict=True)
            if run is not None
        ]
    return found
