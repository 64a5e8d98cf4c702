"""How the vertices move while a frame is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from cloth_predict.types import FloatArray, Surface


@dataclass(frozen=True)
class Motion:
    """Positions [m] as polynomials of the time dt [s].

    coefficients, shape (order + 1, nodes, 3), the constant ones first.
    """

    coefficients: FloatArray

    @classmethod
    def still(cls, position: FloatArray) -> Motion:
        """One position [m], shape (nodes, 3), for the whole frame."""
        return cls(np.asarray(position, float)[None])

    @classmethod
    def constant_velocity(cls, position: FloatArray, velocity: FloatArray) -> Motion:
        """Return p + v dt (Gomes 2016, eq. 6.23); p [m], v [m/s], each of shape (nodes, 3)."""
        return cls(np.array([position, velocity], float))

    @classmethod
    def constant_acceleration(
        cls, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> Motion:
        """Return p + v dt + a dt^2 / 2; acceleration [m/s^2], shape (nodes, 3)."""
        return cls(np.array([position, velocity, 0.5 * np.asarray(acceleration)], float))

    @classmethod
    def hermite(
        cls,
        position: FloatArray,
        velocity: FloatArray,
        end_position: FloatArray,
        end_velocity: FloatArray,
        duration: float,
    ) -> Motion:
        """The cubic through position [m] and velocity [m/s] at 0 and at `duration` [s]."""
        mean = (np.asarray(end_position) - position) / duration
        return cls(
            np.array(
                [
                    position,
                    velocity,
                    (3 * mean - 2 * velocity - end_velocity) / duration,
                    (velocity + end_velocity - 2 * mean) / duration**2,
                ],
                float,
            )
        )

    @classmethod
    def of(cls, kind: str, surface: Surface, end: Surface | None = None) -> Motion:
        """Return the motion from a surface on, by the name of the parameter `projector.motion`.

        end: the surface some time later, which the motion by the `model` goes through.
        """
        if kind == 'model' and end is not None:
            duration = 1e-9 * (end.stamp - surface.stamp)
            return cls.hermite(
                surface.position, surface.velocity, end.position, end.velocity, duration
            )
        if kind == 'constant_velocity':
            return cls.constant_velocity(surface.position, surface.velocity)
        return cls.constant_acceleration(surface.position, surface.velocity, surface.acceleration)

    def at(self, dt: FloatArray | float) -> FloatArray:
        """Positions [m] at dt [s] of each node, shape (nodes,), or of all; (nodes, 3).

        dt of shape (k, 1) gives the positions at k times, shape (k, nodes, 3).
        """
        dt = np.asarray(dt, float)[..., None]
        found = self.coefficients[-1]
        for lower in self.coefficients[-2::-1]:
            found = lower + dt * found
        return np.asarray(found) + np.zeros_like(dt)  # a still surface has a shape by dt as well

    def shifted(self, by: float) -> Motion:
        """Return the same motion in a time that starts `by` [s] later."""
        order = len(self.coefficients)
        found = np.zeros_like(self.coefficients)
        for low in range(order):
            for k in range(low, order):
                found[low] += comb(k, low) * by ** (k - low) * self.coefficients[k]
        return Motion(found)
