"""Where and when a motion ends, from what is believed of it now."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cloth_predict.errors import UncertainError
from cloth_predict.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Stop:
    """The end of a motion in the plane.

    time [s] from now on, and its sigma; mean, shape (3,), and covariance, (3, 3), of the pose at
    rest: x, y [m], angle [rad].
    """

    time: float
    time_sigma: float
    mean: FloatArray
    cov: FloatArray

    @property
    def place_sigma(self) -> float:
        """Root mean square of the expected distance [m] from the place of rest."""
        return float(np.sqrt(self.cov[0, 0] + self.cov[1, 1]))

    @property
    def angle_sigma(self) -> float:
        """Sigma of the angle at rest [rad]."""
        return float(np.sqrt(self.cov[2, 2]))

    def certain(self, place: float, angle: float) -> bool:
        """Whether its sigmas are within these [m, rad]."""
        return self.place_sigma <= place and self.angle_sigma <= angle


def at_rest(
    points: FloatArray,
    step: Callable[[FloatArray], FloatArray],
    resting: Callable[[FloatArray], BoolArray],
    dt: float,
    longest: float,
) -> tuple[FloatArray, FloatArray]:
    """Times [s], shape (points,), after which each point is at rest, and the points there.

    step: a step of dt [s] of all points, shape (points, dim_x). Times are multiples of dt. Raises
    UncertainError where a point still moves after `longest` [s].
    """
    times, moving = np.zeros(len(points)), ~resting(points)
    while moving.any():
        if times.max() >= longest:
            raise UncertainError(f'no end of the motion within {longest:g} s')
        points = step(points)
        times[moving] += dt
        moving = ~resting(points)
    return times, points
