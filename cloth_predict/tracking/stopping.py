"""Where and when a motion ends, from what is believed of it now."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cloth_predict.errors import UncertainError
from cloth_predict.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Stop:
    """The end of a motion.

    time [s] from now on, and its sigma; mean, shape (m,), and covariance, (m, m), of what comes
    to rest.
    """

    time: float
    time_sigma: float
    mean: FloatArray
    cov: FloatArray


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
