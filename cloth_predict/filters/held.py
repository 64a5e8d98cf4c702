"""An EKF whose covariance rests for some frames while nothing changes but the state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
"""Frames that have to see the same markers before the covariance may rest: by then that of an
unknown start, or of a marker that is back, has come down."""
ALIKE = 0.5
"""Share by which an interval between frames may differ from the one that the covariance knows."""


@dataclass(frozen=True)
class HeldGaussian(Gaussian):
    """A belief that knows the covariance before its last measurement, shape (dim_x, dim_x).

    rows: what that measurement saw; dt [s]: the step that led to it; same: how many frames before
    it saw the same; measured: whether it came after the last step.
    """

    prior: FloatArray
    rows: NDArray[Any] = field(default_factory=lambda: np.zeros(0, np.int64))
    dt: float = 0.0
    same: int = 0
    measured: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, 'prior', read_only(self.prior))


@dataclass(frozen=True)
class HeldCovariance:
    """Moves the mean at every frame, and the covariance at every `frames`-th one.

    In between the covariance before a measurement is taken to be what it was last time, as it is
    in a steady state; the gain still is that of the markers seen. It rests only while the same
    markers stay in view at an even rate: what is hidden grows uncertain as in the exact filter.
    A covariance that follows every turn of springs between taut and slack is not only dearer but
    makes worse predictions.
    """

    ekf: ExtendedKalmanFilter
    frames: int

    def start(
        self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray
    ) -> HeldGaussian:
        """Belief before the first measurement: the prior."""
        return HeldGaussian(prior.mean, prior.cov, prior.cov)

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
        rows = np.asarray(obs.jac(belief.mean))
        same = belief.same + 1 if np.array_equal(rows, belief.rows) else 0
        held = HeldGaussian(after.mean, after.cov, belief.cov, rows, belief.dt, same, True)
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
        """Mean and covariances of `rows` after one step of dt [s] per input, as of the EKF."""
        return self.ekf.forecast(belief, model, inputs, q, dt, rows)

    def _rests(self, belief: HeldGaussian, dt: float) -> bool:
        settled = belief.measured and belief.same >= SETTLED
        return (
            settled and bool(belief.same % self.frames) and abs(dt - belief.dt) < ALIKE * belief.dt
        )
