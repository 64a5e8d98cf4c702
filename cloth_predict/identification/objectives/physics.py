"""From parameters of a configuration to those of each spring and node, and derivatives back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError
from cloth_predict.identification.objectives.parameters import Parameter, Space
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.surface.topology import Topology
from cloth_predict.types import BoolArray, FloatArray

LISTED = {'springs': 'stiffness', 'dampers': 'damping', 'masses': 'mass', 'loads': 'load'}
"""Kind of each list of `model`."""
SHARED = {
    'stiffness_structural': 'stiffness',
    'stiffness_shear': 'stiffness',
    'stiffness_flexion': 'stiffness',
    'damping': 'damping',
    'prestretch': 'rest_length',
    'compression': 'compression',
    'compression_flexion': 'compression',
    'mass': 'mass',
}
"""Kind of each shared parameter of `model`."""


@dataclass(frozen=True)
class Directions:
    """How the springs and nodes of a model change with each parameter of a space.

    Each parameter is of one kind, and moves the values of that kind along a direction.
    """

    kinds: tuple[str, ...]
    along: tuple[FloatArray, ...]

    @classmethod
    def of(cls, space: Space, config: Config, mesh: MassSpring, joined: Topology) -> Directions:
        """Directions at a configuration, whose model is `mesh`.

        Raises ConfigError for a parameter that has no derivative.
        """
        family = np.repeat(
            np.array(list(joined.families)), [len(pairs) for pairs in joined.families.values()]
        )
        kinds, along = [], []
        for parameter in space.parameters:
            kind = (SHARED | LISTED).get(parameter.field) if parameter.group == 'model' else None
            if kind is None:
                raise ConfigError(
                    f'{parameter.name}: has no gradient; use the optimiser cma or annealing'
                )
            kinds.append(kind)
            along.append(_direction(parameter, kind, config, mesh, family))
        return cls(tuple(kinds), tuple(along))

    def collect(self, slopes: Mapping[str, FloatArray]) -> FloatArray:
        """Derivative by the parameters, shape (n,), from that by springs and nodes, by kind."""
        pairs = zip(self.kinds, self.along, strict=True)
        return np.array([slopes[kind] @ direction for kind, direction in pairs])


def gravity_factors(config: Config, mesh: MassSpring) -> FloatArray:
    """Factor of gravity at each node of the model, shape (nodes,)."""
    return np.array(config.model.loads) if config.model.loads else np.ones(mesh.nodes)


def _direction(
    parameter: Parameter, kind: str, config: Config, mesh: MassSpring, family: NDArray[np.str_]
) -> FloatArray:
    model, name = config.model, parameter.field
    if parameter.entry is not None:
        unit = np.zeros(mesh.nodes if kind in ('mass', 'load') else len(family))
        unit[parameter.entry] = 1.0
        return unit
    if name in ('mass', 'damping', 'prestretch'):
        if (name == 'mass' and model.masses) or (name == 'damping' and model.dampers):
            return np.zeros(mesh.nodes if name == 'mass' else len(family))
        return {
            'mass': np.full(mesh.nodes, 1.0 / mesh.nodes),
            'damping': np.where(_damped(config, family), 1.0, 0.0),
            'prestretch': -mesh.springs.rest_length / (1.0 - model.prestretch),
        }[name]
    if name.startswith('stiffness_'):
        own = family == name.removeprefix('stiffness_')
        return np.where(own & (not model.springs), 1.0, 0.0)
    apart = model.compression_flexion >= 0
    own = (family == 'flexion') == (name == 'compression_flexion')
    return np.where(own if apart else name == 'compression', 1.0, 0.0) * np.ones(len(family))


def _damped(config: Config, family: NDArray[np.str_]) -> BoolArray:
    """Which springs have a damper, as `mesh_springs` decides it."""
    there = [name for name in set(family) if getattr(config.model, f'stiffness_{name}') > 0]
    return np.asarray(np.isin(family, [*there, 'structural']))
