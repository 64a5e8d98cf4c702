"""From the configuration and an ellipsoid to a body: its mesh, model, noise and filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cloth_predict.bodies.fine_mesh import FineMesh
from cloth_predict.bodies.global_fit import sizes_of
from cloth_predict.config import BodyConfig, Config
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.filters.blocks import NONE, Blocks
from cloth_predict.filters.family import BODY_FILTERS
from cloth_predict.models.accelerated import Accelerated
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.disturbed import ForceProcess
from cloth_predict.models.superquadric import (
    GLOBAL,
    ROTATION,
    TRANSLATION,
    Superquadric,
)
from cloth_predict.models.superquadric_shape import PARAMETERS, check_parameters
from cloth_predict.surface.forces import PROCESSES
from cloth_predict.types import BoolArray, Filter, FloatArray

CANDIDATES = 16
"""Places on the sphere per node, from which those between the markers are chosen."""
POSE = np.arange(ROTATION.stop)
"""The coordinates of translation and rotation."""
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
    settings = config.body
    body = Superquadric(
        mesh,
        mass=config.model.mass,
        reference=parameters,
        w0=settings.w0,
        w1=settings.w1,
        alpha=settings.alpha,
        beta=settings.beta,
        gravity=config.model.gravity,
        free=free_parameters(settings),
        local=settings.local,
        inertial=settings.inertial,
    )
    push, density, spread = _push(settings)
    model = body if push is None else Accelerated(body, POSE, push)
    pushed = model.pushed if isinstance(model, Accelerated) else NONE
    blocks = Blocks.of_body(body, settings.coupling, pushed)  # type: ignore[arg-type]
    noise, place, rate = _of_body(config, body, sizes_of(float(parameters[0])))
    fine = mesh if config.nodes_are_markers else ClosedMesh.even(config.model.nodes)
    return Assembly(
        body=body,
        model=model,
        filter=BODY_FILTERS[config.filter.kind](config, blocks),
        noise=np.concatenate([np.zeros(body.dim_q), noise, density]),
        first=np.concatenate([place, rate, spread]),
        shown=FineMesh.of(fine, mesh),
    )


def _of_body(
    config: Config, body: Superquadric, sizes: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of the coordinates the noise on their rates, and what a fit leaves open of both, (dim_q,).

    sizes, shape (18,): of the coordinates that all nodes share.
    """
    settings, scale, speed = config.body, sizes[0], config.filter.initial_velocity

    def each(translation: float, turn: float, shape: float, local: float) -> FloatArray:
        found = np.full(body.dim_q, local)
        found[TRANSLATION], found[ROTATION] = translation, turn
        found[GLOBAL] = shape * sizes[GLOBAL]
        return np.where(body.moving, found, 0.0)

    roots = np.sqrt(
        [
            settings.translation_noise,
            settings.rotation_noise,
            settings.global_noise,
            settings.local_noise,
        ]
    )
    return (
        each(*roots) ** 2,
        each(FITTED * scale, FITTED, FITTED, FITTED * scale),
        each(speed, speed / scale, speed / scale, FITTED * speed),
    )


def _push(settings: BodyConfig) -> tuple[ForceProcess | None, FloatArray, FloatArray]:
    """How accelerations of the pose last, their noise, and their standard deviations."""
    if settings.push == 'none':
        return None, np.zeros(0), np.zeros(0)
    process = PROCESSES[settings.push](1.0, settings.push_tau)
    sigma = np.where(ROTATION.start > POSE, settings.push_translation, settings.push_rotation)
    last = np.arange(len(process.variance)) == len(process.variance) - 1
    density = np.outer(process.density * last, sigma**2).ravel()
    return process, density, np.outer(np.sqrt(process.variance), sigma).ravel()
