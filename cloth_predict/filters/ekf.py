"""Extended Kalman filter with full covariance on the discrete step (Gomes 2016, chapter 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cloth_predict.filters.linear import condition, of_groups, propagate
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
class ExtendedKalmanFilter:
    """EKF whose F is the exact Jacobian of the step that moves the mean."""

    integrator: Integrator

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> Gaussian:
        """Belief before the first measurement: the prior."""
        return prior

    def predict(
        self, belief: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> Gaussian:
        """Belief dt [s] later: x = step(x), P = F P F' + Q (Gomes 2016, eq. 6.2, with F exact)."""
        mean, tangent = self.integrator.step_tangent(model, belief.mean, u, dt)
        return Gaussian(mean, propagate(belief.cov, tangent, dt * q))

    def forecast(
        self,
        belief: Gaussian,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (dim_x,), and covariances of `rows` after one step of dt [s] per input.

        The same as as many calls of `predict`, but the rows W are pulled back through the steps
        (W <- W F) instead of the whole covariance being pushed forward.
        """
        mean, tangents = belief.mean, []
        for u in inputs:
            mean, tangent = self.integrator.step_tangent(model, mean, u, dt)
            tangents.append(tangent)
        # noise acts half before and half after a step: fully between two of them
        pulled, noise = np.eye(len(mean))[rows.ravel()], 0.5 * dt * q * (len(tangents) > 0)
        cov = of_groups(pulled, pulled * noise, rows)
        for left, tangent in reversed(list(enumerate(tangents))):
            pulled = tangent.pull(pulled)
            cov += of_groups(pulled, pulled * noise * (2.0 if left else 1.0), rows)
        return mean, cov + of_groups(pulled, pulled @ belief.cov, rows)

    def update(
        self, belief: Gaussian, obs: Observation, z: FloatArray
    ) -> tuple[Gaussian, Innovation]:
        """Belief given z (Gomes 2016, eq. 6.6, in a form that keeps P symmetric)."""
        return condition(belief, obs.jac(belief.mean), obs.cov, z - obs.h(belief.mean))
