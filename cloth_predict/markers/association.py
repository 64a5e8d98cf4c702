"""Which marker is which node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from cloth_predict.config import Config
from cloth_predict.errors import FormatError, FrameError
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

GATE = 0.999
"""Share of the true points that lie inside the gate."""


@dataclass(frozen=True)
class Match:
    """Which node each point is: `node`, shape (m,), -1 for a ghost; and how many were left over.

    ghosts: points without a node; missing: nodes without a point.
    """

    node: IntArray
    ghosts: int
    missing: int


def markers_of_nodes(sequence: MarkerSequence, config: Config, source: str) -> MarkerSequence:
    """Put a recording's markers in node order, as chosen by the parameter `labels`.

    Without `labels` the order of the recording is that of the nodes; a body, which finds a node
    for each label, may have fewer of them. Raises FormatError naming the recording and the label
    or the two sizes that do not fit.
    """
    if sequence.frame_id not in ('', config.frame):
        raise FormatError(
            f'{source}: the markers are in the frame {sequence.frame_id!r}, but the parameter '
            f'frame is {config.frame!r}'
        )
    if config.labels:
        sequence = choose(sequence, config.labels, source)
    nodes = config.model.count
    labelled = np.flatnonzero(~sequence.unlabelled)
    if not config.labels and (len(labelled) == nodes or config.model.is_body):
        sequence = sequence.select(labelled)  # others in view are left out
    if config.model.is_body and len(sequence.labels) < nodes:
        sequence = sequence.beside(_hidden(sequence, nodes - len(sequence.labels)))
    if len(sequence.labels) != nodes:
        raise FormatError(
            f'{source}: {len(sequence.labels)} markers ({_listed(sequence.labels)}) do not fit '
            f'{config.model.counted_by} = {config.model.name}; choose the markers with the '
            f'parameter labels'
        )
    return sequence


def _hidden(like: MarkerSequence, count: int) -> MarkerSequence:
    """As many markers that are never seen."""
    names = tuple(f'hidden {k}' for k in range(count))
    visible = np.zeros((len(like), count), bool)
    positions = np.full((*visible.shape, 3), np.nan)
    return MarkerSequence(like.stamps, names, positions, visible, like.frame_id)


def choose(sequence: MarkerSequence, labels: tuple[str, ...], source: str) -> MarkerSequence:
    """Return these markers, in this order. Raises FormatError naming a label that is not there."""
    column = {label: i for i, label in enumerate(sequence.labels)}
    for label in labels:
        if label not in column:
            raise FormatError(
                f'{source}: no marker {label!r} (there are {_listed(sequence.labels)})'
            )
    return sequence.select([column[label] for label in labels])


def match(
    predicted: FloatArray, covariances: FloatArray, points: FloatArray, gate: float = GATE
) -> Match:
    """Assign unlabelled points to nodes: global nearest neighbour inside a gate.

    predicted [m], shape (nodes, 3); covariances S [m^2], shape (nodes, 3, 3), of prediction and
    measurement together; points [m], shape (m, 3); gate: probability. Minimises the sum of
    d^2 = e' S^-1 e, where a node without a point costs as much as the gate, the quantile of
    chi-square with 3 degrees (Bar-Shalom and Li 1995, sections 2.3 and 2.5). Raises FrameError for
    points of another shape or not finite.
    """
    points, limit = checked(points), limit_of(gate)
    i, j, cost = _candidates(predicted, covariances, points, limit)
    node = np.full(len(points), -1)
    alone = (np.bincount(i, minlength=1)[i] == 1) & (np.bincount(j, minlength=1)[j] == 1)
    node[j[alone]] = i[alone]
    i, j, cost = i[~alone], j[~alone], cost[~alone]
    rows, i = np.unique(i, return_inverse=True)
    columns, j = np.unique(j, return_inverse=True)
    table = np.full((len(rows), len(columns)), limit)
    table[i, j] = cost
    row, column = linear_sum_assignment(table)
    cheap = table[row, column] < limit
    node[columns[column[cheap]]] = rows[row[cheap]]
    found = int((node >= 0).sum())
    return Match(node, len(points) - found, len(predicted) - found)


def in_node_order(node: IntArray, points: FloatArray, nodes: int) -> tuple[FloatArray, BoolArray]:
    """Positions [m], shape (nodes, 3), NaN where there is no point, and visible, shape (nodes,).

    node, shape (m,): the node of each point, or -1; points [m], shape (m, 3).
    """
    positions, visible = np.full((nodes, 3), np.nan), np.zeros(nodes, bool)
    positions[node[node >= 0]] = points[node >= 0]
    visible[node[node >= 0]] = True
    return positions, visible


def checked(points: FloatArray) -> FloatArray:
    """Return the points. Raises FrameError unless they have shape (m, 3) and are finite."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise FrameError(f'points have shape {points.shape}, expected (m, 3)')
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise FrameError(f'point {int(bad.argmax())} has a coordinate that is not finite')
    return points


def limit_of(gate: float) -> float:
    """Quantile of chi-square with 3 degrees. Raises ValueError unless 0 < gate < 1."""
    if not 0 < gate < 1:
        raise ValueError(f'gate must lie between 0 and 1, not {gate}')
    return float(2.0 * gammaincinv(1.5, gate))


def squared(error: FloatArray, covariances: FloatArray) -> FloatArray:
    """Mahalanobis distances squared e' S^-1 e, shape (m,), of (m, 3) [m] and (m, 3, 3) [m^2]."""
    return np.asarray((error * np.linalg.solve(covariances, error[..., None])[..., 0]).sum(-1))


def _candidates(
    predicted: FloatArray, covariances: FloatArray, points: FloatArray, limit: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Nodes i, points j and squared distances, each (pairs,), of all pairs inside the gate."""
    if not len(points) or not len(predicted):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    # the trace bounds the largest eigenvalue, so that the sphere holds the ellipsoid of the gate
    radius = np.sqrt(limit * np.trace(covariances, axis1=1, axis2=2))
    near = cKDTree(points).query_ball_point(predicted, radius)
    i = np.repeat(np.arange(len(predicted)), [len(found) for found in near])
    j = np.concatenate(near).astype(np.int64)
    cost = squared(points[j] - predicted[i], covariances[i])
    near_enough = cost < limit
    return i[near_enough], j[near_enough], cost[near_enough]


def _listed(labels: tuple[str, ...], most: int = 4) -> str:
    shown = ', '.join(labels[:most])
    return f'{shown}, ... {labels[-1]}' if len(labels) > most else shown or 'none'
