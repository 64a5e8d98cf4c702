"""A checkerboard as a viewer beside the projector sees it on the surface while it moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from scipy.ndimage import map_coordinates

from cloth_predict.evaluation.projection import METHODS, Compensation
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.warp import Warper
from cloth_predict.projection.warp_map import warp_map
from cloth_predict.types import FloatArray, IntArray

mpl.use('Agg')

SHOWN = {'ideal': 'ideal', 'none': 'without compensation', 'full': 'with compensation'}
SQUARES = 6
"""Of the checkerboard across the texture; down there are as many as make them square."""
SHARPNESS = 12.0
"""Slope of an edge between two squares, in squares."""
PARTS = 24
"""Of the side of a triangle, for which the light is looked up one by one."""
MOMENTS = 33
"""Of a frame, at which the surface is known; between them it moves linearly."""
ASIDE = np.radians(40.0)
"""Angle between the projector and the viewer, seen from the surface."""
UNLIT = -1.0


@dataclass(frozen=True)
class Lit:
    """Points of the true surface, each when the beam meets it.

    texture, shape (points, 2): of the picture that ought to be there; pixels, (points, 2), whose
    light it gets; position [m], shape (points, 3); triangles between the points, shape (t, 3).
    """

    texture: FloatArray
    pixels: FloatArray
    position: FloatArray
    triangles: IntArray


def picture(found: Compensation, frame: int, path: Path) -> None:
    """Draw a frame as it ought to look, without compensation, and with it."""
    now = found.known[frame].surface
    assert now is not None
    warper = Warper.of(found.config, now.position)
    lit = lit_points(found, frame, warper.skin.texture)
    seen, depth = _seen(found, lit.position)
    nearest_last = np.argsort(-depth[lit.triangles].mean(axis=1))
    mesh = Triangulation(seen[:, 0], seen[:, 1], lit.triangles[nearest_last])
    squares = squares_of(found)
    figure = Figure(figsize=(12, 6.5), layout='constrained', facecolor='0.85')
    for axes, (name, title) in zip(figure.subplots(1, 3), SHOWN.items(), strict=True):
        if name == 'ideal':
            texture = lit.texture
        else:
            texture = looked_up(framebuffer(found, frame, name, warper), lit.pixels)
        axes.tripcolor(mesh, checkerboard(texture, squares), shading='gouraud', cmap=_colours(),
                       vmin=-1, vmax=1)  # fmt: skip
        _outline(axes, lit, seen, squares)
        axes.set(title=title, aspect='equal')
        axes.axis('off')
    start = 1e-9 * float(found.starts[frame] - found.surface.vertices.start)
    figure.suptitle(f'The frame at {start:.2f} s; red: where the squares of the picture belong')
    figure.savefig(path, dpi=120)


def lit_points(found: Compensation, frame: int, of_vertices: FloatArray) -> Lit:
    """Find when and where the beam meets the true surface in a frame.

    of_vertices: texture of the vertices, shape (nodes, 2).
    """
    surface, scan, pinhole = found.surface, found.scan, found.pinhole
    begin = 1e-9 * float(found.starts[frame] - surface.vertices.start)
    moments = np.linspace(0.0, 1.0 / scan.fps, MOMENTS)
    path = surface.mesh.at(begin + moments)
    share, small = _parts(PARTS)
    count, triangles = len(share), surface.triangles
    corner = np.repeat(triangles, count, axis=0)
    weight = np.tile(share, (len(triangles), 1))[..., None]
    fine = np.arange(len(triangles))[:, None, None] * count + small
    dt = np.zeros(len(corner))
    for _ in range(8):  # far more than the fixed point of a surface slower than the beam needs
        place = dt * scan.fps * (MOMENTS - 1)
        k = np.clip(np.nan_to_num(place).astype(int), 0, MOMENTS - 2)
        part = (place - k)[:, None, None]
        nodes = (1 - part) * path[k[:, None], corner] + part * path[k[:, None] + 1, corner]
        position = (weight * nodes).sum(axis=1)
        pixels = pinhole.project(position)
        dt = scan.times(pixels, 0)
    texture = (weight * _texture_of_mesh(found, of_vertices)[corner]).sum(axis=1)
    return Lit(texture, pixels, position, fine.reshape(-1, 3))


def _texture_of_mesh(found: Compensation, of_vertices: FloatArray) -> FloatArray:
    """Texture of the nodes of the true mesh, shape (nodes, 2), from that of the vertices."""
    if found.surface.grid is None:
        return of_vertices
    rows, cols = found.surface.grid
    corners = of_vertices.reshape(*found.config.model.shape, 2)
    s = np.linspace(corners[0, 0, 0], corners[0, -1, 0], cols)
    t = np.linspace(corners[0, 0, 1], corners[-1, 0, 1], rows)
    return np.stack(np.meshgrid(s, t), axis=-1).reshape(-1, 2)


def framebuffer(found: Compensation, frame: int, method: str, warper: Warper) -> FloatArray:
    """Texture coordinate that a method draws at each pixel, shape (height, width, 2)."""
    known, scan = found.known[frame], warper.scan
    assert known.surface is not None
    if method == 'full':
        motion = Motion.of(found.config.projector.motion, known.surface, known.end)
    else:
        motion = Motion.still(found.shown(frame).position[METHODS.index(method), 0])
    keys = warper.warp(motion).keys[0]
    return warp_map(
        keys.pixels,
        found.pinhole.depth(keys.position),
        keys.lines,
        warper.skin.texture,
        warper.skin.triangles,
        (scan.width, scan.height),
        columns=scan.columns,
    ).astype(float)


def looked_up(image: FloatArray, pixels: FloatArray) -> FloatArray:
    """Value of an image, (height, width, 2), at pixels, shape (points, 2); NaN beside it."""
    where = np.nan_to_num(pixels[:, ::-1], nan=-1e6).T
    channels = [map_coordinates(image[..., k], where, order=1, cval=np.nan) for k in range(2)]
    return np.stack(channels, axis=-1)


def squares_of(found: Compensation) -> tuple[int, int]:
    """Squares of the checkerboard across and down."""
    model = found.config.model
    ratio = model.height / model.width if model.topology == 'grid' else 1.0
    return SQUARES, max(round(SQUARES * ratio), 1)


def checkerboard(texture: FloatArray, squares: tuple[int, int]) -> FloatArray:
    """Brightness from 0 to 1 at texture coordinates, shape (points, 2); UNLIT for NaN."""
    waves = np.clip(SHARPNESS * np.sin(np.pi * np.array(squares) * texture), -1.0, 1.0)
    return np.asarray(np.nan_to_num(0.5 + 0.5 * waves.prod(axis=1), nan=UNLIT))


def _colours() -> mpl.colors.Colormap:
    """Grey from black to white, and a dark blue where no light falls, at -1."""
    stops = [(0.0, '#274060'), (0.499, '#274060'), (0.5, '#202020'), (1.0, 'white')]
    return mpl.colors.LinearSegmentedColormap.from_list('light', stops)


def _outline(axes: Axes, lit: Lit, seen: FloatArray, squares: tuple[int, int]) -> None:
    """Draw the edges of the squares where they belong."""
    mesh = Triangulation(seen[:, 0], seen[:, 1], lit.triangles)
    for k, count in enumerate(squares):
        inner = np.arange(1, count) / count
        axes.tricontour(mesh, lit.texture[:, k], inner, colors='tab:red', linewidths=0.6)


def _parts(sides: int) -> tuple[FloatArray, IntArray]:
    """Points of a divided triangle by the shares of its corners, (points, 3), and triangles."""
    grid = [(i, j) for i in range(sides + 1) for j in range(sides + 1 - i)]
    place = {cell: k for k, cell in enumerate(grid)}
    a, b = np.array(grid, float).T / sides
    found = []
    for i, j in grid:
        if i + j < sides:
            found.append((place[i, j], place[i + 1, j], place[i, j + 1]))
        if i + j < sides - 1:
            found.append((place[i + 1, j], place[i + 1, j + 1], place[i, j + 1]))
    return np.column_stack([1 - a - b, a, b]), np.array(found, np.int64)


def _seen(found: Compensation, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the viewer sees points, shape (points, 2), and how far away."""
    middle = np.nanmean(position, axis=0)
    up = -found.pinhole.rotation[1]
    way = middle - found.pinhole.origin
    aside = np.cross(way, up)
    eye = middle - np.cos(ASIDE) * way - np.sin(ASIDE) * aside / np.linalg.norm(up)
    ahead = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(right, ahead), ahead])
    x, y, depth = ((position - eye) @ frame.T).T
    return np.column_stack([x / depth, y / depth]), depth
