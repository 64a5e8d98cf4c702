"""The lens: radial and tangential distortion as OpenCV models it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import polynomial

from cloth_predict.types import FloatArray

REACH = 20.0
"""Where the models end, as the tangent of the angle from the axis (87 degrees)."""
ITERATIONS = 30
CLOSE = 1e-12


@dataclass(frozen=True, eq=False)
class Lens:
    """Coefficients k1, k2, p1, p2, k3, k4, k5, k6, shape (8,).

    Coordinates are x / z and y / z in the projector's frame, shape (..., 2). With r^2 = x^2 + y^2
    and g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), the lens turns x, y to

        x g + 2 p1 x y + p2 (r^2 + 2 x^2),  y g + p1 (r^2 + 2 y^2) + 2 p2 x y.

    """

    coefficients: FloatArray

    def distort(self, ideal: FloatArray) -> FloatArray:
        """Return where the lens moves ideal coordinates; NaN beyond the limit."""
        square = (ideal * ideal).sum(axis=-1)
        return self.bend(ideal, np.where(square < self.limit**2, square, np.nan))

    def bend(self, ideal: FloatArray, square: FloatArray) -> FloatArray:
        """Return where the model moves ideal coordinates, given r^2, even beyond the limit."""
        x, y = ideal[..., 0], ideal[..., 1]
        gain = self._radial(square)[0]
        p1, p2 = self.coefficients[2:4]
        tilt = 2 * (p1 * y + p2 * x)
        found = np.empty(ideal.shape)
        found[..., 0] = x * (gain + tilt) + p2 * square
        found[..., 1] = y * (gain + tilt) + p1 * square
        return found

    def undistort(self, seen: FloatArray) -> FloatArray:
        """Return the coordinates that the lens moves to those given, by Newton's method.

        NaN where there are none within the limit.
        """
        found = np.array(seen, dtype=float)
        inner = 0.999999 * self.limit  # at the limit itself the Jacobian is singular
        for _ in range(ITERATIONS):
            radius = np.hypot(found[..., 0], found[..., 1])
            found *= np.minimum(1, inner / np.maximum(radius, inner))[..., None]
            miss = seen - self.distort(found)
            step = np.linalg.solve(self._jacobian(found), miss[..., None])[..., 0]
            found += step
            if not np.any(np.abs(step) > CLOSE):  # NaN has no better step either
                break
        miss = np.abs(seen - self.distort(found)).max(axis=-1)
        return np.where((miss < 1e-10)[..., None], found, np.nan)

    def _radial(self, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return g and its derivative by r^2."""
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients
        above = 1 + square * (k1 + square * (k2 + square * k3))
        below = 1 + square * (k4 + square * (k5 + square * k6))
        gain = above / below
        slope_above = k1 + square * (2 * k2 + square * 3 * k3)
        slope_below = k4 + square * (2 * k5 + square * 3 * k6)
        return gain, (slope_above - gain * slope_below) / below

    def _jacobian(self, ideal: FloatArray) -> FloatArray:
        """Derivative of `distort`, shape (..., 2, 2)."""
        x, y = ideal[..., 0], ideal[..., 1]
        gain, slope = self._radial(x * x + y * y)
        p1, p2 = self.coefficients[2:4]
        found = np.empty((*ideal.shape, 2))
        found[..., 0, 0] = gain + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
        found[..., 1, 1] = gain + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
        found[..., 0, 1] = 2 * (slope * x * y + p1 * x + p2 * y)
        found[..., 1, 0] = found[..., 0, 1]
        return found

    @cached_property
    def limit(self) -> float:
        """Radius from which on the model folds back, so that there is no way back from a pixel.

        The smallest at which the Jacobian is singular in some direction, at most REACH.
        """
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients
        above, below = np.array([1, k1, k2, k3]), np.array([1, k4, k5, k6])
        # with g = N / D: d(r g)/dr = (N D + 2 r^2 (N' D - N D')) / D^2
        turn = polynomial.polysub(
            polynomial.polymul(polynomial.polyder(above), below),
            polynomial.polymul(above, polynomial.polyder(below)),
        )
        slope = polynomial.polyadd(polynomial.polymul(above, below), 2 * polynomial.polymulx(turn))
        reach = float(np.sqrt(min(_first_root(slope), _first_root(below), REACH**2)))
        # the tangential terms may fold it earlier: look along rays, a thousandth at a time
        radii = np.linspace(0, reach, 1001)[:-1]
        angles = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        jacobian = self._jacobian(radii[:, None, None] * rays)
        folded = (np.linalg.det(jacobian) <= 0).any(axis=1)
        return float(radii[int(folded.argmax()) - 1]) if folded.any() else reach


def _first_root(coefficients: FloatArray) -> float:
    """Smallest positive root of a polynomial (constant term first), or infinity."""
    roots = np.asarray(polynomial.polyroots(polynomial.polytrim(coefficients)))
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))
