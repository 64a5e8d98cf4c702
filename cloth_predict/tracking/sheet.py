"""A surface of springs, as a tracker follows it."""

from __future__ import annotations

import numpy as np

from cloth_predict.config import Config
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.surface.starting import Starter
from cloth_predict.tracking.limits import spread
from cloth_predict.tracking.motion import NANOSECONDS, ahead, surface, uncertainty
from cloth_predict.tracking.settling import Rest, rest
from cloth_predict.tracking.track import Frame, Step, Track, begin, follow
from cloth_predict.types import FloatArray, IntArray, Surface


class SheetFollower:
    """Starts a surface of springs and follows it."""

    def __init__(self, config: Config) -> None:
        """Prepare; the surface starts with the first frames that show enough of it."""
        self._config = config
        self._starter = Starter(config)

    @property
    def reason(self) -> str:
        """What a start still lacks, in a line."""
        return self._starter.reason

    def start(self, frame: Frame) -> tuple[Track, Step] | None:
        """Start at a frame, or None where it takes more."""
        start = self._starter.offer(*frame)
        return None if start is None else begin(start, frame, self._config)

    def follow(self, track: Track, frame: Frame) -> tuple[Track, Step]:
        """Move on to a later frame and take it."""
        return follow(track, frame, self._config)

    def recover(self, before: Track, after: Track, frame: Frame) -> tuple[Track, Step] | None:
        """Start anew where most markers have been elsewhere, or gone, for long.

        What is believed after such an absence is no guess to find the markers by.
        """
        return self.start(frame) if self._is_lost(before, after, frame) else None

    def _is_lost(self, before: Track, after: Track, frame: Frame) -> bool:
        patience = self._config.association.patience * NANOSECONDS
        if after.stamp - after.good > patience:
            return True
        back = 2 * (frame.visible.sum() + len(frame.points)) > len(frame.visible)
        absent = np.median(before.stamp - before.last) > patience
        limit = self._config.limits.sigma_error
        return bool(back and absent and uncertainty(before.now) > limit)

    def estimate(self, track: Track) -> Surface:
        """Return the surface at the frame of the track."""
        belief = track.belief
        known = belief.marginals(track.now.layout.rows)
        return surface(track.now, belief.mean, known, track.stamp, 0.0)

    def edges(self, track: Track) -> IntArray:
        """Return the neighbours among the markers, shape (edges, 2)."""
        return track.now.topology.edges

    def loads(self, track: Track) -> FloatArray | None:
        """Return the unknown force [N] on the part of each marker, (markers, 3), or None.

        The forces on the nodes of a mesh between the markers count at those around them, so that
        the sum is that of all nodes. Nothing is known of driven markers: theirs is 0.
        """
        now, layout = track.now, track.now.layout
        if not isinstance(now.model, Disturbed):
            return None
        mean, u = now.belief.mean, now.input(*now.driven.extrapolate(0.0)[:2])
        rates = slice(now.mesh.dim_x // 2, now.mesh.dim_x)
        known = now.mesh.f(mean[: now.mesh.dim_x], u)[rates]
        force = now.mesh.mass3 * (now.model.f(mean, u)[rates] - known)
        loads = np.zeros((len(layout.markers), 3))
        loads[layout.free] = layout.interpolation.T @ force.reshape(-1, 3)
        return loads

    def predict(self, track: Track, horizon: float) -> tuple[Surface, float]:
        """Return the surface `horizon` [s] ahead, and its sigma [m]. Raises FrameError."""
        mean, cov = ahead(track.now, horizon, self._config)
        found = surface(track.now, mean, cov, track.stamp, horizon)
        return found, spread(found, track.now.layout.free)

    def rest(self, track: Track) -> Rest:
        """Return when and in which shape the motion ends. Raises FrameError."""
        return rest(track, self._config)
