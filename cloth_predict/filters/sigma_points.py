"""Kalman filters that send points through the step in place of a derivative: UKF and CKF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints

from cloth_predict.filters.linear import condition, root, spread, symmetric
from cloth_predict.types import (
    Dynamics,
    Filter,
    FloatArray,
    Gaussian,
    Innovation,
    Integrator,
    Observation,
)


@dataclass(frozen=True)
class SigmaPointFilter(Filter[Gaussian]):
    """Kalman filter on 2 n + 1 sigma points, n = dim_x (Julier & Uhlmann 1997).

    The points are the mean x and x +- alpha sqrt(n) times the columns of the root L of P = L L'
    (van der Merwe 2004, with kappa = 0). beta = 2 gives the exact variance of the square of a
    Gaussian. alpha = 1, beta = 0 weighs the mean with nothing: the cubature filter, on 2 n points
    (Arasaratnam & Haykin 2009).

    The points are filterpy's; its filters are not used, because their sums around a large weight
    of the mean cost digits, where here all sums are of differences to the first point.

    No derivative is needed, but every `predict` takes one step of the model per point: with 16
    free nodes and smooth forces n = 192, so 385 steps in place of the EKF's one. Where model and
    integrator take states of shape (points, dim_x), one step takes them all `together`.
    """

    integrator: Integrator
    alpha: float
    beta: float
    together: bool = False

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> Gaussian:
        """Belief before the first measurement: the prior."""
        return prior

    def predict(
        self, belief: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> Gaussian:
        """Belief dt [s] later.

        Half of the noise dt q spreads the points before the step and half is added after it, as in
        `linear.propagate`: on a linear model this is the EKF. Raises FloatingPointError where the
        covariance is not positive definite.
        """
        half = 0.5 * dt * q
        wider = spread(belief.cov, half)
        points, mean_weights, cov_weights = self.points(belief.mean, wider)
        mean, cov = moments(self._moved(model, points, u, dt), mean_weights, cov_weights)
        return Gaussian(mean, spread(cov, half))

    def _moved(self, model: Dynamics, points: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """Points after a step of dt [s], shape (points, dim_x)."""
        if self.together:
            return self.integrator.step(model, points, u, dt)
        return np.array([self.integrator.step(model, point, u, dt) for point in points])

    def points(
        self, mean: FloatArray, cov: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points around the mean, (points, dim_x), and their weights for mean and covariance."""
        made = MerweScaledSigmaPoints(
            len(mean),
            self.alpha,
            self.beta,
            kappa=0.0,
            sqrt_method=lambda scaled: root(scaled, 'covariance').T,
        )
        weighted = slice(0 if made.Wm[0] or made.Wc[0] else 1, None)
        return made.sigma_points(mean, cov)[weighted], made.Wm[weighted], made.Wc[weighted]

    def update(
        self, belief: Gaussian, obs: Observation, z: FloatArray
    ) -> tuple[Gaussian, Innovation]:
        """Belief given z: exact, as a measurement that is linear in the state needs no points."""
        return condition(belief, obs.jac(belief.mean), obs.cov, z - obs.h(belief.mean))


def moments(
    points: FloatArray, mean_weights: FloatArray, cov_weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean, shape (m,), and covariance, (m, m), of weighted points, shape (points, m)."""
    offset = points - points[0]
    shift = mean_weights @ offset
    centred = offset - shift
    return points[0] + shift, symmetric((cov_weights[:, None] * centred).T @ centred)
