"""The whole method, and its only state: what is believed of the surface, and when."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from cloth_predict.bodies.follower import BodyFollower
from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.surface.topology import NO_TRIANGLES
from cloth_predict.tracking.follower import Follower
from cloth_predict.tracking.limits import Health, judge, require_certain
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.rewind import Entry, Memory
from cloth_predict.tracking.settling import Rest
from cloth_predict.tracking.sheet import SheetFollower
from cloth_predict.tracking.track import Frame, Step
from cloth_predict.types import Belief, BoolArray, FloatArray, IntArray, Surface

__all__ = ['NANOSECONDS', 'Step', 'Tracker']

FARTHEST = 1e4
"""Coordinate [m] from which on a marker is taken for a fault: no volume is that large."""
NO_POINTS = np.zeros((0, 3))


class Tracker:
    """Follows a surface through frames of markers and predicts it.

    Label i is node i of a surface of springs; a body attaches each label to a node of its own.

    counts: frames by outcome (see `Step`), and how often the covariance was `repaired`, and the
    surface started anew because it had `diverged` or was `lost` (its markers were elsewhere);
    markers: markers by what they were taken for (see `Step.markers`).
    """

    def __init__(self, config: Config) -> None:
        """Prepare; the surface starts with the first frames that show enough of it."""
        self.config = config
        self.nodes = config.model.count
        self.counts: Counter[str] = Counter()
        self.markers: Counter[str] = Counter()
        self._memory: Memory[Any] | None = None
        kind = BodyFollower if config.model.is_body else SheetFollower
        self._kind: Follower[Any] = kind(config)
        self._offered: int | None = None
        self._sigma: float | None = None

    @property
    def started(self) -> bool:
        """Whether there is a surface to predict."""
        return self._memory is not None

    @property
    def triangles(self) -> IntArray:
        """Triangles of markers, shape (t, 3); none before the start, nor of a chain."""
        return self._memory.latest.track.triangles if self._memory else NO_TRIANGLES

    @property
    def edges(self) -> IntArray:
        """Neighbours among the nodes, shape (edges, 2). Raises FrameError before the start."""
        return self._kind.edges(self._track())

    @property
    def belief(self) -> Belief:
        """What the filter believes of the state, after the last frame."""
        belief: Belief = self._track().belief
        return belief

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
        self._check(positions, visible, points)
        frame = Frame(stamp, positions.copy(), visible.copy(), points.copy())
        step = self._advance(frame)
        self.counts[step.outcome] += 1
        return step

    def estimate(self) -> Surface:
        """Return the surface at the last frame."""
        return self._kind.estimate(self._track())

    def loads(self) -> FloatArray | None:
        """Return the unknown force [N] on the part of each node, (nodes, 3), as it is believed.

        None where the state has none. Raises FrameError before the start.
        """
        return self._kind.loads(self._track())

    def predict(self, horizon: float) -> Surface:
        """Return the surface `horizon` [s] after the last frame, by running the model there.

        Raises FrameError where there is no surface yet, or none that is finite, and its kind
        UncertainError where sigma is above `limits.sigma_error`.
        """
        self._sigma = None
        found, self._sigma = self._kind.predict(self._track(), horizon)
        require_certain(self._sigma, self.config.limits)
        return found

    def rest(self) -> Rest:
        """Return when and in which shape the motion ends, by the parameters `rest.`.

        Raises FrameError where there is no surface yet, or none of springs, and its kind
        UncertainError where no end is in sight.
        """
        return self._kind.rest(self._track())

    def health(self) -> Health:
        """How well the surface is known: by the last prediction, and the markers in view."""
        if self._memory is None:
            return Health('WARN', f'no surface yet: {self._kind.reason}')
        if self._sigma is None:
            try:
                _, self._sigma = self._kind.predict(self._track(), self.config.horizon)
            except FrameError as error:
                return Health('ERROR', str(error))
        return judge(self._sigma, self._memory.latest.step, self.config.limits)

    def _check(self, positions: FloatArray, visible: BoolArray, points: FloatArray) -> None:
        if positions.shape != (self.nodes, 3) or visible.shape != (self.nodes,):
            model = self.config.model
            raise FrameError(
                f'positions {positions.shape} and visible {visible.shape}, but '
                f'{model.counted_by} has {model.name}'
            )
        if points.ndim != 2 or points.shape[1] != 3:
            raise FrameError(f'points have shape {points.shape}, expected (m, 3)')
        for what, places, used in (
            ('marker', positions, visible),
            ('point', points, np.ones(len(points), bool)),
        ):
            bad = used & ~(np.abs(places) < FARTHEST).all(axis=1)
            if bad.any():
                raise FrameError(
                    f'{what} {int(bad.argmax())} has a coordinate that is not finite, or beyond '
                    f'{FARTHEST:g} m'
                )

    def _advance(self, frame: Frame) -> Step:
        memory = self._memory
        latest = memory.latest.track.stamp if memory else self._offered
        dt = 0.0 if latest is None else (frame.stamp - latest) / NANOSECONDS
        if dt > self.config.filter.max_gap or dt < -self.config.filter.max_backstep:
            return self._restart(frame)
        if memory is None:
            return self._start(frame, 'started') if latest is None or dt > 0 else _unused(frame)
        if dt <= 0:
            return self._late(memory, frame)
        try:
            track, step = self._kind.follow(memory.latest.track, frame)
        except FloatingPointError:
            self.counts['diverged'] += 1
            return self._restart(frame)
        found = self._kind.recover(memory.latest.track, track, frame)
        if found is not None:
            self.counts['lost'] += 1
            return self._begin(*found, frame, 'restarted')
        memory.add(Entry(frame, track, step))
        self._count(step, 1)
        return step

    def _late(self, memory: Memory[Any], frame: Frame) -> Step:
        """Put a late frame in its place, where it is not too late and not there already."""
        place = memory.place(frame.stamp)
        if memory.holds(frame.stamp):
            return _unused(frame, 'duplicate')
        if place is None:
            return _unused(frame, 'late')
        try:
            before, after = memory.insert(place, frame, self._kind.follow)
        except FloatingPointError:
            return _unused(frame, 'late')
        for entry in before:
            self._count(entry.step, -1)
        for entry in after:
            self._count(entry.step, 1)
        return replace(after[0].step, outcome='rewound')

    def _restart(self, frame: Frame) -> Step:
        outcome = 'restarted' if self._memory else 'started'
        self._memory, self._sigma = None, None
        return self._start(frame, outcome)

    def _start(self, frame: Frame, outcome: str) -> Step:
        self._offered = frame.stamp
        found = self._kind.start(frame)
        if found is None:
            seen = np.where(frame.visible[:, None], frame.positions, np.nan)
            return Step('waiting', seen, frame.visible)
        return self._begin(*found, frame, outcome)

    def _begin(self, track: Any, step: Step, frame: Frame, outcome: str) -> Step:
        self._memory = Memory(self.config.filter.rewind, Entry(frame, track, step))
        self._count(step, 1)
        return replace(step, outcome=outcome)

    def _count(self, step: Step, sign: int) -> None:
        for name, number in step.markers.items():
            self.markers[name] += sign * number
        if step.repairs:
            self.counts['repaired'] += sign * step.repairs

    def _track(self) -> Any:
        if self._memory is None:
            raise FrameError(f'no surface yet: {self._kind.reason}')
        return self._memory.latest.track


def _unused(frame: Frame, outcome: str = 'late') -> Step:
    """Step of a frame that changes nothing."""
    return Step(outcome, np.full_like(frame.positions, np.nan), np.zeros_like(frame.visible))
