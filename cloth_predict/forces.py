"""The forces that the model does not know: which there are, how they change, their first spread."""

from __future__ import annotations

import numpy as np

from cloth_predict.config import Config
from cloth_predict.models.disturbed import Disturbed, ForceProcess
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import FloatArray


def force_process(config: Config) -> ForceProcess | None:
    """Return how the unknown forces change, or None where there are none."""
    kinds = {
        'ornstein_uhlenbeck': ForceProcess.ornstein_uhlenbeck,
        'matern': ForceProcess.matern,
    }
    make = kinds.get(config.force.kind)
    return make(config.force.sigma, config.force.tau) if make else None


def disturbed(config: Config, mesh: MassSpring) -> MassSpring | Disturbed:
    """Add the unknown forces to the states where they are configured."""
    process = force_process(config)
    return mesh if process is None else Disturbed(mesh, process)


def process_noise(config: Config, mesh: MassSpring) -> FloatArray:
    """Spectral densities of the noise on each state, shape (dim_x,).

    Unknown acceleration on the velocities, and what drives the unknown forces.
    """
    size, process = 3 * len(mesh.free), force_process(config)
    densities = [np.zeros(size), np.full(size, config.filter.process_noise)]
    if process is not None:
        densities += [np.zeros(size)] * (len(process.drift) - 1) + [np.full(size, process.density)]
    return np.concatenate(densities)


def force_variances(config: Config, mesh: MassSpring) -> FloatArray:
    """Variances of the forces and their rates before anything is known of them."""
    process, size = force_process(config), 3 * len(mesh.free)
    return np.repeat(process.variance, size) if process else np.zeros(0)
