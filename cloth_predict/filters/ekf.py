"""Extended Kalman filter with full covariance on the discrete step (Gomes 2016, chapters 4 and 6)."""

from __future__ import annotations

from dataclasses import dataclass

from cloth_predict.filters.linear import condition, propagate
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Gaussian,
    Innovation,
    Integrator,
    Observation,
)


@dataclass(frozen=True)
class ExtendedKalmanFilter:
    """EKF whose F is the exact Jacobian of the step that moves the mean, not the continuous one."""

    integrator: Integrator

    def predict(
        self, belief: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> Gaussian:
        """Belief dt [s] later: x = step(x), P = F P F' + Q (Gomes 2016, eq. 6.2, with F exact)."""
        mean, step_jac = self.integrator.step_jac(model, belief.mean, u, dt)
        return Gaussian(mean, propagate(belief.cov, step_jac, dt * q))

    def update(
        self, belief: Gaussian, obs: Observation, z: FloatArray
    ) -> tuple[Gaussian, Innovation]:
        """Belief given z (Gomes 2016, eq. 6.6, in a form that keeps P symmetric)."""
        return condition(belief, obs.jac(belief.mean), obs.cov, z - obs.h(belief.mean))
