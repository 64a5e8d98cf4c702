"""Which marker of a frame is which node of a surface that is followed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from cloth_predict.markers.association import checked, in_node_order, limit_of, match, squared
from cloth_predict.types import BoolArray, FloatArray


def no_points() -> FloatArray:
    """Return no points, shape (0, 3)."""
    return np.zeros((0, 3))


@dataclass(frozen=True)
class Expected:
    """What is expected of each node before its marker is known.

    position [m], shape (nodes, 3); covariance S [m^2], shape (nodes, 3, 3), of position and
    measurement together; each of the others has shape (nodes,). sure: its label is not doubted;
    doubtful: it was not seen for a while, so that only what was there before can be its marker.
    """

    position: FloatArray
    covariance: FloatArray
    sure: BoolArray
    doubtful: BoolArray


@dataclass(frozen=True)
class Identified:
    """The measurement of each node.

    positions [m], shape (nodes, 3), NaN where there is none; visible, shape (nodes,);
    relabelled: labelled markers that are at another node than that of their label; rejected:
    labelled markers at no node; matched and ghosts: points at a node, and at none;
    left [m], shape (rejected + ghosts, 3): the markers at no node.
    """

    positions: FloatArray
    visible: BoolArray
    relabelled: int = 0
    rejected: int = 0
    matched: int = 0
    ghosts: int = 0
    left: FloatArray = field(default_factory=no_points)

    @classmethod
    def as_labelled(cls, positions: FloatArray, visible: BoolArray) -> Identified:
        """Every labelled marker is at the node of its label."""
        return cls(np.where(visible[:, None], positions, np.nan), visible)


def identify(
    expected: Expected,
    labelled: Identified,
    points: FloatArray,
    earlier: FloatArray,
    reach: float,
    gate: float,
) -> Identified:
    """Find the measurement of each node among labelled markers and points without a label.

    points [m], shape (m, 3); earlier [m], shape (k, 3): what was left of the frame before, from
    which a marker moves by `reach` [m] at most; gate: probability, as in `match`. A labelled
    marker outside the gate of its node counts as one without a label. Those, and the points, are
    matched to the nodes that have no marker yet. Raises FrameError for one that is not finite.
    """
    positions, visible = labelled.positions.copy(), labelled.visible & expected.sure
    doubted = np.flatnonzero(labelled.visible & ~expected.sure)
    error = checked(positions[doubted]) - expected.position[doubted]
    visible[doubted] = inside(error, expected.covariance[doubted], gate)
    if visible[doubted].all() and not len(points):
        return labelled
    far, unseen = doubted[~visible[doubted]], np.flatnonzero(~visible)
    pool = np.concatenate([positions[far], checked(points)])
    node = match(expected.position[unseen], expected.covariance[unseen], pool, gate).node
    doubtful = np.append(expected.doubtful[unseen], False)[node]  # False of those at no node
    node[doubtful & ~near(pool, earlier, reach)] = -1
    positions[unseen], visible[unseen] = in_node_order(node, pool, len(unseen))
    taken = node >= 0
    moved, matched = int(taken[: len(far)].sum()), int(taken[len(far) :].sum())
    rejected, ghosts = len(far) - moved, len(points) - matched
    return Identified(positions, visible, moved, rejected, matched, ghosts, pool[~taken])


def inside(error: FloatArray, covariance: FloatArray, gate: float) -> BoolArray:
    """Whether errors [m], (m, 3), lie in the gate of their covariances [m^2], (m, 3, 3)."""
    return np.asarray(squared(error, covariance) < limit_of(gate))


def near(points: FloatArray, others: FloatArray, reach: float) -> BoolArray:
    """Whether each point [m], (m, 3), lies within `reach` [m] of one of the others, (k, 3)."""
    if not len(points) or not len(others):
        return np.zeros(len(points), bool)
    return np.asarray(cKDTree(others).query(points)[0] <= reach)
