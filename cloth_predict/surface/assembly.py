"""From configuration and first frame to a model, its noise and a first belief."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from cloth_predict.config import Config, ModelConfig
from cloth_predict.models import rotation
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import mesh_springs
from cloth_predict.surface import topology
from cloth_predict.surface.forces import air_around, first_forces, force_variances
from cloth_predict.surface.layout import Layout, lay_out
from cloth_predict.surface.topology import Topology, adjacency
from cloth_predict.types import BoolArray, FloatArray, Gaussian, IntArray

LOOSE_END = 1e-3
"""Weight of the bending at a node with one neighbour."""
BETWEEN = 0.01
"""Standard deviation [m] of a node at the start that was put on the line between two markers: the
height of an arc of 0.17 m over its chord where a fold has a radius of 0.36 m."""


def rest_shape(model: ModelConfig) -> FloatArray:
    """Flat grid at rest [m], shape (nodes, 3): rows go down (-y), columns to the right (+x)."""
    return _flat_grid(model, model.rows, model.cols)


def mesh_rest_shape(model: ModelConfig) -> FloatArray:
    """The same of the mesh of the model [m], shape (mesh nodes, 3)."""
    return _flat_grid(model, *model.mesh)


def _flat_grid(model: ModelConfig, rows: int, cols: int) -> FloatArray:
    x = np.linspace(0.0, model.width, cols) if cols > 1 else np.zeros(1)
    y = -np.linspace(0.0, model.height, rows) if rows > 1 else np.zeros(1)
    grid = np.zeros((rows, cols, 3))
    grid[..., 0], grid[..., 1] = x, y[:, None]
    return grid.reshape(-1, 3)


def topology_of(model: ModelConfig, surface: FloatArray) -> Topology:
    """Return which nodes are joined; `surface` [m], shape (nodes, 3), is what is triangulated."""
    if model.topology == 'delaunay':
        return topology.delaunay(surface)
    if model.topology == 'edges':
        return topology.of_edges(model.nodes, np.reshape(model.edges, (-1, 2)))
    return topology.grid(model.rows, model.cols)


def build_mass_spring(
    config: Config,
    surface: FloatArray,
    layout: Layout | None = None,
    rest_length: FloatArray | None = None,
) -> MassSpring:
    """Build the configured model.

    surface [m], shape (markers, 3): what is not given is taken from it; rest_length [m], shape
    (springs,).
    """
    model = config.model
    if layout is None:
        layout = lay_out(config, topology_of(model, surface), surface)
    joined = layout.topology
    if model.rest_length == 'dimensions':
        rest_length = lengths_of(joined.pairs, mesh_rest_shape(model))
    elif rest_length is None:
        rest_length = lengths_of(joined.pairs, surface)
    stiffness = {
        'structural': model.stiffness_structural,
        'shear': model.stiffness_shear,
        'flexion': model.stiffness_flexion,
    }
    compression = dict.fromkeys(stiffness, model.compression)
    if model.compression_flexion >= 0:
        compression['flexion'] = model.compression_flexion
    rest_length = (1.0 - model.prestretch) * rest_length
    springs = mesh_springs(joined.families, rest_length, stiffness, model.damping, compression)
    if model.springs:
        springs = replace(springs, stiffness=np.array(model.springs))
    if model.dampers:
        springs = replace(springs, damping=np.array(model.dampers))
    mass = np.array(model.masses or [model.mass / layout.nodes] * layout.nodes)
    air, factor = air_around(config, layout), np.array(model.loads or 1.0)
    return MassSpring(springs, mass, layout.driven_mesh, model.gravity, air, factor)


def lengths_of(pairs: IntArray, positions: FloatArray) -> FloatArray:
    """Distances [m] of pairs of nodes, shape (..., pairs), of positions [m], (..., nodes, 3)."""
    return np.asarray(
        np.linalg.norm(positions[..., pairs[:, 0], :] - positions[..., pairs[:, 1], :], axis=-1)
    )


def complete(
    model: ModelConfig,
    positions: FloatArray,
    visible: BoolArray,
    joined: Topology | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Fill in the nodes that are not visible.

    On a grid the rest shape is laid onto the visible nodes, and its displacement from them carried
    on to the hidden ones as the mean of their neighbours'. On a mesh, which has no shape of its
    own, the surface is the smoothest through the visible nodes. Returns positions [m], shape
    (nodes, 3), and a standard deviation [m], shape (nodes,): zero where measured, the length of an
    edge where filled in.
    """
    spread = np.zeros(len(positions))
    if visible.all():
        return positions, spread
    joined = topology_of(model, positions) if joined is None else joined
    filled = positions.copy()
    if model.topology == 'grid':
        shape = rest_shape(model)
        laid = aligned(shape, positions, visible)
        carried = _carried_on(joined.edges, positions - laid, visible)
        filled[~visible] = laid[~visible] + carried
        spread[~visible] = lengths_of(joined.edges, shape).min()
    else:
        filled[~visible] = _smoothest(joined.edges, positions, visible)
        spread[~visible] = np.median(lengths_of(joined.edges, filled))
    return filled, spread


def _carried_on(edges: IntArray, values: FloatArray, visible: BoolArray) -> FloatArray:
    """Values of the hidden nodes that are the mean of their neighbours', shape (hidden, 3)."""
    laplacian = sparse.csr_array(sparse.csgraph.laplacian(adjacency(len(values), edges)))
    hidden, seen = np.flatnonzero(~visible), np.flatnonzero(visible)
    right = -(laplacian[hidden][:, seen] @ values[seen])
    return np.asarray(spsolve(sparse.csc_array(laplacian[hidden][:, hidden]), right)).reshape(
        -1, 3
    )


def _smoothest(edges: IntArray, positions: FloatArray, visible: BoolArray) -> FloatArray:
    """Positions [m] of the hidden nodes, (hidden, 3), with the least bending of the surface.

    Bending is the distance of each node from the mean of its neighbours, squared. At the end of a
    chain it hardly counts, so that a straight one goes on straight.
    """
    laplacian = sparse.csgraph.laplacian(adjacency(len(positions), edges))
    neighbours = laplacian.diagonal()
    weight = np.where(neighbours > 1, 1.0, LOOSE_END) / neighbours
    scaled = sparse.csr_array(sparse.diags(weight) @ laplacian)
    free, held = scaled[:, np.flatnonzero(~visible)], scaled[:, np.flatnonzero(visible)]
    right = -(free.T @ (held @ positions[visible]))
    return np.asarray(spsolve(sparse.csc_array(free.T @ free), right)).reshape(-1, 3)


def aligned(shape: FloatArray, positions: FloatArray, visible: BoolArray) -> FloatArray:
    """Lay a shape [m], (nodes, 3), onto the visible positions [m] by a least-squares rigid motion.

    Where they leave a turn open (all on a line), the smallest turn is taken.
    """
    from_, to = shape[visible], positions[visible]
    from_mean, to_mean = from_.mean(axis=0), to.mean(axis=0)
    covariance = (to - to_mean).T @ (from_ - from_mean)
    # far below what any two nodes contribute, so that it decides only what they leave open
    covariance += 1e-6 * (np.linalg.norm(covariance) + 1e-12) * np.eye(3)
    return np.asarray((shape - from_mean) @ rotation.nearest(covariance).T + to_mean)


def on_mesh(
    layout: Layout, surface: FloatArray, spread: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Carry positions [m], (markers, 3), and their spread [m], (markers,), to the mesh nodes."""
    position = layout.between @ surface
    sigma = np.hypot(layout.between @ spread, BETWEEN)
    position[layout.markers], sigma[layout.markers] = surface, spread
    return position, sigma


def first_belief(
    config: Config,
    mesh: MassSpring,
    model: MassSpring | Disturbed,
    surface: FloatArray,
    spread: FloatArray,
) -> Gaussian:
    """Start at rest at `surface` [m], shape (mesh nodes, 3) (Gomes 2016, eq. 6.15).

    spread [m], shape (mesh nodes,): how uncertain a position is beyond the noise of a marker.
    """
    size, settings = 3 * len(mesh.free), config.filter
    variances = [
        np.repeat(settings.measurement_noise + spread[mesh.free], 3) ** 2,
        np.full(size, settings.initial_velocity) ** 2,
    ]
    variance = np.concatenate([*variances, force_variances(model)])
    mean = np.zeros(len(variance))
    mean[:size] = surface[mesh.free].ravel()
    mean[2 * size :] = first_forces(config, model)
    return Gaussian(mean, np.diag(variance))
