"""A sliding bar as a recording of markers, its two ends, and what comes next of them."""

from __future__ import annotations

import numpy as np

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.models.ruler import SPIN, VELOCITY
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.ruler import NO_INPUT, RulerTracker
from cloth_predict.tracking.ruler_assembly import ANGLE, MEASURED, STATES
from cloth_predict.tracking.track import Step
from cloth_predict.types import BoolArray, FloatArray, IntArray, Surface

ENDS = ('end 1', 'end 2')
"""Labels of the ends: behind the centre and before it."""
SIDES = np.array([-0.5, 0.5])
"""Where the ends are along the bar, by its length."""
LENGTH = STATES.index('L')


def ends_of(z: FloatArray) -> FloatArray:
    """Places of both ends [m], shape (2, 3), of a bar z = [x_G, y_G, L, alpha]; z is up, and 0."""
    place = np.zeros((2, 3))
    along = np.array([np.cos(z[ANGLE]), np.sin(z[ANGLE])])
    place[:, :2] = z[:2] + SIDES[:, None] * z[LENGTH] * along
    return place


def bar_between(ends: FloatArray) -> FloatArray:
    """Return the bar z = [x_G, y_G, L, alpha] with these ends [m], shape (2, 3)."""
    x, y = ends[1, :2] - ends[0, :2]
    return np.array([*ends[:, :2].mean(axis=0), np.hypot(x, y), np.arctan2(y, x)])


class BarExpectation:
    """Expects the ends of a bar where its tracker predicts them from the rebuilt ones.

    Before there is a bar, they go on as they moved between the last two frames.
    """

    nodes = ENDS
    shape = (1, 2)
    """Rows and columns of the states."""

    def __init__(self, config: RulerConfig, step: float) -> None:
        """Prepare; step [m], of which rebuilt coordinates are multiples."""
        self._tracker, self._step = RulerTracker(config), step
        self._last = self._before = np.zeros((2, 3), np.int64)
        self._known = self._moving = False

    def at(self, stamp: int) -> FloatArray:
        """Multiples of the step that are expected at a stamp [ns], shape (2, 3)."""
        on = self._last - self._before if self._moving else 0
        expected = (self._last + on).astype(float)
        dt = (stamp - self._tracker.stamp) / NANOSECONDS
        if not self._tracker.started or not 0 < dt <= self._tracker.config.max_gap:
            return expected
        bar = self._tracker.predict(dt).mean[MEASURED]
        ends = ends_of(bar) / self._step
        # the tracker may know the angle but for half turns
        swapped = np.abs(ends[::-1] - expected).sum() < np.abs(ends - expected).sum()
        return ends[::-1] if swapped else ends

    def take(self, stamp: int, multiples: IntArray, visible: BoolArray) -> Step:
        """Take the rebuilt ends: multiples of the step, (2, 3), where visible, (2,)."""
        seen = bool(visible.all())
        self._moving = seen and self._known
        self._known = seen
        if seen:
            self._before, self._last = self._last, multiples
        positions = np.where(visible[:, None], multiples * self._step, np.nan)
        step = self._tracker.step(stamp, bar_between(positions) if seen else None)
        return Step(step.outcome, positions, visible)

    def estimate(self) -> Surface | None:
        """Return what the filter makes of the ends in the last frame; None before there is a bar.

        Its covariance is that of first order.
        """
        tracker = self._tracker
        if not tracker.started:
            return None
        mean, cov = tracker.belief.mean, tracker.belief.cov
        alpha, state = mean[ANGLE], tracker.state
        motion = tracker.ruler.f(state, NO_INPUT)
        along = np.array([np.cos(alpha), np.sin(alpha), 0.0])
        across = np.array([-along[1], along[0], 0.0])
        side = SIDES[:, None] * mean[LENGTH]
        jac = np.zeros((2, 3, len(MEASURED)))
        jac[:, [0, 1], [0, 1]] = 1.0
        jac[:, :, LENGTH] = SIDES[:, None] * along
        jac[:, :, ANGLE] = side * across
        velocity, acceleration = np.zeros((2, 3)), np.zeros((2, 3))
        velocity[:, :2], acceleration[:, :2] = state[VELOCITY], motion[VELOCITY]
        velocity += side * state[SPIN] * across
        acceleration += side * (motion[SPIN] * across - state[SPIN] ** 2 * along)
        known = cov[np.ix_(MEASURED, MEASURED)]
        covariance = jac @ known @ jac.transpose(0, 2, 1)
        position = ends_of(mean[MEASURED])
        return Surface(tracker.stamp, position, velocity, acceleration, covariance)
