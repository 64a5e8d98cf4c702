"""Two numberings: of the markers, and of the nodes of a mesh that may be finer than their grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.surface import topology
from cloth_predict.surface.topology import Topology
from cloth_predict.types import BoolArray, FloatArray, IntArray, read_only


@dataclass(frozen=True)
class Layout:
    """Where the markers are on the mesh of the model, and which nodes are driven.

    topology: of the mesh.
    markers: the mesh node of each marker, shape (markers,).
    free, driven: the markers that are free, and driven, in order.
    rows: rows of the state with the positions of the free markers, shape (free, 3).
    driven_mesh: the mesh nodes that are driven: driven markers, and what lies between them only.
    between: positions of the mesh nodes by those of the markers, shape (mesh nodes, markers);
    bilinear in each cell.
    drive: positions of the driven mesh nodes by those of the driven markers, shape
    (driven mesh nodes, driven).
    interpolation: values at the free mesh nodes by values at the free markers, shape
    (free mesh nodes, free): bilinear, and constant towards driven markers.
    share: area of each mesh node at rest by that of a cell of markers, shape (mesh nodes,); the
    area of a triangle counts a third at each corner, and two triangles make a cell.

    Rows of each matrix sum to 1. Where every mesh node has a marker they are the identity.
    """

    topology: Topology
    markers: IntArray
    free: IntArray
    driven: IntArray
    rows: IntArray
    driven_mesh: IntArray
    between: FloatArray
    drive: FloatArray
    interpolation: FloatArray
    share: FloatArray

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, read_only(value))

    @property
    def nodes(self) -> int:
        """Number of mesh nodes."""
        return len(self.between)


def free_markers(config: Config) -> BoolArray:
    """Which markers are free, shape (markers,): all but the driven ones."""
    free = np.ones(config.model.count, bool)
    free[list(config.anchors.nodes)] = False
    return free


def lay_out(config: Config, joined: Topology, surface: FloatArray) -> Layout:
    """Lay out the configured mesh; joined: which markers are; surface [m], shape (markers, 3).

    The surface gives the areas of a mesh that is no grid.
    """
    model = config.model
    between: FloatArray = np.eye(model.count)
    markers, mesh, shape = np.arange(model.count), joined, surface
    if model.topology == 'grid':
        between = np.asarray(np.kron(*(_hats(n, model.refine) for n in model.shape)), float)
        rows, cols = model.mesh
        mesh = joined if model.refine == 1 else topology.grid(rows, cols)
        node = np.arange(rows * cols).reshape(rows, cols)
        markers = node[:: model.refine, :: model.refine].ravel()
        shape = np.stack([*np.divmod(node.ravel(), cols), np.zeros(rows * cols)], axis=1)
    is_free = free_markers(config)
    free, driven = np.flatnonzero(is_free), np.flatnonzero(~is_free)
    moved = (between[:, free] > 0).any(axis=1)
    free_mesh, driven_mesh = np.flatnonzero(moved), np.flatnonzero(~moved)
    weight = between[np.ix_(free_mesh, free)]
    number = np.searchsorted(free_mesh, markers[free])
    return Layout(
        topology=mesh,
        markers=markers,
        free=free,
        driven=driven,
        rows=3 * number[:, None] + np.arange(3),
        driven_mesh=driven_mesh,
        between=between,
        drive=between[np.ix_(driven_mesh, driven)],
        interpolation=weight / weight.sum(axis=1, keepdims=True),
        share=_shares(mesh.triangles, shape) / model.refine**2,
    )


def _hats(markers: int, refine: int) -> FloatArray:
    """Linear interpolation along a line of markers, shape ((markers - 1) refine + 1, markers)."""
    place = np.arange((markers - 1) * refine + 1) / refine
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(markers)))


def _shares(triangles: IntArray, shape: FloatArray) -> FloatArray:
    """Area of each node of a shape, (nodes, 3), by that of two triangles; zero without any."""
    if not len(triangles):
        return np.zeros(len(shape))
    a, b, c = np.moveaxis(shape[triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    third = np.repeat(area / 3.0, 3)
    return np.asarray(np.bincount(triangles.ravel(), third, len(shape)) / (2.0 * area.mean()))
