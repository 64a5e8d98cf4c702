"""What `evaluate` compares: the tracker, and the simple methods that it has to beat."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import NamedTuple, Protocol

import numpy as np

from cloth_predict.config import Config
from cloth_predict.filters.kinematic import KinematicTrack
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import BoolArray, FloatArray


class Predicted(NamedTuple):
    """Where markers will be: position [m], shape (markers, 3), NaN where unknown.

    sigma [m], shape (markers,): standard deviation of a coordinate, NaN where the method has none.
    """

    position: FloatArray
    sigma: FloatArray

    @classmethod
    def unknown(cls, markers: int) -> Predicted:
        """Nothing is known of any marker."""
        return cls(np.full((markers, 3), np.nan), np.full(markers, np.nan))


class Predictor(Protocol):
    """Something that follows markers and says where they will be."""

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> float:
        """Take a frame: stamp [ns], positions [m], shape (markers, 3), visible, (markers,).

        Returns the normalised innovation squared per degree of freedom, or NaN.
        """

    def predict(self, horizon: float) -> Predicted:
        """Return the markers `horizon` [s] after the last frame."""


class Hold:
    """The last position seen of each marker."""

    def __init__(self, config: Config) -> None:
        self._last = Predicted.unknown(config.model.count)

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> float:
        """Take a frame."""
        latest = np.where(visible[:, None], positions, self._last.position)
        self._last = self._last._replace(position=latest)
        return nan

    def predict(self, horizon: float) -> Predicted:
        """Return the positions last seen."""
        return self._last


class Kinematic:
    """One kinematic Kalman filter per marker."""

    def __init__(self, config: Config, motion: str, density: float) -> None:
        self._config, self._motion, self._density = config, motion, density
        self._tracks: dict[int, KinematicTrack] = {}
        self._stamp: int | None = None
        self._nodes = config.model.count

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> float:
        """Take a frame."""
        dt = 0.0 if self._stamp is None else (stamp - self._stamp) / NANOSECONDS
        self._stamp = stamp
        for track in self._tracks.values():
            track.predict(dt)
        for marker in np.flatnonzero(visible).tolist():
            if marker in self._tracks:
                self._tracks[marker].update(positions[marker])
            else:
                self._tracks[marker] = KinematicTrack(
                    self._motion,
                    self._density,
                    self._config.filter.measurement_noise,
                    positions[marker],
                )
        return nan

    def predict(self, horizon: float) -> Predicted:
        """Extrapolate each marker that was ever seen."""
        predicted = Predicted.unknown(self._nodes)
        for marker, track in self._tracks.items():
            predicted.position[marker] = track.extrapolate(horizon)[0]
            predicted.sigma[marker] = track.variance(horizon) ** 0.5
        return predicted


class Tracked:
    """The tracker of the configuration."""

    def __init__(self, config: Config) -> None:
        self._tracker = Tracker(config)

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> float:
        """Take a frame."""
        learnt = self._tracker.step(stamp, positions, visible).innovation
        if learnt is None or not learnt.residual.size:
            return nan
        return learnt.nis / len(learnt.residual)

    def predict(self, horizon: float) -> Predicted:
        """Return what the tracker predicts."""
        if not self._tracker.started:
            return Predicted.unknown(self._tracker.nodes)
        surface = self._tracker.predict(horizon)
        return Predicted(surface.position, surface.sigma)


METHODS: dict[str, Callable[[Config], Predictor]] = {
    'hold': Hold,
    'kf_cv': lambda c: Kinematic(c, 'constant_velocity', c.baseline.cv_noise),
    'kf_ca': lambda c: Kinematic(c, 'constant_acceleration', c.baseline.ca_noise),
    'ekf': Tracked,
}
"""What `evaluate` compares; a new method is one entry."""
