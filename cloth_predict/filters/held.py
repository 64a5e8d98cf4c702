"""An EKF whose covariance rests for some frames while nothing changes but the state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Observation,
    read_only,
)

SETTLED = 30
"""Frames from the start, or from a marker's return, until the covariance may rest: by then that of
what was unknown has come down."""
MISSED = 5
"""Frames in a row that may miss a marker without its being taken for gone."""
GONE = 100
"""Frames in a row without a marker after which its covariance has settled again, as hidden."""
ALIKE = 0.5
"""Share by which an interval between frames may differ from the one that the covariance knows."""


@dataclass(frozen=True)
class HeldGaussian(Gaussian):
    """A belief that knows the covariance before its last measurement, shape (dim_x, dim_x).

    frame: number of measurements; last, shape (dim_x,): the one that saw each state last, -1 where
    none ever did; even: how many in a row missed nothing for long; dt [s]: the step before the
    last one at which the covariance moved; measured: whether a measurement came after the last
    step; ahead: covariances of predictions, each with its turn, which is some frames long.
    """

    prior: FloatArray
    last: IntArray
    frame: int = 0
    even: int = 0
    dt: float = 0.0
    measured: bool = False
    ahead: dict[tuple[int, float, bytes], tuple[int, FloatArray]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ('prior', 'last'):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True)
class HeldCovariance:
    """Moves the mean at every frame, and the covariance at every `frames`-th one.

    In between the covariance before a measurement is taken to be what it was last time, as it is
    in a steady state; the gain still is that of the markers seen. It rests only while frames come
    at an even rate and no marker is gone for long: what is hidden grows uncertain as in the exact
    filter.
    A covariance that follows every turn of springs between taut and slack is not only dearer but
    makes worse predictions.
    """

    ekf: ExtendedKalmanFilter
    frames: int

    def start(
        self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray
    ) -> HeldGaussian:
        """Belief before the first measurement: the prior."""
        return HeldGaussian(prior.mean, prior.cov, prior.cov, np.full(len(prior.mean), -1))

    def predict(
        self, belief: HeldGaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> HeldGaussian:
        """Belief dt [s] later."""
        if self._rests(belief, dt):
            mean = self.ekf.integrator.step(model, belief.mean, u, dt)
            return replace(belief, mean=mean, cov=belief.prior, measured=False)
        after = self.ekf.predict(belief, model, u, q, dt)
        return replace(belief, mean=after.mean, cov=after.cov, dt=dt, measured=False)

    def update(
        self, belief: HeldGaussian, obs: Observation, z: FloatArray
    ) -> tuple[HeldGaussian, Innovation]:
        """Belief given z, and what was learnt."""
        after, innovation = self.ekf.update(belief, obs, z)
        last, frame, rows = belief.last.copy(), belief.frame + 1, np.asarray(obs.jac(belief.mean))
        back = ((last[rows] >= 0) & (last[rows] < frame - 1 - MISSED)).any()
        last[rows] = frame
        gone = ((last >= max(frame - GONE, 0)) & (last < frame - MISSED)).any()
        even = 0 if back or gone else belief.even + 1
        held = HeldGaussian(
            after.mean, after.cov, belief.cov, last, frame, even, belief.dt, True, belief.ahead
        )
        return held, innovation

    def forecast(
        self,
        belief: HeldGaussian,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariances of `rows` after one step of dt [s] per input, as of the EKF.

        The covariance of a prediction serves for `frames` frames as well, whether that of the
        state rests or not: to carry it through the steps takes most of the time.
        """
        key = len(inputs), dt, rows.tobytes()
        turn = belief.frame // self.frames  # whoever asks at every frame gets the same
        known, cov = belief.ahead.get(key, (-1, np.zeros(0)))
        if known != turn:
            mean, cov = self.ekf.forecast(belief, model, inputs, q, dt, rows)
            cov = np.asarray(read_only(cov))
            belief.ahead[key] = turn, cov
            return mean, cov
        mean = belief.mean
        for u in inputs:
            mean = self.ekf.integrator.step(model, mean, u, dt)
        return mean, cov

    def _rests(self, belief: HeldGaussian, dt: float) -> bool:
        settled = belief.measured and belief.even > SETTLED and belief.even % self.frames != 1
        return settled and abs(dt - belief.dt) < ALIKE * belief.dt
