"""How far off the picture is between the vertices, where triangles take the surface's place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cloth_predict.evaluation.beam import TrueSurface
from cloth_predict.evaluation.projection_methods import Shown
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.projection.texture import grid_texture
from cloth_predict.projection.visibility import barycentric
from cloth_predict.surface.topology import grid_triangles
from cloth_predict.types import FloatArray, IntArray

MOST = 60
"""Frames that are looked at, evenly over the recording: each takes as long as ten others."""
EDGE = 2e-3
"""Share of a triangle beyond its edge that counts as its edge: half a pixel of some hundred."""


def between(
    begins: FloatArray,
    shown: Sequence[Shown],
    surface: TrueSurface,
    pinhole: Pinhole,
    scan: Scan,
    shape: tuple[int, int],
) -> FloatArray | None:
    """How far what is shown at each node of the true mesh is from where it belongs [m].

    begins [s], shape (frames,), of frames with what was shown of them; shape: rows and columns of
    the vertices. Gives (methods, some of the frames, nodes), NaN where the beam does not meet a
    node or brings it no picture; of the first field. None where the mesh is that of the vertices.
    """
    if surface.grid is None or min(shape) < 2:
        return None
    mesh = replace(surface, vertices=surface.mesh)
    chosen = np.unique(np.linspace(0, len(begins) - 1, MOST).astype(int))
    errors = [_of_frame(begins[k], shown[k], mesh, pinhole, scan, shape) for k in chosen]
    return np.stack(errors, axis=1)


def _of_frame(
    begin: float,
    shown: Shown,
    mesh: TrueSurface,
    pinhole: Pinhole,
    scan: Scan,
    shape: tuple[int, int],
) -> FloatArray:
    """Errors [m] of a frame, shape (methods, nodes)."""
    lit = mesh.drawn(begin, pinhole, scan, 0)
    assert mesh.grid is not None
    actual = mesh.mesh.at(begin + lit.dt).reshape(len(lit.dt), *mesh.grid, 3)
    pixels, triangles = pinhole.project(lit.position), grid_triangles(*shape)
    texture = grid_texture(*shape)
    errors = []
    for meant, drawn in zip(shown.position[:, 0], shown.pixels[:, 0], strict=True):
        there = texture_at(pixels, drawn, pinhole.depth(meant), triangles, texture)
        error = np.linalg.norm(_at_texture(actual, there) - lit.position, axis=1)
        errors.append(np.where(lit.visible, error, np.nan))
    return np.array(errors)


def texture_at(
    pixels: FloatArray,
    vertices: FloatArray,
    depth: FloatArray,
    triangles: IntArray,
    texture: FloatArray,
) -> FloatArray:
    """Texture drawn at pixels, shape (points, 2), by the nearest triangle; NaN without one.

    vertices: pixels of the vertices, shape (nodes, 2), depth [m] and texture as theirs.
    """
    share = barycentric(vertices[triangles], pixels[:, None])
    inside = np.asarray((share >= -EDGE).all(axis=-1))
    far = np.where(inside, np.einsum('ptk,tk->pt', share, depth[triangles]), np.inf)
    first, point = far.argmin(axis=1), np.arange(len(pixels))
    value = np.einsum('pk,pkc->pc', share[point, first], texture[triangles[first]])
    return np.where(np.isfinite(far[point, first])[:, None], value, np.nan)


def _at_texture(grid: FloatArray, texture: FloatArray) -> FloatArray:
    """Places [m] with a texture, shape (points, 2), each on its own grid, (points, rows, cols, 3).

    Bilinear between the nodes of the grid.
    """
    sides = np.array(grid.shape[1:3]) - 1
    place = np.clip(np.nan_to_num(texture[:, ::-1]), 0, 1) * sides
    low = np.minimum(place.astype(int), sides - 1)
    part, point = place - low, np.arange(len(texture))
    found = np.zeros((len(texture), 3))
    for down in (0, 1):
        for across in (0, 1):
            weight = np.abs(1 - down - part[:, 0]) * np.abs(1 - across - part[:, 1])
            found += weight[:, None] * grid[point, low[:, 0] + down, low[:, 1] + across]
    return np.where(np.isfinite(texture), 1.0, np.nan)[:, :1] * found
