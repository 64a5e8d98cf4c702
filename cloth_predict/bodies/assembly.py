"""From the configuration and an ellipsoid to a body: its mesh, model, noise and filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cloth_predict.bodies.fine_mesh import FineMesh
from cloth_predict.bodies.global_fit import sizes_of
from cloth_predict.config import BodyConfig, Config
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.filters.blocks import Blocks
from cloth_predict.filters.family import BODY_FILTERS
from cloth_predict.models.accelerated import Accelerated
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric import (
    GLOBAL,
    ROTATION,
    TRANSLATION,
    Superquadric,
)
from cloth_predict.models.superquadric_shape import PARAMETERS, check_parameters
from cloth_predict.types import BoolArray, Filter, FloatArray, IntArray

CANDIDATES = 16
"""Places on the sphere per node, from which those between the markers are chosen."""
FITTED = 0.05
"""Standard deviation of what the points of one frame tell, of lengths by the scale."""


@dataclass(frozen=True)
class Assembly:
    """A body with what follows it.

    model: the body, or with accelerations that last; noise, shape (dim_x,): spectral densities;
    first, shape (dim_x,): standard deviations of a first guess; shown: the nodes that are
    published.
    """

    body: Superquadric
    model: Superquadric | Accelerated
    filter: Filter[Any]
    noise: FloatArray
    first: FloatArray
    shown: FineMesh

    @property
    def still(self) -> FloatArray:
        """Input without a force on any node."""
        return np.zeros(self.model.dim_u)

    def at_rest(self, q: FloatArray) -> FloatArray:
        """State, shape (dim_x,), at coordinates q, shape (dim_q,)."""
        return np.append(q, np.zeros(self.model.dim_x - len(q)))

    def rigid(self, x: FloatArray) -> FloatArray:
        """State, shape (dim_x,), of a body that keeps its shape from now on."""
        x = x.copy()
        x[self.body.dim_q :][GLOBAL.start : self.body.dim_q] = 0.0
        return x


def free_parameters(settings: BodyConfig) -> BoolArray:
    """Which global parameters move, shape (11,). Raises ConfigError for a name that is none."""
    for name in settings.fixed:
        if name not in PARAMETERS:
            raise ConfigError(
                f'body.fixed: {name!r} is no global parameter; they are {", ".join(PARAMETERS)}'
            )
    return ~np.isin(PARAMETERS, settings.fixed)


def initial_parameters(settings: BodyConfig) -> FloatArray | None:
    """The shape to start from, (11,), if it is given. Raises ConfigError for one that is none."""
    if not settings.initial:
        return None
    parameters = np.array(settings.initial)
    try:
        check_parameters(parameters)
    except ConfigError as error:
        raise ConfigError(f'body.initial: {error}') from None
    return parameters


def mesh_of(config: Config, markers: FloatArray) -> ClosedMesh:
    """The configured mesh; markers, shape (m, 3): their directions on the sphere.

    Where markers have nodes, the others are put one by one where they are farthest from all before
    them. Raises FrameError where there are more markers than nodes, ConfigError as `through`.
    """
    nodes = config.body.nodes or config.model.nodes
    if config.body.mesh == 'even':
        return ClosedMesh.even(nodes)
    if len(markers) > nodes:
        raise FrameError(
            f'{len(markers)} markers, but body.mesh markers has a node for each, and there are '
            f'{nodes} nodes'
        )
    chosen = markers / np.linalg.norm(markers, axis=1)[:, None]
    places = ClosedMesh.even(CANDIDATES * nodes).directions
    nearest = (chosen @ places.T).max(axis=0)
    while len(chosen) < nodes:
        farthest = places[nearest.argmin()]
        chosen = np.append(chosen, farthest[None], axis=0)
        nearest = np.maximum(nearest, places @ farthest)
    return ClosedMesh.through(chosen, np.zeros(3), np.eye(3), np.ones(3))


def assemble(config: Config, mesh: ClosedMesh, parameters: FloatArray) -> Assembly:
    """Build the configured body with this reference shape, (11,), and its filter."""
    settings, model = config.body, config.model
    body = Superquadric(
        mesh,
        mass=model.mass,
        reference=parameters,
        w0=settings.w0,
        w1=settings.w1,
        alpha=settings.alpha,
        beta=settings.beta,
        gravity=model.gravity,
        free=free_parameters(settings),
        local=settings.local,
        inertial=settings.inertial,
    )
    pushed = _pushed(settings)
    moving = Accelerated(body, pushed, settings.push_tau) if len(pushed) else body
    blocks = Blocks.of_body(body, settings.coupling, pushed)  # type: ignore[arg-type]
    scale = float(parameters[0])
    noise, first = _noise(config, body, scale, pushed), _first(config, body, scale, pushed)
    fine = mesh if config.nodes_are_markers else ClosedMesh.even(model.nodes)
    shown = FineMesh.of(fine, mesh)
    chosen = BODY_FILTERS[config.filter.kind](config, blocks)
    return Assembly(body, moving, chosen, noise, first, shown)


def _pushed(settings: BodyConfig) -> IntArray:
    """Coordinates with an acceleration that lasts."""
    of_parts = (settings.push_translation, TRANSLATION), (settings.push_rotation, ROTATION)
    return np.concatenate(
        [np.arange(part.start, part.stop if size else part.start) for size, part in of_parts]
    ).astype(np.int64)


def _pushes(settings: BodyConfig, pushed: IntArray) -> FloatArray:
    """Standard deviations of those accelerations."""
    turns = pushed >= ROTATION.start
    return np.where(turns, settings.push_rotation, settings.push_translation)


def _of_parts(
    body: Superquadric, sizes: FloatArray, values: tuple[float, float, float, float]
) -> FloatArray:
    """Values of translation, rotation, shape and displacements as one per coordinate, (dim_q,).

    That of the shape is by the sizes of its parameters, (11,). 0 of what does not move.
    """
    found = np.full(body.dim_q, values[3])
    found[TRANSLATION], found[ROTATION], found[GLOBAL] = values[0], values[1], values[2] * sizes
    return np.where(body.moving, found, 0.0)


def _noise(config: Config, body: Superquadric, scale: float, pushed: IntArray) -> FloatArray:
    settings = config.body
    roots = (
        settings.translation_noise**0.5,
        settings.rotation_noise**0.5,
        settings.global_noise**0.5,
        settings.local_noise**0.5,
    )
    rates = _of_parts(body, sizes_of(scale)[GLOBAL], roots) ** 2
    pushes = 2.0 / settings.push_tau * _pushes(settings, pushed) ** 2
    return np.concatenate([np.zeros(body.dim_q), rates, pushes])


def _first(config: Config, body: Superquadric, scale: float, pushed: IntArray) -> FloatArray:
    """Standard deviations of the state after a fit, shape (dim_x,)."""
    sizes, speed = sizes_of(scale)[GLOBAL], config.filter.initial_velocity
    place = _of_parts(body, sizes, (FITTED * scale, FITTED, FITTED, FITTED * scale))
    rate = _of_parts(body, sizes, (speed, speed / scale, speed / scale, FITTED * speed))
    return np.concatenate([place, rate, _pushes(config.body, pushed)])
