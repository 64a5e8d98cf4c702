"""How far points are from a surface of triangles, exactly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cloth_predict.types import FloatArray, IntArray


class Nearest(NamedTuple):
    """What of a surface is nearest to points.

    place [m], shape (points, 3); triangle, shape (points,); weight of its corners, (points, 3).
    """

    place: FloatArray
    triangle: IntArray
    weight: FloatArray


def nearest_on_surface(points: FloatArray, nodes: FloatArray, triangles: IntArray) -> Nearest:
    """Return the nearest places of triangles to points, both [m], shape (points, 3), (nodes, 3).

    A triangle cannot be nearer than a node is if its middle is farther than that and its own size;
    those are left out, so that the result is that of all pairs. Every triangle counts, and a node
    of no triangle does not.
    """
    corners = nodes[triangles]
    middle = corners.mean(axis=1)
    size = float(np.linalg.norm(corners - middle[:, None], axis=2).max())
    reach = cKDTree(corners.reshape(-1, 3)).query(points)[0] + size
    # rounding must not leave out the triangle of the nearest node itself
    found = cKDTree(middle).query_ball_point(points, reach * (1 + 1e-9))
    count = np.array([len(one) for one in found])
    point, triangle = np.repeat(np.arange(len(points)), count), np.concatenate(found).astype(int)
    weight = closest_weights(points[point], corners[triangle])
    place = np.einsum('pk,pki->pi', weight, corners[triangle])
    far = np.linalg.norm(points[point] - place, axis=1)
    order = np.lexsort((far, point))
    first = order[np.cumsum(count) - count]
    return Nearest(place[first], triangle[first], weight[first])


def closest_weights(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Weights of the corners, (k, 3, 3), that give the place nearest to points; (k, 3).

    That is the foot of the point on the triangle's plane, where it is inside; or else the nearest
    place of an edge. A triangle without an area has its edges only.
    """
    a = corners[:, 0]
    ab, ac, to = corners[:, 1] - a, corners[:, 2] - a, points - a
    bb, bc, cc = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    b, c = _dot(ab, to), _dot(ac, to)
    with np.errstate(divide='ignore', invalid='ignore'):
        second = (cc * b - bc * c) / (bb * cc - bc**2)
        third = (bb * c - bc * b) / (bb * cc - bc**2)
    foot = np.stack([1 - second - third, second, third], axis=1)
    choices = np.stack([foot, *(_on_edge(points, corners, k) for k in range(3))], axis=1)
    off = np.einsum('pck,pki->pci', choices, corners) - points[:, None]
    far = np.square(off).sum(axis=2)
    far[:, 0] = np.where((foot >= 0).all(axis=1), far[:, 0], np.inf)
    return np.asarray(choices[np.arange(len(points)), far.argmin(axis=1)])


def _on_edge(points: FloatArray, corners: FloatArray, first: int) -> FloatArray:
    """Weights of the place nearest to points on the edge from one corner to the next, (k, 3)."""
    second = (first + 1) % 3
    start = corners[:, first]
    along = corners[:, second] - start
    length = _dot(along, along)
    share = _dot(along, points - start) / np.where(length > 0, length, 1.0)
    found = np.zeros((len(points), 3))
    found[:, second] = np.clip(share, 0.0, 1.0)
    found[:, first] = 1.0 - found[:, second]
    return found


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum('pi,pi->p', a, b))
