"""A body that is being followed, and what one frame of markers does to it; no state of its own.

A track is never changed: a frame makes a new one, so that old ones can be gone back to.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cloth_predict.bodies.assembly import Assembly
from cloth_predict.bodies.association import UNNAMED, Attached, attach, spacing
from cloth_predict.bodies.filling import Filling
from cloth_predict.bodies.starting import Start
from cloth_predict.config import Config
from cloth_predict.filters.blocks import BlockGaussian
from cloth_predict.filters.decoupled import position_covariances
from cloth_predict.markers.identification import (
    Expected,
    Identified,
    identify,
    inside,
    near,
    no_points,
)
from cloth_predict.observations import NodePositions
from cloth_predict.tracking.motion import NANOSECONDS, split
from cloth_predict.tracking.track import DOUBTFUL, FASTEST, Frame, Step, allowance, counted
from cloth_predict.types import Belief, FloatArray, Gaussian, Innovation, IntArray


@dataclass(frozen=True)
class BodyTrack:
    """A body after a frame at `stamp` [ns].

    attached: the markers on it; filling: of the nodes without one; good [ns]: when most markers
    were where they should be; renewed [ns]: when those without a label were attached anew; left
    [m], shape (k, 3): markers of the frame that were not on the body.
    """

    stamp: int
    assembly: Assembly
    belief: Belief
    attached: Attached
    filling: Filling
    good: int
    renewed: int
    left: FloatArray = field(default_factory=no_points)

    @property
    def triangles(self) -> IntArray:
        """Triangles of the published nodes, shape (t, 3)."""
        return self.assembly.shown.mesh.triangles

    @cached_property
    def position(self) -> FloatArray:
        """Positions of the nodes [m], shape (nodes, 3)."""
        return self.assembly.body.position(self.belief.mean)

    @cached_property
    def rotation(self) -> FloatArray:
        """From the frame of the body, shape (3, 3)."""
        return self.assembly.body.rotation(self.belief.mean)

    @property
    def places(self) -> FloatArray:
        """Where the markers are [m], shape (markers, 3)."""
        return self.attached.place(self.position, self.rotation)

    @property
    def gone(self) -> bool:
        """Whether most of the markers have not been seen for a while."""
        unseen = np.median(self.stamp - self.attached.seen)
        return bool(unseen > DOUBTFUL * NANOSECONDS)

    def covariances(self, nodes: IntArray) -> FloatArray:
        """Covariance of the position of these nodes [m^2], shape (m, 3, 3)."""
        return position_covariances(self.belief, NodePositions(self.assembly.body, nodes, 0.0))


def begin(start: Start, frame: Frame) -> tuple[BodyTrack, Step]:
    """Track from a start at this frame, and what of the frame is at which node."""
    stamp, attached = frame.stamp, start.attached
    filling = Filling.of(start.assembly.body, attached.node)
    belief = filling.applied(start.belief)
    track = BodyTrack(stamp, start.assembly, belief, attached, filling, stamp, stamp)
    named = int((attached.label != UNNAMED).sum())
    found = replace(
        Identified.as_labelled(start.places, np.ones(len(attached), bool)),
        matched=len(attached) - named,
        rejected=int(frame.visible.sum()) - named,
        ghosts=len(frame.points) - len(attached) + named,
    )
    return track, _told(track, found, 'started')


def follow(track: BodyTrack, frame: Frame, config: Config) -> tuple[BodyTrack, Step]:
    """Move on to a later frame and take it. Raises FloatingPointError where the filter fails.

    A body that is gone moves on as a rigid one: for a while its shape is what it was.
    """
    arrived = ahead(track, (frame.stamp - track.stamp) / NANOSECONDS, config.filter.max_step)
    attached, assembly = arrived.attached, track.assembly
    found = _identified(arrived, frame, config)
    seen = found.visible
    z = attached.of_nodes(found.positions, arrived.rotation)[seen]
    obs = NodePositions(assembly.body, attached.node[seen], config.filter.measurement_noise)
    belief, innovation = assembly.filter.update(arrived.belief, obs, z.ravel())
    if not np.isfinite(belief.mean).all():
        raise FloatingPointError('the estimate is not finite')
    lost = bool(len(found.left)) and not seen.any()
    belief = _moved_to(belief, assembly.model.admissible(belief.mean))
    if track.gone:
        belief = _moved_to(belief, assembly.rigid(belief.mean))
    updated = replace(
        arrived,
        stamp=frame.stamp,
        belief=track.filling.applied(belief),
        attached=attached.seen_at(frame.stamp, seen),
        good=track.good if lost else frame.stamp,
        left=found.left,
    )
    step = _told(updated, found, 'updated', innovation)
    if not lost:
        reach = FASTEST * (frame.stamp - track.stamp) / NANOSECONDS
        grown = _grown(updated, frame, track.left, reach, config)
        updated = _renewed(grown, found, config)
    return updated, step


def ahead(track: BodyTrack, dt: float, longest: float) -> BodyTrack:
    """The body dt [s] later; a motion that is not linear takes steps no longer than `longest`."""
    assembly, belief = track.assembly, track.belief
    steps, part = split(dt, longest)
    if assembly.body.linear:
        steps, part = min(steps, 1), dt
    for _ in range(steps):
        belief = assembly.filter.predict(
            belief, assembly.model, assembly.still, assembly.noise, part
        )
    return replace(track, belief=belief)


def _identified(track: BodyTrack, frame: Frame, config: Config) -> Identified:
    """Which marker of a frame is which of those attached, of a track moved to the frame.

    None is where most are somewhere else, as those that are at a place of one are there by chance,
    and none of a body that was gone for a while: what is believed of it is no guess by then.
    """
    attached, settings = track.attached, config.association
    named = np.flatnonzero(attached.label != UNNAMED)
    positions, visible = np.full((len(attached), 3), np.nan), np.zeros(len(attached), bool)
    positions[named] = frame.positions[attached.label[named]]
    visible[named] = frame.visible[attached.label[named]]
    places, unseen = track.places, frame.stamp - attached.seen
    known = track.covariances(attached.node) + allowance(unseen, spacing(places), config)
    sure = visible & (not settings.check_labels)
    expected = Expected(places, known, sure, unseen > DOUBTFUL * NANOSECONDS)
    reach = FASTEST * (frame.stamp - track.stamp) / NANOSECONDS
    labelled = Identified.as_labelled(positions, visible)
    if not track.gone:
        found = identify(expected, labelled, frame.points, track.left, reach, settings.gate)
        if min(len(found.left), (~found.visible).sum()) <= found.visible.sum():
            return found
    nobody = Identified.as_labelled(positions, np.zeros_like(visible))
    far = positions[visible]
    left = np.concatenate([far, frame.points])
    return replace(nobody, rejected=len(far), ghosts=len(frame.points), left=left)


def _grown(
    track: BodyTrack, frame: Frame, earlier: FloatArray, reach: float, config: Config
) -> BodyTrack:
    """Attach markers of the frame of which nothing was known, if they are on the surface.

    Those are labels that were never seen, and what is at no marker and was there before: earlier
    [m], shape (k, 3), is what was left of the frame before, from which a marker moves by `reach`.
    """
    attached, body = track.attached, track.assembly.body
    labels = np.setdiff1d(np.flatnonzero(frame.visible), attached.label)
    stays = near(track.left, earlier, reach)
    places = np.concatenate([frame.positions[labels], track.left[stays]])
    if not len(places):
        return track
    label = np.append(labels, np.full(int(stays.sum()), UNNAMED))
    new = attach(places, label, frame.stamp, body.mesh, track.position, track.rotation)
    off = new.of_nodes(places, track.rotation) - track.position[new.node]
    known = track.covariances(new.node) + allowance(0 * new.seen, spacing(places), config)
    on_body = inside(off, known, config.association.gate)
    left = np.delete(track.left, np.flatnonzero(stays)[on_body[len(labels) :]], axis=0)
    return _attached(replace(track, left=left), attached.joined(new.kept(on_body)))


def _attached(track: BodyTrack, attached: Attached) -> BodyTrack:
    """The body with these markers."""
    filling = track.filling.between(attached.node, track.assembly.body)
    return replace(track, attached=attached, filling=filling)


def _renewed(track: BodyTrack, found: Identified, config: Config) -> BodyTrack:
    """Attach what has no label to the nodes that are nearest now; forget what is seen no more."""
    attached, stamp, body = track.attached, track.stamp, track.assembly.body
    due = stamp - track.renewed >= config.body.reattach * NANOSECONDS
    if not due or 2 * found.visible.sum() < len(found.visible):
        return track
    unnamed = attached.label == UNNAMED
    kept = ~unnamed | (attached.seen >= track.renewed)
    rows = np.flatnonzero(found.visible & unnamed[: len(found.visible)])
    places = found.positions[rows]
    new = attach(places, attached.label[rows], stamp, body.mesh, track.position, track.rotation)
    moved = new.node != attached.node[rows]
    attached = attached.replaced(rows[moved], new.kept(moved)).kept(kept)
    return _attached(replace(track, renewed=stamp), attached)


def _told(
    track: BodyTrack, found: Identified, outcome: str, innovation: Innovation | None = None
) -> Step:
    """What became of the frame.

    Where a marker is off the estimate, the published node nearest to its node was measured to be
    off it as much: the mean of the markers there.
    """
    shown, seen = track.assembly.shown, found.visible
    position = shown.position(track.belief.mean[: track.assembly.body.dim_q])
    node, off = shown.node[track.attached.node], found.positions - track.places
    count = np.bincount(node[seen], minlength=len(position))
    for axis in range(3):
        total = np.bincount(node[seen], off[seen, axis], len(position))
        position[:, axis] += total / np.where(count, count, np.nan)
    return Step(outcome, position, count > 0, innovation, counted(found))


def _moved_to(belief: Belief, mean: FloatArray) -> Belief:
    """The belief with another mean."""
    assert isinstance(belief, (Gaussian, BlockGaussian))
    return replace(belief, mean=mean)
