"""A sliding bar that is followed: its friction, and where it will come to rest."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.errors import FrameError
from cloth_predict.filters.sigma_points import SigmaPointFilter, moments
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import Ruler
from cloth_predict.tracking.limits import Health
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.ruler_assembly import (
    ANGLE,
    STATES,
    first_belief,
    joint_filter,
    joint_model,
    observation,
    process_noise,
    unwrapped,
)
from cloth_predict.tracking.stopping import Stop, at_rest
from cloth_predict.types import FloatArray, Gaussian, Innovation

NO_INPUT = np.zeros(0)
UNKNOWN = 0.5
"""Share of the first sigma of the friction above which nothing was learnt of it."""
MU = STATES.index('mu')
POSE = slice(0, 3)
"""Where the bar's own state has its pose."""


@dataclass(frozen=True)
class RulerStep:
    """What became of a frame.

    outcome: `started`, `updated`, `hidden` (no bar in it: carried on), `rejected` (not believed:
    carried on), `restarted` or `late` (changes nothing).
    """

    outcome: str
    innovation: Innovation | None = None


class RulerTracker:
    """Follows a bar through frames, by the joint filter of Goeller et al. 2015, section 3.3.

    counts: frames by outcome (see `RulerStep`), and how often they were filtered `again`.
    """

    def __init__(self, config: RulerConfig, prior: Gaussian | None = None) -> None:
        """Prepare; the bar starts with the first frame that shows it.

        prior: what is believed before that frame, instead of what the configuration says. Raises
        ConfigError for a first guess that is out of its bounds.
        """
        self.config = config
        self.model = joint_model(config)
        self.counts: Counter[str] = Counter()
        self.stamp = 0
        """When [ns] the last frame was."""
        self._prior = prior
        self._belief: Gaussian | None = None
        self._filter, self._noise = joint_filter(config), process_noise(config)
        self._observation = observation(config)
        self._taken: list[tuple[int, FloatArray]] = []
        self._unseen = self._refused = 0

    @property
    def started(self) -> bool:
        """Whether there is a bar."""
        return self._belief is not None

    @property
    def belief(self) -> Gaussian:
        """What is believed of the joint state after the last frame. Raises FrameError."""
        if self._belief is None:
            raise FrameError('no bar yet: no frame has shown one')
        return self._belief

    @property
    def ruler(self) -> Ruler:
        """The bar with the parameters that are believed."""
        return cast('Ruler', self.model.model_at(self.belief.mean))

    @property
    def resting(self) -> bool:
        """Whether the bar comes to rest within a step."""
        after = Sliding(self.config.step).step(self.ruler, self.state, NO_INPUT, self.config.step)
        return bool(self.ruler.resting(after))

    @property
    def state(self) -> FloatArray:
        """What is believed of the bar's own state, shape (6,)."""
        return np.asarray(self.belief.mean[self.model.own])

    def step(self, stamp: int, z: FloatArray | None) -> RulerStep:
        """Take a frame: stamp [ns], z = [x_G, y_G, L, alpha] [m, rad], or None without a bar.

        Raises FrameError, and changes nothing, for a measurement that is not finite.
        """
        if z is not None and not (np.shape(z) == (4,) and np.isfinite(z).all()):
            raise FrameError(f'a bar is centre, length and angle, four finite numbers, not {z}')
        found = self._advance(stamp, z)
        self.counts[found.outcome] += 1
        return found

    def predict(self, horizon: float) -> Gaussian:
        """Joint state `horizon` [s] after the last frame, by running the model there."""
        return self._filter.predict(self.belief, self.model, NO_INPUT, self._noise, horizon)

    def stop(self) -> Stop:
        """Where and when the bar comes to rest: pose [m, rad] with covariance, (3,) and (3, 3).

        By the points of the cubature filter, whose weights keep the covariance positive. Raises
        FrameError before the start, and UncertainError where there is no end in sight.
        """
        spread = SigmaPointFilter(Sliding(self.config.step), alpha=1.0, beta=0.0)
        points, *weights = spread.points(self.belief.mean, self.belief.cov)
        ruler, dt = cast('Ruler', self.model.model_at(points)), self.config.step
        times, ends = at_rest(
            points[:, self.model.own],
            lambda x: spread.integrator.step(ruler, x, NO_INPUT, dt),
            ruler.resting,
            dt,
            self.config.stop_after,
        )
        mean, cov = moments(np.column_stack([ends[:, POSE], times]), *weights)
        return Stop(float(mean[-1]), float(np.sqrt(cov[-1, -1])), mean[:-1], cov[:-1, :-1])

    def certain(self, stop: Stop) -> bool:
        """Whether a stop is known as well as the configuration asks for."""
        return stop.certain(self.config.stop_position, self.config.stop_angle)

    def health(self) -> Health:
        """How well the bar is known, in one line."""
        if self._belief is None:
            return Health('WARN', 'no bar yet: no frame has shown one')
        sigma = np.sqrt(self._belief.cov.diagonal())
        known = ', '.join(
            f'{STATES[i]} {self._belief.mean[i]:.3g} +- {sigma[i]:.2g}' for i in self.model.at
        )
        if self._unseen:
            return Health('WARN', f'no believable bar in the last {self._unseen} frames; {known}')
        if self.resting and sigma[MU] > UNKNOWN * self.config.mu_sigma:
            return Health('WARN', 'the bar lies still and has not slid: no friction can be told')
        return Health('OK', known)

    def _advance(self, stamp: int, z: FloatArray | None) -> RulerStep:
        if self._belief is None:
            return RulerStep('hidden') if z is None else self._start(stamp, z, 'started')
        if abs(stamp - self.stamp) > self.config.max_gap * NANOSECONDS:
            return self._anew(stamp, z)
        if stamp <= self.stamp:
            return RulerStep('late')
        try:
            belief, innovation, believed = self._filtered(self._belief, stamp - self.stamp, z)
        except FloatingPointError:
            return self._anew(stamp, z)
        if innovation is not None:
            self._refused = 0 if believed else self._refused + 1
        if self._refused > self.config.patience:
            return self._anew(stamp, z)
        self.stamp, self._belief = stamp, belief
        self._unseen = 0 if believed else self._unseen + 1
        if z is not None and believed:
            self._remember(stamp, z)
        outcome = 'updated' if believed else 'hidden' if innovation is None else 'rejected'
        return RulerStep(outcome, innovation)

    def _filtered(
        self, belief: Gaussian, duration: int, z: FloatArray | None
    ) -> tuple[Gaussian, Innovation | None, bool]:
        """Belief a duration [ns] later, what a measurement then taught, and if it was believed."""
        dt = duration / NANOSECONDS
        belief = self._filter.predict(belief, self.model, NO_INPUT, self._noise, dt)
        if z is None:
            return belief, None, False
        near = unwrapped(self.config, z, belief.mean[ANGLE])
        updated, innovation = self._filter.update(belief, self._observation, near)
        if innovation.nis > self.config.gate:
            return belief, innovation, False
        return self.model.kept(updated), innovation, True

    def _start(self, stamp: int, z: FloatArray, outcome: str) -> RulerStep:
        self._prior = self._prior or first_belief(self.config, self.model, z)
        self._belief, innovation = self._begun(self._prior, z)
        self.stamp, self._taken = stamp, [(stamp, z)]
        self._unseen = self._refused = 0
        return RulerStep(outcome, innovation)

    def _begun(self, prior: Gaussian, z: FloatArray) -> tuple[Gaussian, Innovation]:
        near = unwrapped(self.config, z, prior.mean[ANGLE])
        updated, innovation = self._filter.update(prior, self._observation, near)
        return self.model.kept(updated), innovation

    def _anew(self, stamp: int, z: FloatArray | None) -> RulerStep:
        """Give up the motion, and start where the frame has the bar, if it has one."""
        self._belief = self._prior = None
        return RulerStep('hidden') if z is None else self._start(stamp, z, 'restarted')

    def _remember(self, stamp: int, z: FloatArray) -> None:
        """Keep a frame until all of them are filtered again, from the parameters they tell.

        What the first frames taught under a wrong guess was linearised about that guess. The
        covariance before them stays, so that no frame counts twice but in the guess.
        """
        if not self._taken:
            return
        self._taken.append((stamp, z))
        if stamp - self._taken[0][0] < self.config.again * NANOSECONDS:
            return
        taken, self._taken = self._taken, []
        if self.config.again > 0:
            with suppress(FloatingPointError):
                self._belief = self._filtered_again(taken)
                self.counts['again'] += 1

    def _filtered_again(self, taken: list[tuple[int, FloatArray]]) -> Gaussian:
        prior, model = cast('Gaussian', self._prior), self.model
        mean = model.joint(prior.mean[model.own], self.belief.mean[model.at])
        belief, _ = self._begun(Gaussian(mean, prior.cov), taken[0][1])
        for (before, _), (stamp, z) in pairwise(taken):
            belief, *_ = self._filtered(belief, stamp - before, z)
        return belief
