"""Recordings of the filter's own model class with known parameters: a towel that a hand shakes."""

import numpy as np

from cloth_predict.config import build
from cloth_predict.identification.objectives.trajectory import Scenario, simulate
from cloth_predict.simulation.recordings import settled
from cloth_predict.surface.assembly import build_mass_spring, mesh_rest_shape
from cloth_predict.types import MarkerSequence

TRUE = {
    'rows': 5,
    'cols': 4,
    'mass': 0.34,
    'stiffness_structural': 120.0,
    'stiffness_shear': 50.0,
    'stiffness_flexion': 8.0,
    'damping': 0.06,
}
NAMES = (
    'model.stiffness_structural',
    'model.stiffness_shear',
    'model.stiffness_flexion',
    'model.damping',
)
GUESS = {
    'stiffness_structural': 60.0,
    'stiffness_shear': 60.0,
    'stiffness_flexion': 60.0,
    'damping': 0.1,
}
HELD = [0, 1, 2, 3]
ANCHORS = {'nodes': HELD, 'motion': 'swing', 'process_noise': 10.0}


def first_guess(**more):
    """Configuration that knows sizes and mass, and guesses the rest."""
    return build({'model': TRUE | GUESS, 'anchors': ANCHORS, **more}, 'x')


def recording(seed, seconds, noise=3e-4):
    """Markers at 100 Hz: 0.3 s at rest, then the top row goes to and fro by 0.12 m."""
    config = build({'model': TRUE, 'anchors': ANCHORS}, 'x')
    shape = mesh_rest_shape(config.model)
    mesh = build_mass_spring(config, shape)
    rest = settled(mesh, mesh.input(shape[mesh.driven]), shape)
    rng, times = np.random.default_rng(seed), np.arange(round(100 * seconds) + 1) / 100
    rate, phase = rng.uniform(1.0, 3.0, 3), rng.uniform(0, 2 * np.pi, 3)
    grown = np.clip((times - 0.3) / 0.5, 0, 1) ** 2
    sway = np.sin(2 * np.pi * rate * times[:, None] + phase) * [0.12, 0.06, 0.12]
    driven = rest[HELD] + (grown[:, None] * sway)[:, None]
    nothing = np.zeros((len(times), 0, 3))
    scenario = Scenario('x', times, rest, 0 * rest, driven, nothing, np.zeros(0, np.int64))
    states = simulate(mesh, scenario)
    surface = np.empty((len(times), mesh.nodes, 3))
    surface[:, mesh.driven] = driven
    surface[:, mesh.free] = states[:, : mesh.dim_x // 2].reshape(len(times), -1, 3)
    surface += rng.normal(0, noise, surface.shape)
    stamps = np.arange(len(times), dtype=np.int64) * 10_000_000
    labels = tuple(f'towel:{i}' for i in range(mesh.nodes))
    return MarkerSequence(stamps, labels, surface, np.ones(surface.shape[:2], bool))
