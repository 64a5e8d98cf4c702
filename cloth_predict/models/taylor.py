"""Taylor polynomials of second order, for accelerations of what is given as a formula."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class Taylor:
    """A quantity that moves: its value, rate and acceleration, of one shape.

    Products, sums and quotients with each other, and products with and sums of plain numbers on
    the right.
    """

    value: FloatArray
    first: FloatArray
    second: FloatArray

    def __mul__(self, other: Taylor | float) -> Taylor:
        if not isinstance(other, Taylor):
            return Taylor(self.value * other, self.first * other, self.second * other)
        return Taylor(
            self.value * other.value,
            self.first * other.value + self.value * other.first,
            self.second * other.value + 2.0 * self.first * other.first + self.value * other.second,
        )

    def __add__(self, other: Taylor | float) -> Taylor:
        if not isinstance(other, Taylor):
            return Taylor(self.value + other, self.first, self.second)
        return Taylor(
            self.value + other.value, self.first + other.first, self.second + other.second
        )

    def __truediv__(self, other: Taylor) -> Taylor:
        first = -other.first / other.value**2
        second = 2.0 * other.first**2 / other.value**3 - other.second / other.value**2
        return self * Taylor(1.0 / other.value, first, second)


def cosine(angle: Taylor) -> Taylor:
    """The cosine of an angle [rad] that moves."""
    cos, sin = np.cos(angle.value), np.sin(angle.value)
    second = -cos * angle.first**2 - sin * angle.second
    return Taylor(cos, -sin * angle.first, second)
