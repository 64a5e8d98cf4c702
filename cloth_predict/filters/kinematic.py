"""How a coordinate moves by itself: polynomials but for noise, and the swing of a hand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class Motion:
    """p^(n) + resistance[n-1] p^(n-1) + ... + resistance[0] p = white noise, n = `order`.

    resistance [1/s^(n-k)], shape (n,). The state is the position and its n - 1 derivatives.
    """

    resistance: tuple[float, ...]

    @property
    def order(self) -> int:
        """Number of derivatives in the state, the position among them."""
        return len(self.resistance)

    @property
    def drift(self) -> FloatArray:
        """Derivative of the state by the state, shape (order, order)."""
        drift = np.eye(self.order, k=1)
        drift[-1] = np.negative(self.resistance)
        return drift

    def over(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Transition of the state over dt [s], and the noise's covariance; (order, order) each.

        The covariance is that of white noise of density 1 m^2/s^(2 order - 1). Time is counted in
        units of dt, so that all derivatives are of the same size and none is lost in rounding.
        """
        if dt == 0:
            return np.eye(self.order), np.zeros((self.order, self.order))
        power = np.arange(self.order)[::-1]
        scaled = np.array(self.resistance) * dt ** (power + 1.0)
        step, noise = _over_one(Motion(tuple(scaled.tolist())))
        scale = dt ** np.asarray(power, float)
        return step * scale[:, None] / scale, dt * noise * np.outer(scale, scale)


POLYNOMIALS = {
    'fixed': Motion((0.0,)),
    'constant_velocity': Motion((0.0,) * 2),
    'constant_acceleration': Motion((0.0,) * 3),
}
"""By the derivative that stays but for noise."""


def swing(decay: float, restoring: float) -> Motion:
    """Motion of a hand: p^(3) = -decay p^(2) - restoring p^(1) + noise.

    The velocity is a damped oscillation. Without `restoring` it is the model of Singer (1970), and
    without both a constant acceleration.
    """
    return Motion((0.0, restoring, decay))


@lru_cache(maxsize=256)
def _over_one(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Transition and noise over 1 s, by Van Loan's method (1978); read-only.

    It loses the noise in rounding where the motion decays much, so that such a second is halved.
    A polynomial is the same in every unit of time, and hands are extrapolated over the same few
    intervals all the time: most are remembered.
    """
    if max(abs(r) for r in motion.resistance) > 2.0:
        step, noise = motion.over(0.5)
        step, noise = step @ step, noise + step @ noise @ step.T
    else:
        n = motion.order
        both = np.zeros((2 * n, 2 * n))
        both[:n, :n], both[n:, n:] = -motion.drift, motion.drift.T
        both[n - 1, -1] = 1.0
        exponential = expm(both)
        step = exponential[n:, n:].T
        noise = step @ exponential[:n, n:]
    step.flags.writeable = noise.flags.writeable = False
    return step, noise
