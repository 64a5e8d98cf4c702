"""Triangles that move while they are drawn, cut with the lines of a scan.

A line is one number y, and u goes along it: for a scan of rows they are the pixel (u, v), for one
of columns (v, u). What is linear on a triangle, divided by its depth, is linear along a line
(Heckbert and Moreton 1991, "Interpolation for polygon texture mapping and shading"), so that a
triangle is known on a line by its two crossings with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cloth_predict.projection.visibility import orientation
from cloth_predict.types import BoolArray, FloatArray, IntArray

DEPTHS = (1e-6, 1e6)
"""Least and greatest depth [m] of a vertex that the projector sees."""
FARTHEST = 1e8
"""Pixels; doubles do not hold the crossings of an edge to a vertex much farther out."""
ROUNDING = 1e-6
"""Pixels; more than the interpolation of a vertex between key lines errs by."""


@dataclass(frozen=True)
class Vertices:
    """Every vertex on each of m lines, as it is when that line is lit.

    u: place along the line [px]; beyond: how far it lies beyond the line [px]; near: 1 / depth
    [1/m]; each of shape (m, nodes), and NaN where the projector does not see it.
    low, high: its least and greatest y while the field is drawn [px], shape (nodes,).
    """

    u: FloatArray
    beyond: FloatArray
    near: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Spans:
    """The k pieces of lines that are covered by one triangle each.

    line: index among the m lines; first: pixel along the line; count: pixels; origin: which of
    them, the first or the last, is the farthest from the projector; shape (k,).
    values, shape (6, k), with the rows bend, s0, s1, t0, t1, near: i pixels from the origin,
    s = s0 + s1 q and t = t0 + t1 q with q = i / (1 + bend i), and 1 / depth = near (1 + bend i),
    where bend >= 0. s0 and t0 are NaN where a back is lit.
    """

    line: IntArray
    first: IntArray
    count: IntArray
    origin: IntArray
    values: NDArray[np.float32]

    def __getitem__(self, which: IntArray | slice) -> Spans:
        line, first, count = self.line[which], self.first[which], self.count[which]
        return Spans(line, first, count, self.origin[which], self.values[:, which])


def on_lines(pixels: FloatArray, depth: FloatArray, keys: IntArray, y: IntArray) -> Vertices:
    """Vertices on the lines y, shape (m,): linear between key lines, held outside of them.

    pixels (u, y) [px], shape (k, nodes, 2); depth [m], shape (k, nodes); keys: lines, shape (k,).
    """
    lower = np.clip(np.searchsorted(keys, y, side='right') - 1, 0, max(len(keys) - 2, 0))
    upper = np.minimum(lower + 1, len(keys) - 1)
    gap = np.maximum(keys[upper] - keys[lower], 1)
    share = np.clip((y - keys[lower]) / gap, 0.0, 1.0)[:, None]
    seen = (np.abs(pixels) < FARTHEST).all(axis=-1) & (depth > DEPTHS[0]) & (depth < DEPTHS[1])
    u, v, z = (np.where(seen, a, np.nan) for a in (pixels[..., 0], pixels[..., 1], depth))

    def between(a: FloatArray) -> FloatArray:
        found: FloatArray = a[upper] - a[lower]
        found *= share
        found += a[lower]
        return found

    beyond, near = between(v), between(z)
    beyond -= y[:, None]
    np.divide(1.0, near, out=near)
    return Vertices(between(u), beyond, near, np.fmin.reduce(v), np.fmax.reduce(v))


def cut(
    vertices: Vertices,
    texture: FloatArray,
    triangles: IntArray,
    y: IntArray,
    length: int,
    mirrored: bool,
    front: FloatArray | None = None,
) -> Spans:
    """Cut every triangle with every line y; ordered by line, and by pixel along it.

    A pixel on the first edge of a triangle belongs to it, one on the last edge does not, along the
    lines and across: triangles with a common edge share no pixel and leave none out. A triangle
    shows its back where it turns the other way than `front` says, shape (t,), of which the sign
    counts; without it, than in the texture, shape (nodes, 2).
    length: pixels of a line; mirrored: (u, y) is (v, u).
    """
    triangle, line = _pairs(vertices, triangles, y)
    corners = triangles[triangle]
    beyond = vertices.beyond.ravel()[corners + (line * len(texture))[:, None]]
    met, turned = _corner_apart(beyond)
    triangle, line = triangle[met], line[met]
    corners = np.take_along_axis(corners[met], turned, axis=1)
    beyond = np.take_along_axis(beyond[met], turned, axis=1)

    at = corners + (line * len(texture))[:, None]
    u, near = vertices.u.ravel()[at], vertices.near.ravel()[at]
    values = np.stack([u, near, texture[corners, 0] * near, texture[corners, 1] * near])
    one, two = (_crossing(values[..., [0, i]], beyond[:, [0, i]]) for i in (1, 2))
    turn = np.where(beyond[:, 0] > 0, two[0] - one[0], one[0] - two[0])
    turn *= (orientation(texture, triangles) if front is None else front)[triangle]
    return _spans(line, one, two, turn > 0 if mirrored else turn < 0, length)


def _pairs(vertices: Vertices, triangles: IntArray, y: IntArray) -> tuple[IntArray, IntArray]:
    """Triangles and the lines that they may meet."""
    low = vertices.low[triangles].min(axis=1, initial=np.inf)
    high = vertices.high[triangles].max(axis=1, initial=-np.inf)
    begin = np.searchsorted(y, low - ROUNDING)
    count = np.maximum(np.searchsorted(y, high + ROUNDING, side='right') - begin, 0)
    count[np.isnan(low)] = 0
    line = np.arange(count.sum()) + np.repeat(begin - (np.cumsum(count) - count), count)
    return np.repeat(np.arange(len(triangles)), count), line


def _corner_apart(beyond: FloatArray) -> tuple[BoolArray, IntArray]:
    """Which of k triangles meet their line, and, for those, the corners turned.

    beyond, shape (k, 3). The first of the turned corners, shape (met, 3), is the one that is alone
    on its side of the line.
    """
    after = beyond > 0
    alone = after ^ (after.sum(axis=1) > 1)[:, None]
    met = alone.any(axis=1) & ~np.isnan(beyond.sum(axis=1))
    return met, (alone[met].argmax(axis=1)[:, None] + np.arange(3)) % 3


def _crossing(values: FloatArray, beyond: FloatArray) -> FloatArray:
    """Values where edges cross their lines, shape (4, k).

    values at both ends, shape (4, k, 2); beyond, shape (k, 2). Exchanged ends give the same bits:
    the two triangles of an edge agree on it.
    """
    share = beyond[:, ::-1] / (beyond[:, ::-1] - beyond)
    found = values[..., 0] * share[:, 0] + values[..., 1] * share[:, 1]
    # An edge at one u crosses there, not by a rounding beside it.
    np.clip(found[0], values[0].min(axis=1), values[0].max(axis=1), out=found[0])
    return np.asarray(found)


def _spans(
    line: IntArray, one: FloatArray, two: FloatArray, back: BoolArray, length: int
) -> Spans:
    """Spans from crossings of the lines: u, 1 / depth, s / depth, t / depth, shape (4, k)."""
    first = np.ceil(np.clip(np.minimum(one[0], two[0]), 0, length)).astype(np.int64)
    count = np.ceil(np.clip(np.maximum(one[0], two[0]), 0, length)).astype(np.int64) - first
    order = np.flatnonzero(count)
    order = order[np.argsort(line[order] * (length + 1) + first[order], kind='stable')]
    first, count, one, two = first[order], count[order], one[:, order], two[:, order]

    across = two - one
    farther_first = (across[0] > 0) == (across[1] > 0)
    origin = np.where(farther_first, 0, count - 1)
    near, s, t = one[1:] + across[1:] * ((first + origin - one[0]) / across[0])
    # A span of one pixel needs no slope, and may be too short to have one.
    step = np.where(farther_first, 1.0, -1.0)
    slope = across[1:] * np.divide(step, across[0], out=np.zeros(len(step)), where=count > 1)
    s0, t0 = s / near, t / near
    bend = slope[0] / near
    s1, t1 = slope[1] / near - s0 * bend, slope[2] / near - t0 * bend
    s0[back[order]] = t0[back[order]] = np.nan
    values = np.stack([bend, s0, s1, t0, t1, near]).astype(np.float32)
    return Spans(line[order], first, count, origin, values)
