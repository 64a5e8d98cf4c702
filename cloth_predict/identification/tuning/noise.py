"""The noise of a configuration as it is searched: which parameters, and how far from the given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import log10, sqrt

from cloth_predict.config import Config, FilterConfig

PROCESS, MEASUREMENT = 'filter.process_noise', 'filter.measurement_noise'


@dataclass(frozen=True)
class Range:
    """Values of one parameter around the given one: so many decades to both sides, and steps.

    The steps are those of the grid; of a standard deviation they are half decades, which are
    decades of its variance (Gomes 2016, section 6.3).
    """

    centre: float
    decades: float
    step: float

    @property
    def low(self) -> float:
        """Smallest value."""
        return float(self.centre * 10.0**-self.decades)

    @property
    def high(self) -> float:
        """Largest value."""
        return float(self.centre * 10.0**self.decades)

    @property
    def grid(self) -> tuple[float, ...]:
        """All values of the grid, the smallest first."""
        count = round(self.decades / self.step)
        return tuple(self.centre * 10.0 ** (k * self.step) for k in range(-count, count + 1))

    def at_end(self, value: float) -> str:
        """Tell at which end of the range a value is, if it is within a tenth of a decade."""
        if log10(value / self.low) < 0.1:
            return 'low'
        return 'high' if log10(self.high / value) < 0.1 else ''


@dataclass(frozen=True)
class Noise:
    """What is searched of a configuration, by the names that a parameter file has."""

    config: Config
    ranges: dict[str, Range]

    @classmethod
    def of(cls, config: Config, fixed: Iterable[str] = ()) -> Noise:
        """Search Q, R, and sigma and tau of the force and of the wind, if any; but not `fixed`."""
        q = config.filter.process_noise or FilterConfig.process_noise  # no decades lead from 0
        found = {
            PROCESS: Range(q, 3.0, 1.0),
            MEASUREMENT: Range(config.filter.measurement_noise, 1.5, 0.5),
        }
        for group, unknown in (('force', config.force), ('wind', config.wind)):
            if unknown.kind != 'none':
                found[f'{group}.sigma'] = Range(unknown.sigma, 1.5, 0.5)
                found[f'{group}.tau'] = Range(unknown.tau, 1.0, 0.5)
        return cls(config, {name: one for name, one in found.items() if name not in fixed})

    @property
    def grid_size(self) -> int:
        """Trials of a sweep: the given values, and each parameter's others in turn."""
        return 1 + sum(len(around.grid) - 1 for around in self.ranges.values())

    @property
    def first(self) -> dict[str, float]:
        """The values of the configuration."""
        return {name: around.centre for name, around in self.ranges.items()}

    def apply(self, values: Mapping[str, float]) -> Config:
        """Return the configuration with these values."""
        return _with(self.config, values)


def scaled(config: Config, variance: float) -> Config:
    """Return the configuration with all noise scaled: `variance` times every covariance.

    No estimate and no prediction changes by it, only how certain they are.
    """
    densities = [PROCESS, 'anchors.process_noise']
    sigmas = [MEASUREMENT, 'filter.initial_velocity']
    sigmas += ['force.sigma'] if config.force.kind != 'none' else []
    sigmas += ['wind.sigma', 'wind.common_sigma'] if config.wind.kind != 'none' else []
    factors = dict.fromkeys(densities, variance) | dict.fromkeys(sigmas, sqrt(variance))
    return _with(config, {n: factor * _value(config, n) for n, factor in factors.items()})


def _value(config: Config, name: str) -> float:
    group, field = name.split('.')
    return float(getattr(getattr(config, group), field))


def _with(config: Config, values: Mapping[str, float]) -> Config:
    """Return the configuration with these values, to six digits: no data tell more."""
    for name, value in values.items():
        group, field = name.split('.')
        changed = replace(getattr(config, group), **{field: float(f'{value:.6g}')})
        config = replace(config, **{group: changed})
    return config
