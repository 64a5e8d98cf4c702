"""Superquadric ellipsoids with taper and bend (Metaxas & Terzopoulos 1993, eq. 20, 21 and 41).

The functions are analytic in the parameters, so that complex ones give derivatives (a complex
step).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cloth_predict.errors import ConfigError
from cloth_predict.models.taylor import Taylor, cosine
from cloth_predict.types import FloatArray

PARAMETERS = ('a0', 'a1', 'a2', 'a3', 'e1', 'e2', 't1', 't2', 'b1', 'b2', 'b3')
"""Scale a0 [m], aspect ratios a1 to a3, squareness e1, e2, tapers t1, t2 along z, and the bend:
size b1 [m], place b2 [m] and region b3."""
LOW = np.array([1e-6, 1e-3, 1e-3, 1e-3, 0.0, 0.0, -1.0, -1.0, -np.inf, -1.0, 1e-3])
HIGH = np.array([np.inf, 1.0, 1.0, 1.0, 2.0, 2.0, 1.0, 1.0, np.inf, 1.0, 1.0])
"""Ranges of the parameters: those of section II.D, with 1e-3 for "above 0", and squareness up to
2, beyond which the body is no longer convex."""
ROUNDING = 1e-15
"""Sine or cosine that is 0 but for the rounding of its angle."""

E1, E2 = PARAMETERS.index('e1'), PARAMETERS.index('e2')


def check_parameters(values: FloatArray) -> None:
    """Raise ConfigError where one of the 11 parameters is outside its range."""
    if np.shape(values) != (len(PARAMETERS),):
        raise ConfigError(
            f'a superquadric has {len(PARAMETERS)} parameters ({", ".join(PARAMETERS)}), '
            f'not {np.size(values)}'
        )
    for name, value, low, high in zip(PARAMETERS, values, LOW, HIGH, strict=True):
        if not (np.isfinite(value) and low <= value <= high):
            raise ConfigError(
                f'superquadric: {name} is {value:g}, expected a number from {low:g} to {high:g}'
            )


def positions(q_s: FloatArray, coordinates: FloatArray) -> FloatArray:
    """Points s [m] of the reference shape, (N, 3), at u, v [rad], (N, 2) (eq. 21 of 20, w = 1)."""
    powers = [value for value, _ in _powers(q_s, coordinates)]
    return np.stack(_deformed(q_s, powers, np.cos), axis=1)


def jacobian(q_s: FloatArray, coordinates: FloatArray) -> FloatArray:
    """J, the derivative of s by the parameters, shape (N, 3, 11) (eq. 41, put right)."""
    a0, a1, a2, a3, _, _, t1, t2, b1, b2, b3 = q_s
    powers = _powers(q_s, coordinates)
    (cos_u, ln_cos_u), (sin_u, ln_sin_u), (cos_v, ln_cos_v), (sin_v, ln_sin_v) = powers
    x, y = cos_u * cos_v, cos_u * sin_v
    taper_x, taper_y = t1 * sin_u + 1.0, t2 * sin_u + 1.0
    reach = (sin_u + b2 / (a0 * a3)) * np.pi
    swing = b1 * np.sin(reach * b3)
    result = np.zeros((len(coordinates), 3, len(PARAMETERS)), np.result_type(q_s, float))
    result[:, 0, 0] = taper_x * a1 * x + swing * b2 * b3 * np.pi / (a0**2 * a3)
    result[:, 1, 0] = taper_y * a2 * y
    result[:, 2, 0] = a3 * sin_u
    result[:, 0, 1] = taper_x * a0 * x
    result[:, 1, 2] = taper_y * a0 * y
    result[:, 0, 3] = swing * b2 * b3 * np.pi / (a0 * a3**2)
    result[:, 2, 3] = a0 * sin_u
    slope = ln_sin_u * sin_u
    result[:, 0, 4] = (t1 * slope + taper_x * ln_cos_u) * a0 * a1 * x - swing * b3 * np.pi * slope
    result[:, 1, 4] = (t2 * slope + taper_y * ln_cos_u) * a0 * a2 * y
    result[:, 2, 4] = a0 * a3 * slope
    result[:, 0, 5] = taper_x * a0 * a1 * ln_cos_v * x
    result[:, 1, 5] = taper_y * a0 * a2 * ln_sin_v * y
    result[:, 0, 6] = sin_u * a0 * a1 * x
    result[:, 1, 7] = sin_u * a0 * a2 * y
    result[:, 0, 8] = np.cos(reach * b3)
    result[:, 0, 9] = -swing * b3 * np.pi / (a0 * a3)
    result[:, 0, 10] = -swing * reach  # printed as -b1 pi sin(r) r, where r / b3 is meant
    return result


def motion(q_s: FloatArray, rate: FloatArray, coordinates: FloatArray) -> Taylor:
    """Points s, J q_s' and J' q_s', (N, 3) each, while the parameters change at a steady rate."""
    zero = np.zeros(())
    parameters = [Taylor(value, change, zero) for value, change in zip(q_s, rate, strict=True)]
    changes = np.repeat(rate[[E1, E2]], 2)
    powers = [
        Taylor(value, value * logarithm * change, value * (logarithm * change) ** 2)
        for (value, logarithm), change in zip(_powers(q_s, coordinates), changes, strict=True)
    ]
    moved = _deformed(parameters, powers, cosine)
    return Taylor(
        np.stack([axis.value for axis in moved], axis=1),
        np.stack([axis.first for axis in moved], axis=1),
        np.stack([axis.second for axis in moved], axis=1),
    )


def _deformed(parameters: Any, powers: Any, cos: Callable[[Any], Any]) -> tuple[Any, Any, Any]:
    """The three coordinates of eq. 21, of numbers or of what moves."""
    a0, a1, a2, a3, _, _, t1, t2, b1, b2, b3 = parameters
    cos_u, sin_u, cos_v, sin_v = powers
    bend = b1 * cos((sin_u + b2 / (a0 * a3)) * b3 * np.pi)
    x = a0 * a1 * cos_u * cos_v * (t1 * sin_u + 1.0) + bend
    y = a0 * a2 * cos_u * sin_v * (t2 * sin_u + 1.0)
    return x, y, a0 * a3 * sin_u


def _powers(q_s: FloatArray, coordinates: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """C and S of eq. 20 of u and e1, then of v and e2, each with the logarithm of its base.

    Where the base is 0, so are the power and, as x^e ln x -> 0, all its derivatives by e.
    """
    u, v = coordinates.T
    exponents = np.repeat(q_s[[E1, E2]], 2)
    bases = (np.cos(u), np.sin(u), np.cos(v), np.sin(v))
    return [_power(base, exponent) for base, exponent in zip(bases, exponents, strict=True)]


def _power(base: FloatArray, exponent: float) -> tuple[FloatArray, FloatArray]:
    size = np.abs(base)
    something = size > ROUNDING
    logarithm = np.log(np.where(something, size, 1.0))
    return np.where(something, np.sign(base), 0.0) * np.exp(exponent * logarithm), logarithm
