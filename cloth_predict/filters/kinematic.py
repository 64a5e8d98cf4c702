"""Per-marker kinematic Kalman filters: driven nodes, and the baselines of `evaluate`.

The filter itself is filterpy's. The three coordinates of a marker share F, Q, H and R, so one
filter whose state has a column for each coordinate does all three.
"""

from __future__ import annotations

import copy
from math import factorial

import numpy as np
from filterpy.kalman import KalmanFilter

from cloth_predict.types import FloatArray

ORDERS = {'fixed': 1, 'constant_velocity': 2, 'constant_acceleration': 3}
"""Number of derivatives in the state: position; and velocity; and acceleration."""


def transition(order: int, dt: float) -> FloatArray:
    """Taylor transition matrix of the position and its derivatives, shape (order, order)."""
    step = np.eye(order)
    for lag in range(1, order):
        step.flat[lag : (order - lag) * order : order + 1] = dt**lag / factorial(lag)
    return step


def white_noise(order: int, density: float, dt: float) -> FloatArray:
    """Covariance over dt of white noise on the highest derivative's rate, shape (order, order).

    density [m^2/s^(2 order - 1)]: the integral of the transition's last column with itself.
    """
    power = np.arange(order)[::-1]
    scale = np.array([1.0 / factorial(p) for p in power])
    total = power[:, None] + power + 1
    return np.asarray(density * np.outer(scale, scale) * dt**total / total)


class KinematicTrack:
    """One marker that moves with constant position, velocity or acceleration but for noise."""

    def __init__(
        self, motion: str, density: float, sigma: float, position: FloatArray, spread: float = 1.0
    ) -> None:
        """Start at a position [m], shape (3,), measured with sigma [m] on each coordinate.

        density: spectral density of the driving noise; spread: standard deviation of the unknown
        derivatives at the start, in their own SI units.
        """
        self.order = ORDERS[motion]
        self._density = density
        self._filter = KalmanFilter(dim_x=self.order, dim_z=1)
        self._filter.x = np.zeros((self.order, 3))
        self._filter.x[0] = position
        self._filter.P = np.diag([sigma**2] + [spread**2] * (self.order - 1))
        self._filter.R = np.array([[sigma**2]])
        self._observed = np.eye(1, self.order)

    def copy(self) -> KinematicTrack:
        """Return a copy that can be moved on by itself."""
        other = copy.copy(self)
        other._filter = copy.copy(self._filter)  # its arrays are replaced, never written to
        return other

    def predict(self, dt: float) -> None:
        """Move on by dt [s]."""
        self._filter.predict(
            F=transition(self.order, dt), Q=white_noise(self.order, self._density, dt)
        )

    def update(self, position: FloatArray) -> None:
        """Take a measured position [m], shape (3,)."""
        # filterpy reshapes z to one column unless H is given with it
        self._filter.update(np.reshape(position, (1, 3)), H=self._observed)

    def extrapolate(self, horizon: float) -> FloatArray:
        """Position [m], velocity and acceleration `horizon` [s] ahead, shape (3, 3)."""
        derivatives = np.zeros((3, 3))
        derivatives[: self.order] = transition(self.order, horizon) @ self._filter.x
        return derivatives

    def variance(self, horizon: float) -> float:
        """Variance [m^2] of a coordinate of the position `horizon` [s] ahead."""
        step = transition(self.order, horizon)
        cov = step @ self._filter.P @ step.T + white_noise(self.order, self._density, horizon)
        return float(cov[0, 0])
