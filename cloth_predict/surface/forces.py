"""What is unknown of the forces: which parts there are, how they change, their first spread."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from cloth_predict.config import Config, WindConfig
from cloth_predict.models.air import Air
from cloth_predict.models.disturbed import Disturbed, ForceProcess, Unknown
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.surface.layout import Layout
from cloth_predict.types import FloatArray

PROCESSES = {
    'ornstein_uhlenbeck': ForceProcess.ornstein_uhlenbeck,
    'matern': ForceProcess.matern,
}


def air_around(config: Config, layout: Layout) -> Air | None:
    """Return the air, its drag given for the area of one marker; None where it is left out."""
    if config.wind.kind == 'none':
        return None
    return Air(layout.topology.triangles, layout.share, config.wind.drag)


def disturbed(
    config: Config, mesh: MassSpring, layout: Layout, surface: FloatArray
) -> MassSpring | Disturbed:
    """Add what is unknown of the forces to the states.

    surface [m], shape (markers, 3): the first one, from which gusts take their distances.
    """
    parts = unknown_parts(config, mesh, layout, surface)
    return Disturbed(mesh, *parts) if parts else mesh


def unknown_parts(
    config: Config, mesh: MassSpring, layout: Layout, surface: FloatArray
) -> list[Unknown]:
    """Return the unknown parts of the load: one force per free marker, gusts, a common wind."""
    parts, nodes, markers = [], len(mesh.free), len(layout.free)
    force, wind = config.force, config.wind
    if force.kind != 'none':
        process = PROCESSES[force.kind](force.sigma, force.tau)
        mix = None
        if config.model.refine > 1:  # a marker's force is shared by the nodes around it
            shared = layout.interpolation / config.model.refine**2
            mix = np.kron(shared, np.eye(3)).astype(float)
        parts.append(Unknown(process, slice(0, 3 * nodes), 3 * markers, mix))
    if wind.kind != 'none':
        mix = layout.interpolation @ alike(wind, surface[layout.free])
        gusts = ForceProcess.matern(wind.sigma, wind.tau)
        parts.append(Unknown(gusts, slice(3 * nodes, 4 * nodes), markers, mix))
        common = ForceProcess.matern(wind.common_sigma, wind.common_tau)
        parts.append(Unknown(common, slice(4 * nodes, 4 * nodes + 3), 3))
    return parts


def alike(wind: WindConfig, points: FloatArray) -> FloatArray:
    """Root L of the correlation L L' of gusts at points [m], (m, 3), each of variance one.

    The correlation falls with the distance d as exp(-d^2 / 2 length^2), but for a share that each
    point has for itself.
    """
    near = np.exp(-0.5 * cdist(points, points, 'sqeuclidean') / wind.length**2)
    own = wind.independent
    return np.asarray(np.linalg.cholesky((1.0 - own) * near + own * np.eye(len(points))))


def process_noise(config: Config, mesh: MassSpring, model: MassSpring | Disturbed) -> FloatArray:
    """Spectral densities of the noise on each state, shape (dim_x,).

    Unknown acceleration on the velocities, and what drives the unknown parts of the load.
    """
    size = 3 * len(mesh.free)
    densities = [np.zeros(size), np.full(size, config.filter.process_noise)]
    for part in _unknown(model):
        densities += [np.zeros(part.size - part.count), np.full(part.count, part.process.density)]
    return np.concatenate(densities)


def force_variances(model: MassSpring | Disturbed) -> FloatArray:
    """Variances of the unknown parts and their rates before anything is known of them."""
    variances = [np.repeat(part.process.variance, part.count) for part in _unknown(model)]
    return np.concatenate([np.zeros(0), *variances])


def first_forces(config: Config, model: MassSpring | Disturbed) -> FloatArray:
    """Unknown parts and their rates before anything is known: still air, and `force.initial`."""
    means = [np.zeros(part.size) for part in _unknown(model)]
    if config.force.kind != 'none':  # the first part
        count = _unknown(model)[0].count
        means[0][:count] = np.tile(config.force.initial, count // 3)
    return np.concatenate([np.zeros(0), *means])


def _unknown(model: MassSpring | Disturbed) -> tuple[Unknown, ...]:
    return model.unknown if isinstance(model, Disturbed) else ()
