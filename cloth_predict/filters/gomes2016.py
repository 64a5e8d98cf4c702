"""The recursion of Gomes 2016, chapter 6, letter by letter; for the record, not for use.

Its transition matrix is the Jacobian of the continuous motion, its step explicit Euler, and its
covariance loses symmetry. On springs as stiff as a cloth's it diverges within frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.types import (
    Dynamics,
    Filter,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Observation,
)

FARTHEST = 1e12
"""State [SI] from which on the recursion counts as lost, while its squares are still finite."""


@dataclass(frozen=True)
class Gomes2016(Filter[Gaussian]):
    """EKF as the thesis prints it (eq. 6.1-6.11).

    The thesis gives Q = alpha I and R = beta I. The process noise here is a density of each state:
    alpha is the largest of them times dt, the covariance that it would add to its own state in a
    step. beta is the variance of the measured coordinates, as the observation has it.

    Raises FloatingPointError where a number overflows, S has no inverse or the state leaves
    every bound.
    """

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> Gaussian:
        """Belief before the first measurement: the given state with P = 0 (below eq. 6.2)."""
        return Gaussian(prior.mean, np.zeros_like(prior.cov))

    def predict(
        self, belief: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> Gaussian:
        """Belief dt [s] later, with Ts = dt."""
        with np.errstate(over='raise', invalid='raise'):
            F = model.jac(belief.mean, u).toarray()  # 6.1
            mean = belief.mean + dt * model.f(belief.mean, u)  # 6.5
            cov = F @ belief.cov @ F.T + dt * q.max() * np.eye(len(mean))  # 6.2
        return _finite(mean, cov)

    def update(
        self, belief: Gaussian, obs: Observation, z: FloatArray
    ) -> tuple[Gaussian, Innovation]:
        """Belief given z (eq. 6.6)."""
        H = _matrix(obs.jac(belief.mean), len(belief.mean))
        R = np.diag(obs.cov) if obs.cov.ndim == 1 else obs.cov
        try:
            with np.errstate(over='raise', invalid='raise'):
                y = z - H @ belief.mean
                S = H @ belief.cov @ H.T + R
                inverse = np.linalg.inv(S)
                K = belief.cov @ H.T @ inverse
                mean = belief.mean + K @ y
                cov = (np.eye(len(mean)) - K @ H) @ belief.cov
                nis = float(y @ inverse @ y)
        except np.linalg.LinAlgError:
            raise FloatingPointError('the innovation covariance has no inverse') from None
        return _finite(mean, cov), Innovation(y, S, nis)


def _matrix(jac: FloatArray | IntArray, size: int) -> FloatArray:
    """H as a matrix (eq. 6.7, for the rows seen)."""
    return np.eye(size)[jac] if np.issubdtype(jac.dtype, np.integer) else np.asarray(jac, float)


def _finite(mean: FloatArray, cov: FloatArray) -> Gaussian:
    # sparse products and LAPACK overflow without a word
    if not ((np.abs(mean) < FARTHEST).all() and np.isfinite(cov).all()):
        raise FloatingPointError('the estimate is lost')
    return Gaussian(mean, cov)
