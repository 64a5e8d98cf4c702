"""Labels for the markers of the first frames that come without: by shape, then by place."""

from __future__ import annotations

import numpy as np

from cloth_predict.config import ModelConfig
from cloth_predict.errors import FrameError
from cloth_predict.markers.association import in_node_order, limit_of, match
from cloth_predict.markers.matching import find_grid
from cloth_predict.surface.assembly import lengths_of, rest_shape
from cloth_predict.types import BoolArray, FloatArray, IntArray

REACH = 0.4
"""Farthest way of a node from frame to frame, by the median edge."""
GATE = 0.999
"""Any: the covariances are such that the gate lies where it has to."""
SHORTEST = 1e-9
"""Reach [m] where all nodes are at one place."""


def label(
    model: ModelConfig, positions: FloatArray, visible: BoolArray, points: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Find the hidden nodes among points without a label, from the shape of the surface alone.

    positions [m], shape (nodes, 3), and visible, shape (nodes,): the labelled markers, and in what
    is returned the found ones too; points [m], shape (m, 3). Raises FrameError, which names both
    sizes, where the markers do not make such a surface.
    """
    if model.topology == 'grid':
        return _in_grid(model, positions, visible, points)
    if visible.any():
        return positions, visible  # which of the others is a point, nothing tells
    if model.topology == 'edges':
        raise FrameError(
            f'{len(points)} markers without labels for {model.name}: topology edges needs labels'
        )
    if len(points) != model.nodes:
        raise FrameError(
            f'{len(points)} markers without labels do not fit {model.name}: topology delaunay '
            f'takes them in the order in which they come'
        )
    return points, np.ones(model.nodes, bool)


def _in_grid(
    model: ModelConfig, positions: FloatArray, visible: BoolArray, points: FloatArray
) -> tuple[FloatArray, BoolArray]:
    labelled = np.flatnonzero(visible)
    cloud = np.concatenate([positions[labelled], points])
    known = np.append(labelled, np.full(len(points), -1))
    try:
        node = find_grid(cloud, model.rows, model.cols, rest_shape(model), known)
    except FrameError as error:
        raise FrameError(f'{len(cloud)} markers do not fit {model.name}: {error}') from None
    wrong = (node[: len(labelled)] >= 0) & (node[: len(labelled)] != labelled)
    if wrong.any():
        k = int(wrong.argmax())
        raise FrameError(f'the marker labelled as node {labelled[k]} lies at node {node[k]}')
    node[: len(labelled)] = labelled
    return in_node_order(node, cloud, model.count)


def follow(
    before: FloatArray,
    edges: IntArray,
    positions: FloatArray,
    visible: BoolArray,
    points: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Find the hidden nodes among points without a label where they were `before`, or near.

    before [m], shape (nodes, 3); edges, shape (edges, 2): a point farther away than 0.4 of the
    median edge is left out. The others as in `label`.
    """
    reach = max(REACH * float(np.median(lengths_of(edges, before))), SHORTEST)
    hidden = np.flatnonzero(~visible)
    cov = np.tile(reach**2 / limit_of(GATE) * np.eye(3), (len(hidden), 1, 1))
    node = match(before[hidden], cov, points, GATE).node
    found, there = positions.copy(), visible.copy()
    found[hidden[node[node >= 0]]] = points[node >= 0]
    there[hidden[node[node >= 0]]] = True
    return found, there
