"""A bar that is followed through a video: what its motion tells, and where it will rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config.ruler_video import RulerVideoConfig
from cloth_predict.errors import UncertainError
from cloth_predict.models.ruler import Ruler
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.ruler import RulerTracker
from cloth_predict.tracking.ruler_assembly import STATES
from cloth_predict.tracking.stopping import Stop
from cloth_predict.types import FloatArray, Gaussian
from cloth_predict.video.detector import BarDetector
from cloth_predict.video.files import Frame
from cloth_predict.video.watching import Sighting, Watcher

MU = STATES.index('mu')
SPEED = np.array([STATES.index('V_x'), STATES.index('V_y')])
FAR = 10.0
"""Times the sigma under which a place of rest is told."""
IDENTIFIED = ('mu', 'L', 'L1', 'L2')


@dataclass(frozen=True)
class Rest:
    """Where and when the bar comes to rest, as a frame of time `since` [ns] told.

    time [s]: of the rest, as the stamps of the frames; stop: pose and covariance; certain: whether
    it is known as well as is asked for.
    """

    since: int
    time: float
    stop: Stop
    certain: bool


@dataclass(frozen=True)
class Seen:
    """What is known of the bar after a frame.

    outcome: of the tracker's step; belief: of the joint state, None before the start; rest: the
    latest prediction of it, None where no end is in sight.
    """

    frame: Frame
    sighting: Sighting
    outcome: str
    belief: Gaussian | None = None
    ruler: Ruler | None = None
    state: FloatArray | None = None
    rest: Rest | None = None

    @property
    def values(self) -> dict[str, tuple[float, float]]:
        """Identified values and their sigmas, by name [m, or 1 of mu]; empty before the start."""
        if self.belief is None:
            return {}
        sigma = np.sqrt(self.belief.cov.diagonal())
        at = ((name, STATES.index(name)) for name in IDENTIFIED)
        return {name: (float(self.belief.mean[i]), float(sigma[i])) for name, i in at}

    @property
    def certain_rest(self) -> Rest | None:
        """The rest, where it is known as well as is asked for."""
        return self.rest if self.rest is not None and self.rest.certain else None


class VideoFollower:
    """Watches the frames of a video, in turn, and follows the bar in them."""

    def __init__(self, config: RulerVideoConfig) -> None:
        """Prepare. Raises ConfigError, and FormatError for a background that is no picture."""
        self.detector = BarDetector(config.camera)
        self.tracker = RulerTracker(config.ruler)
        self._config, self._watcher = config, Watcher(self.detector)
        self._rest: Rest | None = None
        self._due = 0
        """From which stamp [ns] on the rest is predicted again."""

    def see(self, frame: Frame) -> Seen:
        """Take the next frame. Raises ConfigError for a picture that the camera does not fit."""
        sighting, tracker = self._watcher.see(frame), self.tracker
        outcome = tracker.step(frame.stamp, sighting.z).outcome
        if not tracker.started:
            self._rest = None
            return Seen(frame, sighting, outcome)
        if outcome in ('started', 'restarted'):
            self._rest, self._due = None, frame.stamp
        if frame.stamp >= self._due:
            self._due = frame.stamp + round(NANOSECONDS * self._config.video.stop_period)
            self._rest = self._predicted(frame.stamp)
        known = tracker.belief, tracker.ruler, tracker.state
        return Seen(frame, sighting, outcome, *known, self._rest)

    def _predicted(self, stamp: int) -> Rest | None:
        if self._far_from_known():
            return None
        try:
            stop = self.tracker.stop()
        except UncertainError:
            return None
        time = stamp / NANOSECONDS + stop.time
        if self._rest is not None and self.tracker.resting:  # since when is known from before
            time = min(time, self._rest.time)
        return Rest(stamp, time, stop, self.tracker.certain(stop))

    def _far_from_known(self) -> bool:
        """Whether the way to go is so unsure by the friction alone that it need not be run.

        A bar that only slides goes v^2 / (2 mu g). Where friction may be next to none, the model
        would run for as long as it may, and for nothing.
        """
        belief, config = self.tracker.belief, self._config.ruler
        mu, variance = belief.mean[MU], belief.cov[MU, MU]
        square = (belief.mean[SPEED] ** 2 + belief.cov[SPEED, SPEED]).sum()
        unsure = square / (2.0 * mu * config.g) * np.sqrt(variance) / mu
        return bool(unsure > FAR * config.stop_position)
