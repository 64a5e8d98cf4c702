"""A surface that is being followed, and what one frame of markers does to it; no state of its own.

A track is never changed: a frame makes a new one, so that old ones can be gone back to.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cloth_predict.config import Config
from cloth_predict.filters.linear import nearest_positive_definite
from cloth_predict.markers.association import limit_of
from cloth_predict.markers.identification import Expected, Identified, identify, inside, no_points
from cloth_predict.observations import VisiblePositions
from cloth_predict.surface.driven import DrivenNodes
from cloth_predict.surface.starting import Start
from cloth_predict.tracking.motion import NANOSECONDS, moved, spread
from cloth_predict.types import Belief, BoolArray, FloatArray, Gaussian, Innovation, IntArray

DOUBTFUL = 0.1
"""Time [s] after which a node that was not seen takes no point that was not there before: its gate
is wide by then, and ghosts come and go."""
FASTEST = 5.0
"""Speed [m/s] that no marker exceeds."""


class Frame(NamedTuple):
    """What the mocap system says at one time.

    stamp [ns]; positions [m], shape (nodes, 3), and visible, shape (nodes,), of the labelled
    markers; points [m], shape (m, 3), of those without a label.
    """

    stamp: int
    positions: FloatArray
    visible: BoolArray
    points: FloatArray


@dataclass(frozen=True)
class Step:
    """What became of a frame.

    outcome: `updated`, `rewound` (late, and put in its place), `started` or `restarted`,
    `waiting` (not enough to start from), `late` or `duplicate` (these two change nothing);
    positions [m], shape (nodes, 3), NaN where unseen, and visible, shape (nodes,): what was taken
    as the measurement of each node; markers: how many were `relabelled` (moved to another node
    than that of their label), `rejected` (labelled, but at no node), `matched` (without a label,
    at a node) and `ghosts` (without a label, at no node); repairs: of the covariance.
    """

    outcome: str
    positions: FloatArray
    visible: BoolArray
    innovation: Innovation | None = None
    markers: Counter[str] = field(default_factory=Counter)
    repairs: int = 0

    @property
    def taken(self) -> bool:
        """Whether the frame changed the surface."""
        return self.outcome in ('updated', 'rewound', 'started', 'restarted')


@dataclass(frozen=True)
class Track:
    """The surface after a frame at `stamp` [ns].

    last [ns], shape (nodes,): when each node was seen; good [ns]: when most markers were at nodes;
    left [m], shape (k, 3): markers of the frame that were at no node.
    """

    stamp: int
    now: Start
    last: IntArray
    good: int
    left: FloatArray = field(default_factory=no_points)

    @property
    def belief(self) -> Belief:
        """What the filter believes of the state."""
        return self.now.belief

    @property
    def triangles(self) -> IntArray:
        """Triangles of markers, shape (t, 3); none of a chain."""
        return self.now.topology.triangles


def begin(start: Start, frame: Frame, config: Config) -> tuple[Track, Step]:
    """Track from a start at this frame, and which marker of the frame is which node."""
    track = Track(frame.stamp, start, np.full(len(frame.visible), frame.stamp), frame.stamp)
    found = _identified(track, frame, np.zeros(len(frame.visible), bool), config)
    return track, Step('started', found.positions, found.visible, markers=counted(found))


def follow(track: Track, frame: Frame, config: Config) -> tuple[Track, Step]:
    """Move on to a later frame and take it. Raises FloatingPointError where the filter fails.

    A covariance that is no longer positive definite is repaired, once.
    """
    try:
        return _follow(track, frame, config)
    except FloatingPointError:
        repaired = replace(track, now=replace(track.now, belief=_repaired(track.now.belief)))
        after, step = _follow(repaired, frame, config)
        return after, replace(step, repairs=step.repairs + 1)


def _follow(track: Track, frame: Frame, config: Config) -> tuple[Track, Step]:
    dt = (frame.stamp - track.stamp) / NANOSECONDS
    driven = track.now.driven.copy()
    driven.advance(dt)
    own = _in_place(driven, track, frame, config)
    driven.update(frame.positions, own)
    arrived = replace(track, now=moved(track.now, driven, dt, config))
    found = _identified(arrived, frame, own, config)
    others = found.visible & ~own
    if others[driven.nodes].any():  # what the driven nodes do is an input of the prediction
        driven = driven.copy()
        driven.update(found.positions, others)
        arrived = replace(track, now=moved(track.now, driven, dt, config))
    belief, innovation, sound = _updated(arrived.now, found, config)
    belief = belief if sound else _repaired(belief)
    last = np.where(found.visible, frame.stamp, track.last)
    lost = min(len(found.left), (~found.visible).sum()) > found.visible.sum()
    good = track.good if lost else frame.stamp
    after = Track(frame.stamp, replace(arrived.now, belief=belief), last, good, found.left)
    markers = counted(found)
    return after, Step(
        'updated', found.positions, found.visible, innovation, markers, int(not sound)
    )


def _in_place(driven: DrivenNodes, track: Track, frame: Frame, config: Config) -> BoolArray:
    """Driven nodes, shape (nodes,), whose labelled marker is where it should be."""
    own = np.zeros(len(frame.visible), bool)
    seen = driven.nodes[frame.visible[driven.nodes]]
    own[seen] = True
    if config.association.check_labels and len(seen):
        predicted, gate = np.zeros((len(own), 3)), np.zeros((len(own), 3, 3))
        predicted[driven.nodes] = driven.extrapolate(0.0)[0]
        gate[driven.nodes] = driven.variances(0.0)[:, None, None] * np.eye(3)
        gate += _allowance(track, frame, config)
        error = frame.positions[seen] - predicted[seen]
        own[seen] = inside(error, gate[seen], config.association.gate)
    return own


def _identified(track: Track, frame: Frame, own: BoolArray, config: Config) -> Identified:
    """Which marker is which node of a track that was moved to the frame; own: known already."""
    now, settings = track.now, config.association
    labelled = Identified.as_labelled(frame.positions, frame.visible)
    sure = own if settings.check_labels else frame.visible
    if not len(frame.points) and not (frame.visible & ~sure).any():
        return labelled
    held = now.driven.extrapolate(0.0)
    mesh, _ = now.mesh.surface(now.belief.mean, now.input(held[0], held[1]))
    known = spread(now, now.belief.marginals(now.layout.rows), 0.0)
    known += _allowance(track, frame, config)
    doubtful = frame.stamp - track.last > DOUBTFUL * NANOSECONDS
    expected = Expected(mesh[now.layout.markers], known, sure, doubtful)
    reach = FASTEST * (frame.stamp - track.stamp) / NANOSECONDS
    return identify(expected, labelled, frame.points, track.left, reach, settings.gate)


def _allowance(track: Track, frame: Frame, config: Config) -> FloatArray:
    """What the gate allows beyond the belief's covariance [m^2], shape (nodes, 3, 3)."""
    return allowance(frame.stamp - track.last, track.now.nearest, config)


def allowance(unseen: IntArray, nearest: FloatArray, config: Config) -> FloatArray:
    """What the gates of k markers allow beyond the belief's covariance [m^2], shape (k, 3, 3).

    It grows with the time unseen [ns], shape (k,), until the gate reaches as far as to the nearest
    neighbour [m], shape (k,).
    """
    settings = config.association
    widest = nearest / limit_of(settings.gate) ** 0.5
    slack = np.minimum(
        settings.slack + settings.drift * (unseen / NANOSECONDS),
        np.maximum(widest, settings.slack),
    )
    variance = slack**2 + config.filter.measurement_noise**2
    return np.asarray(variance[:, None, None] * np.eye(3))


def _updated(now: Start, found: Identified, config: Config) -> tuple[Belief, Innovation, bool]:
    """Belief given what was found, what was learnt, and whether its variances are positive."""
    rows, free = now.layout.rows, now.layout.free
    seen = found.visible[free]
    obs = VisiblePositions.of_rows(rows[seen].ravel(), config.filter.measurement_noise)
    z = found.positions[free[seen]].ravel()
    belief, innovation = now.filter.update(now.belief, obs, z)
    known = belief.marginals(rows)
    if not np.isfinite(belief.mean).all() or not np.isfinite(known).all():
        raise FloatingPointError('the estimate is not finite')
    return belief, innovation, bool((np.diagonal(known, axis1=1, axis2=2) > 0).all())


def _repaired(belief: Belief) -> Belief:
    """Belief with the nearest covariance that is positive definite.

    Raises FloatingPointError where there is none, or where the filter keeps no such covariance.
    """
    if not isinstance(belief, Gaussian) or not np.isfinite(belief.cov).all():
        raise FloatingPointError('the covariance cannot be repaired')
    return replace(belief, cov=nearest_positive_definite(belief.cov))


def counted(found: Identified) -> Counter[str]:
    """Markers by what they were taken for, as in `Step.markers`."""
    return Counter(
        relabelled=found.relabelled,
        rejected=found.rejected,
        matched=found.matched,
        ghosts=found.ghosts,
    )
