"""Which vertices the light of the projector reaches."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from cloth_predict.types import BoolArray, FloatArray, IntArray

NEARER = 1e-4
"""Share of its distance by which a surface must lie before a vertex to hide it."""


class Flag(IntFlag):
    """What keeps a vertex from being lit as it should."""

    BEHIND = 1
    """It is behind the projector: it has no pixel."""
    OUTSIDE = 2
    """It is not within the frame."""
    BACK_FACING = 4
    """The surface round it shows its other side."""
    OCCLUDED = 8
    """The surface itself is in the way."""
    UNCONVERGED = 16
    """The beam does not meet it in this frame."""


def orientation(pixels: FloatArray, triangles: IntArray) -> FloatArray:
    """Twice the signed area of triangles, shape (t,), of points in a plane, shape (nodes, 2)."""
    a, b, c = np.moveaxis(pixels[triangles], 1, 0)
    return _cross(b - a, c - a)


def back_facing(pixels: FloatArray, triangles: IntArray, front: FloatArray) -> BoolArray:
    """Which vertices show their back, shape (nodes,).

    pixels, shape (nodes, 2); triangles (t, 3); front: which way a triangle turns where it shows
    its front, shape (t,), of which the sign counts. That of most of the area round a vertex
    counts; one without a triangle is never back-facing.
    """
    area = orientation(pixels, triangles) * np.sign(front)
    weight = np.repeat(np.nan_to_num(area), 3)
    return np.bincount(triangles.ravel(), weight, len(pixels)) < 0


def occluded(pixels: FloatArray, depth: FloatArray, triangles: IntArray) -> BoolArray:
    """Which vertices lie behind a triangle of which they are no corner, shape (nodes,).

    pixels, shape (nodes, 2); depth [m], shape (nodes,), along the projector's axis. Triangles that
    reach behind the projector hide nothing.
    """
    hidden = np.zeros(len(pixels), bool)
    if not len(triangles):
        return hidden
    corners = pixels[triangles]
    triangle, vertex = _near(pixels, corners.min(axis=1), corners.max(axis=1))
    own = (triangles[triangle] == vertex[:, None]).any(axis=1)
    before = depth[triangles].min(axis=1)[triangle] < depth[vertex]
    triangle, vertex = triangle[before & ~own], vertex[before & ~own]
    weight = barycentric(corners[triangle], pixels[vertex])
    # 1 / depth is linear over a triangle's picture
    before = 1.0 / (weight / depth[triangles[triangle]]).sum(axis=1)
    hides = (weight > 0).all(axis=1) & (before < (1 - NEARER) * depth[vertex])
    hidden[vertex[hides]] = True
    return hidden


def _near(pixels: FloatArray, low: FloatArray, high: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of box and point, each of shape (k,), where the point is inside the box.

    pixels, shape (points, 2); low and high, shape (boxes, 2). Points are sorted across, so that
    few are looked at: all pairs of a large mesh would take most of the time of a frame.
    """
    order = np.argsort(pixels[:, 0])
    across = pixels[order, 0]
    first = np.searchsorted(across, low[:, 0], 'right')
    count = np.maximum(np.searchsorted(across, high[:, 0], 'left') - first, 0)
    box = np.repeat(np.arange(len(low)), count)
    place = np.arange(len(box)) + np.repeat(first - (np.cumsum(count) - count), count)
    point, v = order[place], pixels[order[place], 1]
    inside = (v > low[box, 1]) & (v < high[box, 1])
    return box[inside], point[inside]


def barycentric(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Weights of the corners, shape (..., 3, 2), that give the points, shape (..., 2); (..., 3).

    Not finite where the corners lie on a line.
    """
    a, b, c = np.moveaxis(corners - points[..., None, :], -2, 0)
    weight = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=-1)
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
