"""The whole method, and its only state: what is believed of the surface, and when."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.observations import VisiblePositions
from cloth_predict.starting import Start, Starter
from cloth_predict.types import BoolArray, FloatArray, Innovation, IntArray, Surface

NANOSECONDS = 1e9
FARTHEST = 1e4
"""Coordinate [m] from which on a marker is taken for a fault: no volume is that large."""


NO_POINTS = np.zeros((0, 3))


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
        self.nodes = config.model.count
        self.counts: Counter[str] = Counter()
        self._stamp: int | None = None
        self._now: Start | None = None

    @property
    def started(self) -> bool:
        """Whether there is a surface to predict."""
        return self._now is not None

    def step(
        self,
        stamp: int,
        positions: FloatArray,
        visible: BoolArray,
        points: FloatArray = NO_POINTS,
    ) -> Step:
        """Take a frame: stamp [ns], positions [m], shape (nodes, 3), visible, shape (nodes,).

        points [m], shape (m, 3): markers without a label.
        Raises FrameError, and changes nothing, where the frame does not fit the model.
        """
        self._check(positions, visible)
        step = self._advance(stamp, positions, visible, points)
        self.counts[step.outcome] += 1
        return step

    def estimate(self) -> Surface:
        """Return the surface at the last frame."""
        now = self._started()
        return self._surface(now.belief.mean, now.belief.marginals(_rows(now)), 0.0)

    def predict(self, horizon: float) -> Surface:
        """Return the surface `horizon` [s] after the last frame, by running the model there.

        Raises FrameError where there is no surface yet, or none that is finite.
        """
        now = self._started()
        steps, dt = split(horizon, self.config.filter.predict_step)
        inputs = _inputs(now, 0.0, steps, dt)
        try:
            mean, cov = now.filter.forecast(
                now.belief, now.model, inputs, now.noise, dt, _rows(now)
            )
        except FloatingPointError as error:
            raise FrameError(f'the prediction fails: {error}') from None
        if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
            raise FrameError('the prediction is not finite: the model is too stiff for the step')
        return self._surface(mean, cov, horizon)

    def _check(self, positions: FloatArray, visible: BoolArray) -> None:
        if positions.shape != (self.nodes, 3) or visible.shape != (self.nodes,):
            raise FrameError(
                f'positions {positions.shape} and visible {visible.shape}, but '
                f'{self.config.model.counted_by} has {self.nodes} nodes'
            )
        bad = visible & ~(np.abs(positions) < FARTHEST).all(axis=1)
        if bad.any():
            raise FrameError(
                f'marker {int(bad.argmax())} has a coordinate that is not finite, or beyond '
                f'{FARTHEST:g} m'
            )

    def _advance(
        self, stamp: int, positions: FloatArray, visible: BoolArray, points: FloatArray
    ) -> Step:
        if self._stamp is None or self._now is None:
            return self._start(stamp, positions, visible, points, 'started')
        dt = (stamp - self._stamp) / NANOSECONDS
        if dt > self.config.filter.max_gap or dt < -self.config.filter.max_backstep:
            return self._start(stamp, positions, visible, points, 'restarted')
        if dt <= 0:
            return Step('late')
        try:
            innovation = self._update(positions, visible, dt)
        except FloatingPointError:
            self.counts['diverged'] += 1
            return self._start(stamp, positions, visible, points, 'restarted')
        self._stamp = stamp
        return Step('updated', innovation)

    def _start(
        self,
        stamp: int,
        positions: FloatArray,
        visible: BoolArray,
        points: FloatArray,
        outcome: str,
    ) -> Step:
        self._now = Starter(self.config).offer(stamp, positions, visible, points)
        self._stamp = stamp if self._now else None
        return Step(outcome if self._now else 'waiting')

    def _update(self, positions: FloatArray, visible: BoolArray, dt: float) -> Innovation:
        now = self._started()
        driven, belief = now.driven.copy(), now.belief
        driven.advance(dt)
        driven.update(positions, visible)
        now = replace(now, driven=driven)
        steps, part = split(dt, self.config.filter.max_step)
        for u in _inputs(now, -dt, steps, part):
            belief = now.filter.predict(belief, now.model, u, now.noise, part)
        seen = np.flatnonzero(visible[now.mesh.free])
        obs = VisiblePositions.of_nodes(seen, self.config.filter.measurement_noise)
        z = positions[now.mesh.free[seen]].ravel()
        belief, innovation = now.filter.update(belief, obs, z)
        if not np.isfinite(belief.mean).all():
            raise FloatingPointError('the estimate is not finite')
        self._now = replace(now, belief=belief)
        return innovation

    def _started(self) -> Start:
        if self._now is None:
            raise FrameError('no surface yet: not enough markers have been seen')
        return self._now

    def _surface(self, mean: FloatArray, cov: FloatArray, ahead: float) -> Surface:
        now = self._started()
        mesh, size = now.mesh, 3 * len(now.mesh.free)
        driven = now.driven.extrapolate(ahead)
        u = mesh.input(driven[0], driven[1])
        position, velocity = mesh.surface(mean, u)
        acceleration, covariance = np.zeros((self.nodes, 3)), np.zeros((self.nodes, 3, 3))
        acceleration[mesh.free] = now.model.f(mean, u)[size : 2 * size].reshape(-1, 3)
        acceleration[mesh.driven] = driven[2]
        covariance[mesh.free] = cov
        covariance[mesh.driven] = now.driven.variances(ahead)[:, None, None] * np.eye(3)
        assert self._stamp is not None
        return Surface(
            self._stamp + round(ahead * NANOSECONDS), position, velocity, acceleration, covariance
        )


def _rows(now: Start) -> IntArray:
    """Position rows of the state by free node, shape (free, 3)."""
    return np.arange(3 * len(now.mesh.free)).reshape(-1, 3)


def _inputs(now: Start, begin: float, steps: int, dt: float) -> list[FloatArray]:
    """Input of each of `steps` steps of dt [s], the first `begin` [s] after the last frame."""
    if not steps:
        return []
    path = now.driven.path([begin + k * dt for k in range(steps + 1)])
    return [now.mesh.input(position, velocity) for position, velocity in path]


def split(duration: float, longest: float) -> tuple[int, float]:
    """Number and length [s] of equal steps no longer than `longest` [s], but for rounding."""
    steps = ceil(duration / longest - 1e-6)
    return steps, duration / max(steps, 1)
