"""Finding a body again whose shape is known: the rigid motion that lays it onto the markers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from cloth_predict.bodies.association import UNNAMED, spacing
from cloth_predict.bodies.track import BodyTrack, ahead
from cloth_predict.config import Config
from cloth_predict.models import rotation
from cloth_predict.models.superquadric import GLOBAL, ROTATION, TRANSLATION
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.track import Frame
from cloth_predict.types import FloatArray, Gaussian

FEWEST, SHARE = 8, 0.25
"""Markers, and share of those on a body, that fix its motion with some to spare."""
CLOSE = 0.25
"""RMS distance, by that between markers, up to which a body is found."""
ROUNDS = 50
"""Rounds of pairing after which an alignment is taken as it is."""


@dataclass(frozen=True)
class Motion:
    """A rigid motion, x -> rotation x + shift [m], and the RMS distance [m] that it leaves."""

    rotation: FloatArray
    shift: FloatArray
    rms: float

    def apply(self, places: FloatArray) -> FloatArray:
        """Move places [m], shape (k, 3)."""
        return np.asarray(places @ self.rotation.T + self.shift)


def aligned(places: FloatArray, points: FloatArray) -> Motion:
    """The motion that lays places onto points, pair by pair [m], both (k, 3).

    Of points on a line, which do not tell it, any of those that fit best.
    """
    middle, target = places.mean(axis=0), points.mean(axis=0)
    turn = rotation.nearest((points - target).T @ (places - middle))
    found = Motion(turn, target - turn @ middle, np.inf)
    off = np.sum((found.apply(places) - points) ** 2, axis=1)
    return replace(found, rms=float(np.sqrt(off.mean())))


def registered(places: FloatArray, points: FloatArray) -> Motion:
    """The motion of places [m], (k, 3), onto points [m], (m, 3), of which none is known by name.

    From where they are, from the centres of mass, and from each way in which the principal axes of
    the one fit on those of the other, nearest points are paired until the pairs stay (iterated
    closest points: Besl and McKay 1992); of these motions the closest is taken.
    """
    found = [_closest(places, points, start) for start in _starts(places, points)]
    return min(found, key=lambda motion: motion.rms)


def _starts(places: FloatArray, points: FloatArray) -> Iterator[Motion]:
    middle, target = places.mean(axis=0), points.mean(axis=0)
    ours, theirs = _axes(places - middle), _axes(points - target)
    yield Motion(np.eye(3), np.zeros(3), np.inf)
    turns = [np.eye(3)]
    for x, y in product((1.0, -1.0), repeat=2):
        turns.append(theirs @ np.diag([x, y, x * y]) @ ours.T)
    for turn in turns:
        yield Motion(turn, target - turn @ middle, np.inf)


def _axes(off: FloatArray) -> FloatArray:
    """Principal axes as columns of a rotation, shape (3, 3)."""
    axes = np.linalg.svd(off, full_matrices=False)[2].T
    return np.asarray(axes * [1.0, 1.0, np.sign(np.linalg.det(axes))])


def _closest(places: FloatArray, points: FloatArray, motion: Motion) -> Motion:
    pairs = np.full(len(points), -1)
    for _ in range(ROUNDS):
        nearest = cKDTree(motion.apply(places)).query(points)[1]
        if np.array_equal(nearest, pairs):
            break
        pairs = nearest
        motion = aligned(places[pairs], points)
    return motion


def found_again(track: BodyTrack, frame: Frame, config: Config) -> BodyTrack | None:
    """The body of a track, at rest where the markers of a frame are, or None if it is not there.

    It keeps its shape as it was carried on to the frame, and its markers their nodes.
    """
    if len(frame.points) + frame.visible.sum() < max(FEWEST, SHARE * len(track.attached)):
        return None
    gone = ahead(track, (frame.stamp - track.stamp) / NANOSECONDS, config.filter.max_step)
    places, seen = gone.places, np.concatenate([frame.positions[frame.visible], frame.points])
    close = CLOSE * float(np.median(spacing(places)))
    motion = _by_labels(gone, frame)
    if motion is None or motion.rms > close:
        motion = registered(places, seen)
    if motion.rms > close:
        return None
    assembly, q = track.assembly, gone.belief.mean[: track.assembly.body.dim_q].copy()
    q[TRANSLATION] = motion.apply(q[TRANSLATION])
    q[ROTATION] = rotation.from_matrix(motion.rotation @ gone.rotation)
    rows = np.arange(len(q))[:, None]
    sigma = assembly.first.copy()
    sigma[: len(q)] = np.sqrt(gone.belief.marginals(rows)[:, 0, 0])
    sigma[TRANSLATION], sigma[ROTATION] = close, close / q[GLOBAL.start]
    prior = Gaussian(assembly.at_rest(q), np.diag(sigma**2))
    belief = assembly.filter.start(prior, assembly.model, assembly.still, assembly.noise)
    everyone = np.ones(len(track.attached), bool)
    attached = track.attached.seen_at(frame.stamp, everyone)
    return replace(gone, stamp=frame.stamp, belief=belief, attached=attached)


def _by_labels(track: BodyTrack, frame: Frame) -> Motion | None:
    """The motion onto the markers that have a label, or None where they do not fix it."""
    named = np.flatnonzero(track.attached.label != UNNAMED)
    label = track.attached.label[named]
    seen = frame.visible[label]
    if seen.sum() < FEWEST:
        return None
    return aligned(track.places[named[seen]], frame.positions[label[seen]])
