"""What is searched: values of a configuration, on a scale without borders.

A positive value is searched by its logarithm, a share by its logit between its limits; lists have
an entry for each spring or node (Gomes 2016, section 5.2).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeGuard

import numpy as np
from scipy.special import expit, logit

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError
from cloth_predict.identification.provenance import APART
from cloth_predict.surface.assembly import build_mass_spring
from cloth_predict.types import FloatArray

FARTHEST = 1000.0
"""Factor to both sides of the first value beyond which a positive parameter is not searched."""
WITHIN = 1e-3
"""Share of its range by which a value between limits stays away from them."""
LISTS = ('springs', 'dampers', 'masses', 'loads')
"""Parameters of `model` with a value for each spring or node."""
OF_MODEL = (
    'model.stiffness_structural',
    'model.stiffness_shear',
    'model.stiffness_flexion',
    'model.damping',
    'model.prestretch',
    'model.compression',
)
"""What moves a surface, but for its mass: only ratios to it can be told where gravity is all that
acts, or where the force has a scale of its own."""


@dataclass(frozen=True)
class Parameter:
    """One number of a configuration: its group and name, the entry of a list, and its limits."""

    group: str
    field: str
    entry: int | None
    first: float
    low: float
    high: float

    @property
    def name(self) -> str:
        """As in a parameter file, with the entry of a list."""
        whole = f'{self.group}.{self.field}'
        return whole if self.entry is None else f'{whole}[{self.entry}]'

    @property
    def between(self) -> bool:
        """Whether it is a share, searched between its limits by its logit."""
        return self.high <= 1.0


@dataclass(frozen=True)
class Space:
    """Parameters of a configuration, searched as vectors of shape (n,) on a scale without borders.

    Lists that are searched are spelt out in `config`.
    """

    config: Config
    parameters: tuple[Parameter, ...]
    farthest: float = FARTHEST

    @classmethod
    def of(
        cls, config: Config, names: Iterable[str] = OF_MODEL, farthest: float = FARTHEST
    ) -> Space:
        """Search parameters by their names in a file; `model.springs` means each of its entries.

        farthest: factor to both sides of the first value. Entries that are zero stay zero, as of a
        family of springs that is not there. Raises ConfigError for a name that cannot be searched.
        """
        names = list(dict.fromkeys(names))
        config = spelt_out(config, [n.removeprefix('model.') for n in names])
        found = [parameter for name in names for parameter in _parameters(config, name)]
        return cls(config, tuple(found), farthest)

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names, shape (n,)."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def start(self) -> FloatArray:
        """The values of the configuration, moved off their limits."""
        return self.searched([parameter.first for parameter in self.parameters])

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest vector, each of shape (n,)."""
        reach = np.where(self._between, -logit(WITHIN), np.log(self.farthest))
        middle = np.where(self._between, 0.0, self.start)
        most = [np.inf if p.between else np.log(p.high) for p in self.parameters]
        return middle - reach, np.minimum(middle + reach, most)

    def searched(self, values: Sequence[float] | FloatArray) -> FloatArray:
        """Vector of values of the parameters, shape (n,)."""
        share = (np.asarray(values) - self._low) / np.where(self._between, self._width, 1.0)
        inside = np.clip(logit(np.clip(share, 0.0, 1.0)), logit(WITHIN), -logit(WITHIN))
        positive = np.where(self._between, 1.0, values)
        return np.where(self._between, inside, np.log(positive))

    def values(self, vector: FloatArray) -> FloatArray:
        """Values of the parameters, shape (n,), of a vector."""
        between = self._low + self._width * expit(vector)
        return np.where(self._between, between, np.exp(np.minimum(vector, 700.0)))

    def slope(self, vector: FloatArray) -> FloatArray:
        """Derivative of the values by the vector, shape (n,)."""
        share = expit(vector)
        return np.where(self._between, self._width * share * (1.0 - share), self.values(vector))

    def apply(self, vector: FloatArray) -> Config:
        """Return the configuration with the values of a vector."""
        chosen: dict[str, dict[str, Any]] = {}
        for parameter, value in zip(self.parameters, self.values(vector).tolist(), strict=True):
            group = chosen.setdefault(parameter.group, {})
            if parameter.entry is None:
                group[parameter.field] = value
            else:
                given = getattr(getattr(self.config, parameter.group), parameter.field)
                group.setdefault(parameter.field, list(given))[parameter.entry] = value
        config = self.config
        for name, values in chosen.items():
            changed = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
            whole: Any = replace(getattr(config, name), **changed)
            config = replace(config, **{name: whole})
        return config

    @cached_property
    def _between(self) -> FloatArray:
        return np.array([parameter.between for parameter in self.parameters], bool)

    @cached_property
    def _low(self) -> FloatArray:
        return np.array([p.low if p.between else 0.0 for p in self.parameters], float)

    @cached_property
    def _width(self) -> FloatArray:
        return np.array([p.high - p.low if p.between else 1.0 for p in self.parameters], float)


def spelt_out(config: Config, names: Iterable[str] = LISTS) -> Config:
    """Write what all springs or nodes share into those of the lists that are named.

    Raises ConfigError for the springs of a triangulation, of which there is none yet.
    """
    model = config.model
    wanted = [name for name in LISTS if name in set(names) and not getattr(model, name)]
    if model.topology == 'delaunay' and {'springs', 'dampers'} & set(wanted):
        raise ConfigError(
            'model.topology: the springs of delaunay are not known before the start, so that they '
            'cannot be searched one by one'
        )
    nodes = model.mesh_nodes
    each = {'masses': np.full(nodes, model.mass / nodes), 'loads': np.ones(nodes)}
    if {'springs', 'dampers'} & set(wanted):
        mesh = build_mass_spring(config, np.zeros((model.count, 3)))  # wherever the nodes are
        each |= {'springs': mesh.springs.stiffness, 'dampers': mesh.springs.damping}
    for name in wanted:
        values: Any = tuple(each[name].tolist())
        model = replace(model, **{name: values})
    return replace(config, model=model)


def _parameters(config: Config, name: str) -> list[Parameter]:
    """All entries that a name stands for."""
    group, _, field = name.partition('.')
    if group in APART:
        raise ConfigError(f'{name}: has no say in how well the filter does, cannot be searched')
    whole = getattr(config, group, None)
    fields = {f.name: f for f in dataclasses.fields(whole)} if _is_group(whole) else {}
    if field not in fields:
        raise ConfigError(f'{name}: unknown parameter, cannot be searched')
    value, limits = getattr(whole, field), fields[field].metadata
    entries = list(enumerate(value)) if isinstance(value, tuple) else [(None, value)]
    if not entries or not all(isinstance(v, float) for _, v in entries):
        raise ConfigError(f'{name}: is not a number that can be searched')
    low = limits['above'] if limits['low'] is None else limits['low']
    high = np.inf if limits['high'] is None else limits['high']
    if low is None or (low != 0 and high > 1.0):
        raise ConfigError(f'{name}: has no lower limit, so that it cannot be searched')
    found = [Parameter(group, field, i, v, low, high) for i, v in entries if v > 0 or high <= 1]
    if not found:
        raise ConfigError(f'{name}: is 0; a search needs a first value above it')
    return found


def _is_group(value: Any) -> TypeGuard[Any]:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)
