"""Which point of an unordered cloud is which node of a chain, without a prediction: the start."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from cloth_predict.errors import FrameError
from cloth_predict.types import FloatArray, IntArray

LONGEST_GAP = 3.0
"""Longest distance of neighbours in a chain, by the median of these distances."""


def find_chain(points: FloatArray, shape: FloatArray) -> IntArray:
    """Nodes of the points of a chain, shape (m,), in one of its two directions.

    The chain is the shortest path; what makes the longest detours beyond the number of nodes are
    ghosts. Where points are missing, the others are found by their distance along the chain.
    """
    nodes = len(shape)
    path = _shortest_path(cdist(points, points))
    while len(path) > nodes:
        path = np.delete(path, _detours(points[path]).argmax())
    gaps = np.linalg.norm(np.diff(points[path], axis=0), axis=1)
    rest = np.linalg.norm(np.diff(shape, axis=0), axis=1)
    along = np.arange(nodes)
    if len(path) < nodes:
        if abs(gaps.sum() - rest.sum()) > np.median(rest) / 2:
            raise FrameError(
                f'{len(path)} points make a chain of {gaps.sum():.3g} m, but one of {nodes} nodes '
                f'has {rest.sum():.3g} m'
            )
        arc, rest_arc = (np.append(0.0, np.cumsum(g)) / g.sum() for g in (gaps, rest))
        along = linear_sum_assignment(np.square(arc[:, None] - rest_arc))[1]
    elif not gaps.max() < LONGEST_GAP * np.median(gaps):
        raise FrameError(
            f'{len(points)} points do not make a chain of {nodes} nodes: a gap of '
            f'{gaps.max():.3g} m where {np.median(gaps):.3g} m are usual'
        )
    node = np.full(len(points), -1)
    node[path] = along
    return node


def _detours(path: FloatArray) -> FloatArray:
    """Length [m], shape (m,), by which a path, (m, 3), is shorter without each of its points."""
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    skip = np.linalg.norm(path[2:] - path[:-2], axis=1)
    return np.concatenate([step[:1], step[:-1] + step[1:] - skip, step[-1:]])


def _shortest_path(distance: FloatArray) -> IntArray:
    """Order, shape (m,), of a short open path: nearest neighbours from each end, then 2-opt."""
    paths = [_untangled(_greedy(distance, start), distance) for start in range(len(distance))]
    return min(paths, key=lambda path: float(distance[path[:-1], path[1:]].sum()))


def _greedy(distance: FloatArray, start: int) -> IntArray:
    left, path = np.ones(len(distance), bool), [start]
    left[start] = False
    while left.any():
        path.append(int(np.where(left, distance[path[-1]], np.inf).argmin()))
        left[path[-1]] = False
    return np.array(path)


def _untangled(path: IntArray, distance: FloatArray) -> IntArray:
    """Reverse stretches of the path while that shortens it (2-opt, Croes 1958); ends are free."""
    padded = np.zeros((len(path) + 1,) * 2)  # a point at distance zero of all closes the path
    padded[:-1, :-1] = distance
    while True:
        tour = np.concatenate([[-1], path, [-1]])
        now, after = tour[:-1], tour[1:]
        step = padded[now, after]
        change = padded[now[:, None], now] + padded[after[:, None], after] - step[:, None] - step
        i, j = np.unravel_index(np.triu(change, 1).argmin(), change.shape)
        if change[i, j] > -1e-12 or j <= i:
            return path
        path = np.concatenate([path[:i], path[i:j][::-1], path[j:]])
