"""The whole method, and its only state: what is believed of the surface, and when."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import ceil

import numpy as np

from cloth_predict.assembly import (
    build_mass_spring,
    complete,
    disturbed,
    first_belief,
    process_noise,
)
from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.kinematic import KinematicTrack
from cloth_predict.integrators import INTEGRATORS
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import BoolArray, FloatArray, Gaussian, Innovation, IntArray, Surface

NANOSECONDS = 1e9
FARTHEST = 1e4
"""Coordinate [m] from which on a marker is taken for a fault: no volume is that large."""
FEWEST_TO_START = 3
"""Visible nodes without which the first surface would be a guess."""


@dataclass(frozen=True)
class Step:
    """What became of a frame: `updated`, `started`, `restarted`, `waiting` or `late`."""

    outcome: str
    innovation: Innovation | None = None


class Tracker:
    """Follows a surface through frames of markers and predicts it; marker i is node i."""

    def __init__(self, config: Config) -> None:
        """Prepare; the surface starts with the first frame that shows enough of it."""
        self.config = config
        self.nodes = config.model.rows * config.model.cols
        self.counts: Counter[str] = Counter()
        self._stamp: int | None = None
        self._belief: Gaussian | None = None
        self._filter = ExtendedKalmanFilter(INTEGRATORS[config.filter.integrator])

    @property
    def started(self) -> bool:
        """Whether there is a surface to predict."""
        return self._belief is not None

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> Step:
        """Take a frame: stamp [ns], positions [m], shape (nodes, 3), visible, shape (nodes,).

        Raises FrameError, and changes nothing, where the frame does not fit the model.
        """
        self._check(positions, visible)
        step = self._advance(stamp, positions, visible)
        self.counts[step.outcome] += 1
        return step

    def estimate(self) -> Surface:
        """Return the surface at the last frame."""
        belief, rows = self._started_belief(), self._position_rows()
        return self._surface(belief.mean, np.diagonal(belief.cov)[rows], 0.0)

    def predict(self, horizon: float) -> Surface:
        """Return the surface `horizon` [s] after the last frame, by running the model there.

        Raises FrameError where there is no surface yet, or none that is finite.
        """
        belief = self._started_belief()
        steps, dt = split(horizon, self.config.filter.predict_step)
        inputs = [self._input(k * dt, dt) for k in range(steps)]
        try:
            mean, variance = self._filter.forecast(
                belief, self._model, inputs, self._noise, dt, self._position_rows()
            )
        except FloatingPointError as error:
            raise FrameError(f'the prediction fails: {error}') from None
        if not (np.isfinite(mean).all() and np.isfinite(variance).all()):
            raise FrameError('the prediction is not finite: the model is too stiff for the step')
        return self._surface(mean, variance, horizon)

    def _check(self, positions: FloatArray, visible: BoolArray) -> None:
        if positions.shape != (self.nodes, 3) or visible.shape != (self.nodes,):
            raise FrameError(
                f'positions {positions.shape} and visible {visible.shape}, but model.rows x '
                f'model.cols has {self.nodes} nodes'
            )
        bad = visible & ~(np.abs(positions) < FARTHEST).all(axis=1)
        if bad.any():
            raise FrameError(
                f'marker {int(bad.argmax())} has a coordinate that is not finite, or beyond '
                f'{FARTHEST:g} m'
            )

    def _advance(self, stamp: int, positions: FloatArray, visible: BoolArray) -> Step:
        if self._stamp is None or self._belief is None:
            return self._start(stamp, positions, visible, 'started')
        dt = (stamp - self._stamp) / NANOSECONDS
        if dt > self.config.filter.max_gap or dt < -self.config.filter.max_backstep:
            return self._start(stamp, positions, visible, 'restarted')
        if dt <= 0:
            return Step('late')
        try:
            innovation = self._update(positions, visible, dt)
        except FloatingPointError:
            self.counts['diverged'] += 1
            return self._start(stamp, positions, visible, 'restarted')
        self._stamp = stamp
        return Step('updated', innovation)

    def _start(self, stamp: int, positions: FloatArray, visible: BoolArray, outcome: str) -> Step:
        self._stamp = self._belief = None
        config, driven = self.config, list(self.config.anchors.nodes)
        if visible.sum() < min(FEWEST_TO_START, self.nodes) or not visible[driven].all():
            return Step('waiting')
        filled, spread = complete(config.model, positions, visible)
        self._mesh = build_mass_spring(config, filled)
        self._model = disturbed(config, self._mesh)
        self._noise = process_noise(config, self._mesh)
        self._tracks = [
            KinematicTrack(
                config.anchors.motion,
                config.anchors.process_noise,
                config.filter.measurement_noise,
                filled[node],
                config.filter.initial_velocity,
            )
            for node in self._mesh.driven
        ]
        self._belief = first_belief(config, self._mesh, filled, spread)
        self._stamp = stamp
        return Step(outcome)

    def _update(self, positions: FloatArray, visible: BoolArray, dt: float) -> Innovation:
        belief = self._started_belief()
        for node, track in zip(self._mesh.driven, self._tracks, strict=True):
            track.predict(dt)
            if visible[node]:
                track.update(positions[node])
        steps, part = split(dt, self.config.filter.max_step)
        for k in range(steps):
            u = self._input(k * part - dt, part)
            belief = self._filter.predict(belief, self._model, u, self._noise, part)
        seen = np.flatnonzero(visible[self._mesh.free])
        obs = VisiblePositions.of_nodes(seen, self.config.filter.measurement_noise)
        z = positions[self._mesh.free[seen]].ravel()
        belief, innovation = self._filter.update(belief, obs, z)
        if not np.isfinite(belief.mean).all():
            raise FloatingPointError('the estimate is not finite')
        self._belief = belief
        return innovation

    def _input(self, ahead: float, dt: float = 0.0) -> FloatArray:
        """Input at `ahead` [s] after the last frame, with the mean velocities over dt [s] then."""
        if not self._tracks:
            return self._mesh.input()
        now = np.array([track.extrapolate(ahead) for track in self._tracks])
        if not dt:
            return self._mesh.input(now[:, 0], now[:, 1])
        then = np.array([track.extrapolate(ahead + dt)[0] for track in self._tracks])
        return self._mesh.input(now[:, 0], (then - now[:, 0]) / dt)

    def _started_belief(self) -> Gaussian:
        if self._belief is None:
            raise FrameError('no surface yet: not enough markers have been seen')
        return self._belief

    def _position_rows(self) -> IntArray:
        return np.arange(3 * len(self._mesh.free))

    def _surface(self, mean: FloatArray, variance: FloatArray, ahead: float) -> Surface:
        mesh, u = self._mesh, self._input(ahead)
        size = 3 * len(mesh.free)
        position, velocity = mesh.surface(mean, u)
        acceleration, sigma = np.zeros((self.nodes, 3)), np.zeros(self.nodes)
        acceleration[mesh.free] = self._model.f(mean, u)[size : 2 * size].reshape(-1, 3)
        sigma[mesh.free] = np.sqrt(np.maximum(variance.reshape(-1, 3).mean(axis=1), 0.0))
        for node, track in zip(mesh.driven, self._tracks, strict=True):
            acceleration[node] = track.extrapolate(ahead)[2]
            sigma[node] = track.variance(ahead) ** 0.5
        assert self._stamp is not None
        return Surface(
            self._stamp + round(ahead * NANOSECONDS), position, velocity, acceleration, sigma
        )


def split(duration: float, longest: float) -> tuple[int, float]:
    """Number and length [s] of equal steps no longer than `longest` [s], but for rounding."""
    steps = ceil(duration / longest - 1e-6)
    return steps, duration / max(steps, 1)
