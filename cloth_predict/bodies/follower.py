"""A closed body that deforms, as a tracker follows it."""

from __future__ import annotations

import numpy as np

from cloth_predict.bodies.registration import found_again
from cloth_predict.bodies.starting import Starter
from cloth_predict.bodies.track import BodyTrack, ahead, begin, follow
from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.models.accelerated import Accelerated
from cloth_predict.surface.topology import sides_of
from cloth_predict.tracking.limits import spread
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.settling import Rest
from cloth_predict.tracking.track import Frame, Step
from cloth_predict.types import FloatArray, IntArray, Surface

WHOLE = 0.8
"""Share of its markers with which a body can be started as well as at first."""


class BodyFollower:
    """Starts a body and follows it."""

    def __init__(self, config: Config) -> None:
        """Prepare. Raises ConfigError for parameters of a body that are none."""
        self._config = config
        self._starter = Starter(config)

    @property
    def reason(self) -> str:
        """What a start still lacks, in a line."""
        return self._starter.reason

    def start(self, frame: Frame) -> tuple[BodyTrack, Step] | None:
        """Start at a frame, or None where it shows no body."""
        start = self._starter.offer(frame)
        return None if start is None else begin(start, frame)

    def follow(self, track: BodyTrack, frame: Frame) -> tuple[BodyTrack, Step]:
        """Move on to a later frame and take it."""
        return follow(track, frame, self._config)

    def recover(
        self, before: BodyTrack, after: BodyTrack, frame: Frame
    ) -> tuple[BodyTrack, Step] | None:
        """Find a body that is gone by its shape, if it is among the markers of the frame.

        Where it is not, it is started anew: at once if nearly all of its markers are back, as a
        soft one may have another shape by now, or else after `association.patience`.
        """
        if not before.gone:
            return None
        again = found_again(before, frame, self._config)
        if again is not None:
            return follow(again, frame, self._config)
        whole = len(frame.points) + frame.visible.sum() >= WHOLE * len(before.attached)
        patience = self._config.association.patience * NANOSECONDS
        return self.start(frame) if whole or after.stamp - after.good > patience else None

    def estimate(self, track: BodyTrack) -> Surface:
        """Return the surface at the frame of the track."""
        return _surface(track, track.stamp)

    def edges(self, track: BodyTrack) -> IntArray:
        """Return the neighbours among the published nodes, shape (edges, 2)."""
        return np.unique(sides_of(track.triangles).reshape(-1, 2), axis=0)

    def loads(self, track: BodyTrack) -> FloatArray | None:
        """Return the unknown force [N] on the part of each published node, (nodes, 3), or None.

        It is what gives that part of the mass the acceleration by which the body is pushed.
        """
        assembly, mean = track.assembly, track.belief.mean
        model, shown = assembly.model, assembly.shown
        if not isinstance(model, Accelerated):
            return None
        q, push = mean[: model.body.dim_q], np.zeros(model.body.dim_q)
        push[model.coordinates] = mean[model.body.dim_x :][: len(model.coordinates)]
        acceleration = shown.motion(q, np.zeros_like(q), push)[2]
        return np.asarray(self._config.model.mass * shown.mesh.shares[:, None] * acceleration)

    def predict(self, track: BodyTrack, horizon: float) -> tuple[Surface, float]:
        """Return the surface `horizon` [s] ahead, and its sigma [m]. Raises FrameError."""
        try:
            there = ahead(track, horizon, self._config.filter.predict_step)
        except FloatingPointError as error:
            raise FrameError(f'the prediction fails: {error}') from None
        found = _surface(there, track.stamp + round(horizon * NANOSECONDS))
        if not np.isfinite(found.position).all():
            raise FrameError('the prediction is not finite')
        return found, spread(found, np.arange(len(found.position)))

    def rest(self, track: BodyTrack) -> Rest:
        """A body tells none: raises FrameError."""
        raise FrameError(
            f'a body (model.kind {self._config.model.kind}) tells no rest, only a surface of '
            'springs does'
        )


def _surface(track: BodyTrack, stamp: int) -> Surface:
    """The published nodes of a body, at a time [ns]."""
    assembly, mean = track.assembly, track.belief.mean
    size, shown = assembly.body.dim_q, assembly.shown
    second = assembly.model.f(mean, assembly.still)[size : 2 * size]
    position, velocity, acceleration = shown.motion(mean[:size], mean[size : 2 * size], second)
    covariance = shown.covariance(track.covariances(np.arange(assembly.body.nodes)))
    normal = shown.mesh.normals(position)
    return Surface(stamp, position, velocity, acceleration, covariance, normal)
