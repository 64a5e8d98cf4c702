"""Recursive least squares with exponential forgetting (Gomes 2016, section 4.1).

The model is taken as exact: old measurements are forgotten, in place of noise on the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.linear import condition, propagate
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Integrator,
    Observation,
)


@dataclass(frozen=True)
class RecursiveLeastSquares:
    """Weighs a measurement by exp(-age / forgetting) and moves the state by the model's step.

    On a linear model the mean minimises the weighted squared residuals (Gomes 2016, eq. 4.10;
    4.11 is the recursion). The covariance is (A' W A)^-1 with the weights in W; of a state that
    is neither measured nor damped it grows without bound. Raises FloatingPointError where it
    overflows: blind for some 700 times `forgetting`.
    """

    integrator: Integrator
    forgetting: float
    """Time constant [s]."""

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> Gaussian:
        """Belief before the first measurement: the prior, which is forgotten too."""
        return prior

    def predict(
        self, belief: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> Gaussian:
        """Belief dt [s] later: x = step(x), P = F P F' exp(dt / forgetting); q plays no part."""
        mean, tangent = self.integrator.step_tangent(model, belief.mean, u, dt)
        return Gaussian(mean, self._forgotten(propagate(belief.cov, tangent, 0.0 * q), dt))

    def update(
        self, belief: Gaussian, obs: Observation, z: FloatArray
    ) -> tuple[Gaussian, Innovation]:
        """Belief given z (Gomes 2016, eq. 4.11, for a whole frame at once)."""
        return condition(belief, obs.jac(belief.mean), obs.cov, z - obs.h(belief.mean))

    def forecast(
        self,
        belief: Gaussian,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariances of `rows` after one step of dt [s] per input."""
        ekf = ExtendedKalmanFilter(self.integrator)
        mean, cov = ekf.forecast(belief, model, inputs, 0.0 * q, dt, rows)
        return mean, self._forgotten(cov, len(inputs) * dt)

    def _forgotten(self, cov: FloatArray, time: float) -> FloatArray:
        with np.errstate(over='raise'):
            return np.asarray(np.exp(time / self.forgetting) * cov)
