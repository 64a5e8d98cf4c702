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
        pulled = np.zeros((rows.size, len(mean)))
        pulled[np.arange(rows.size), rows.ravel()] = 1.0
        driven = np.flatnonzero(q)
        root = np.sqrt(dt * q[driven])
        cov = np.zeros((*rows.shape, rows.shape[1]))
        for tangent in reversed(tangents):
            # noise acts half before and half after a step: fully between two of them
            after, pulled = pulled[:, driven] * root, tangent.pull(pulled)
            cov += of_groups(after, after, rows) * (1.0 if tangent is not tangents[-1] else 0.5)
        if tangents:
            before = pulled[:, driven] * root
            cov += 0.5 * of_groups(before, before, rows)
        return mean, cov + of_groups(pulled, pulled @ belief.cov, rows)

    def update(
        self, belief: Gaussian, obs: Observation, z: FloatArray
    ) -> tuple[Gaussian, Innovation]:
        """Belief given z (Gomes 2016, eq. 6.6, in a form that keeps P symmetric)."""
        return condition(belief, obs.jac(belief.mean), obs.cov, z - obs.h(belief.mean))
