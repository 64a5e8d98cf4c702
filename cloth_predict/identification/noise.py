"""The noise of a configuration as it is searched: which parameters, and how far from the given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import log10, sqrt

from cloth_predict.config import Config, FilterConfig
from cloth_predict.identification.parameters import Space

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

    space: Space
    ranges: dict[str, Range]

    @classmethod
    def of(cls, config: Config, fixed: Iterable[str] = ()) -> Noise:
        """Search Q, R, and sigma and tau of the force and of the wind, if any; but not `fixed`."""
        spans = {PROCESS: (3.0, 1.0), MEASUREMENT: (1.5, 0.5)}
        for group, kind in (('force', config.force.kind), ('wind', config.wind.kind)):
            if kind != 'none':
                spans |= {f'{group}.sigma': (1.5, 0.5), f'{group}.tau': (1.0, 0.5)}
        if not config.filter.process_noise:  # no decades lead away from 0
            some = replace(config.filter, process_noise=FilterConfig.process_noise)
            config = replace(config, filter=some)
        space = Space.of(config, [name for name in spans if name not in fixed])
        each = zip(space.parameters, space.names, strict=True)
        return cls(space, {name: Range(found.first, *spans[name]) for found, name in each})

    @property
    def first(self) -> dict[str, float]:
        """The values of the configuration."""
        return {name: around.centre for name, around in self.ranges.items()}

    def apply(self, values: Mapping[str, float]) -> Config:
        """Return the configuration with these values."""
        return self.space.apply(self.space.searched([values[name] for name in self.ranges]))


def scaled(config: Config, variance: float) -> Config:
    """Return the configuration with all noise scaled: `variance` times every covariance.

    No estimate and no prediction changes by it, only how certain they are.
    """
    c, sigma, f = variance, sqrt(variance), config.filter
    return replace(
        config,
        filter=replace(
            f,
            process_noise=c * f.process_noise,
            measurement_noise=sigma * f.measurement_noise,
            initial_velocity=sigma * f.initial_velocity,
        ),
        force=replace(config.force, sigma=sigma * config.force.sigma),
        wind=replace(
            config.wind,
            sigma=sigma * config.wind.sigma,
            common_sigma=sigma * config.wind.common_sigma,
        ),
        anchors=replace(config.anchors, process_noise=c * config.anchors.process_noise),
    )
