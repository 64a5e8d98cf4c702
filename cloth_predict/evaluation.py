"""Compares predictors on one recording: the same frames and markers for every method."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import isnan
from typing import Protocol

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.filters.kinematic import KinematicTrack
from cloth_predict.metrics import Score, at_times, distances, score
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

WARM_UP = 1.0
"""Seconds at the start that are not judged."""


class Predictor(Protocol):
    """Something that follows markers and says where they will be."""

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> object:
        """Take a frame: stamp [ns], positions [m], shape (markers, 3), visible, (markers,)."""

    def positions(self, horizon: float) -> FloatArray:
        """Positions [m], shape (markers, 3), `horizon` [s] after the last frame, or NaN."""


class Hold:
    """The last position seen of each marker."""

    def __init__(self, config: Config) -> None:
        self._last = np.full((config.model.rows * config.model.cols, 3), np.nan)

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> None:
        """Take a frame."""
        self._last = np.where(visible[:, None], positions, self._last)

    def positions(self, horizon: float) -> FloatArray:
        """Positions last seen [m], shape (markers, 3)."""
        return self._last


class Kinematic:
    """One kinematic Kalman filter per marker."""

    def __init__(self, config: Config, motion: str, density: float) -> None:
        self._config, self._motion, self._density = config, motion, density
        self._tracks: dict[int, KinematicTrack] = {}
        self._stamp: int | None = None
        self._nodes = config.model.rows * config.model.cols

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> None:
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

    def positions(self, horizon: float) -> FloatArray:
        """Extrapolated positions [m], shape (markers, 3)."""
        predicted = np.full((self._nodes, 3), np.nan)
        for marker, track in self._tracks.items():
            predicted[marker] = track.extrapolate(horizon)[0]
        return predicted


class Tracked:
    """The tracker of the configuration."""

    def __init__(self, config: Config) -> None:
        self._tracker = Tracker(config)

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> None:
        """Take a frame."""
        self._tracker.step(stamp, positions, visible)

    def positions(self, horizon: float) -> FloatArray:
        """Predicted positions [m], shape (markers, 3)."""
        if not self._tracker.started:
            return np.full((self._tracker.nodes, 3), np.nan)
        return self._tracker.predict(horizon).position


METHODS: dict[str, Callable[[Config], Predictor]] = {
    'hold': Hold,
    'kf_cv': lambda c: Kinematic(c, 'constant_velocity', c.baseline.cv_noise),
    'kf_ca': lambda c: Kinematic(c, 'constant_acceleration', c.baseline.ca_noise),
    'ekf': Tracked,
}
"""What `evaluate` compares; a new method is one entry."""


@dataclass(frozen=True)
class Evaluation:
    """The comparison at one horizon.

    errors [m] by method, shape (frames, markers), NaN where not counted; targets [ns], shape
    (frames,): the times predicted for; actual [m] and predicted [m] by method, each
    (frames, markers, 3).
    """

    horizon: float
    scores: dict[str, Score]
    us_per_frame: dict[str, float]
    errors: dict[str, FloatArray]
    targets: IntArray
    actual: FloatArray
    predicted: dict[str, FloatArray]

    def summary(self) -> dict[str, object]:
        """Return the numbers as `evaluate --json` prints them."""
        return {
            'horizon_s': self.horizon,
            'frames': len(self.targets),
            'methods': {
                name: {
                    **{k: None if isnan(v) else v for k, v in vars(found).items()},
                    'us_per_frame': self.us_per_frame[name],
                }
                for name, found in self.scores.items()
            },
        }


def evaluate(
    markers: MarkerSequence,
    config: Config,
    horizon: float,
    reference: MarkerSequence | None = None,
    methods: dict[str, Callable[[Config], Predictor]] | None = None,
    progress: Callable[[int], None] = lambda frames: None,
    source: str = 'the recording',
) -> Evaluation:
    """Run every method over the recording and judge its predictions `horizon` [s] ahead.

    The reference is what the positions are compared with: the truth where there is one, or else
    the markers themselves. Markers must be in node order.
    """
    markers = in_order(markers)
    predicted, seconds = {}, {}
    for name, make in (METHODS if methods is None else methods).items():
        predicted[name], seconds[name] = predict_all(make(config), markers, horizon, progress)
    return judge(markers, config, horizon, reference or markers, predicted, seconds, source)


def judge(
    markers: MarkerSequence,
    config: Config,
    horizon: float,
    reference: MarkerSequence,
    predicted: dict[str, FloatArray],
    seconds: dict[str, float],
    source: str = 'the recording',
) -> Evaluation:
    """Compare predictions made at each frame of `markers`, (frames, markers, 3), with a reference.

    Only what every method predicted and the reference shows is counted. Raises FormatError naming
    the source where that is nothing.
    """
    targets = markers.stamps + round(horizon * NANOSECONDS)
    actual, counted = at_times(reference, targets)
    counted &= (markers.stamps >= markers.stamps[0] + WARM_UP * NANOSECONDS)[:, None]
    for positions in predicted.values():
        counted &= np.isfinite(positions).all(axis=-1)
    judged = counted.any(axis=1)
    if not judged.any():
        raise FormatError(
            f'{source}: no frame can be judged: the recording lasts '
            f'{(markers.stamps[-1] - markers.stamps[0]) / NANOSECONDS:.2f} s, of which the first '
            f'{WARM_UP} s are the warm-up and the last {horizon} s have no later measurement'
        )
    free = np.ones(len(markers.labels), bool)
    free[list(config.anchors.nodes)] = False
    errors = {n: np.where(counted, distances(p, actual), np.nan) for n, p in predicted.items()}
    return Evaluation(
        horizon,
        {name: score(e, counted, free) for name, e in errors.items()},
        {name: 1e6 * s / len(markers) for name, s in seconds.items()},
        {name: e[judged] for name, e in errors.items()},
        targets[judged],
        actual[judged],
        {name: p[judged] for name, p in predicted.items()},
    )


def in_order(markers: MarkerSequence) -> MarkerSequence:
    """Leave out frames whose stamp does not lie after all stamps before it."""
    latest = np.maximum.accumulate(markers.stamps)
    keep = np.append(True, markers.stamps[1:] > latest[:-1])
    if keep.all():
        return markers
    return MarkerSequence(
        markers.stamps[keep],
        markers.labels,
        markers.positions[keep],
        markers.visible[keep],
        markers.frame_id,
    )


def predict_all(
    predictor: Predictor,
    markers: MarkerSequence,
    horizon: float,
    progress: Callable[[int], None] = lambda frames: None,
) -> tuple[FloatArray, float]:
    """Predictions [m] after each frame, (frames, markers, 3), and the seconds it took."""
    predicted = np.empty(markers.positions.shape)
    begin = time.perf_counter()
    for k, stamp in enumerate(markers.stamps.tolist()):
        predictor.step(stamp, markers.positions[k], markers.visible[k])
        predicted[k] = predictor.positions(horizon)
        progress(1)
    return predicted, time.perf_counter() - begin
