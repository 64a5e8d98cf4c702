"""When a surface that is followed comes to rest, and in which shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FrameError, UncertainError
from cloth_predict.tracking.motion import split, surface
from cloth_predict.tracking.track import Track
from cloth_predict.types import FloatArray, Surface

SLOW = 0.01
"""Speed [m/s] below which nothing is seen to move."""


@dataclass(frozen=True)
class Rest:
    """The end of a motion: time [s] from the last frame on, its sigma, and the surface then."""

    time: float
    time_sigma: float
    surface: Surface


def rest(track: Track, config: Config, slow: float = SLOW, longest: float = 30.0) -> Rest:
    """End of a motion, from when on no marker is faster than `slow` [m/s].

    What drives the surface is taken to stay where it is. The sigma of the time is half the time
    between when speeds one sigma less, and one sigma more, stay below. Raises UncertainError where
    they do not within `longest` [s], as under unknown forces that last, and FrameError where the
    model does not get there.
    """
    now = track.now
    held = now.driven.extrapolate(0.0)[0]
    u = now.input(held, np.zeros_like(held))
    steps, dt = split(longest, config.filter.predict_step)
    belief, rows = now.belief, now.layout.rows
    velocity = rows + 3 * len(now.mesh.free)
    beliefs, speeds, sigmas = [], [], []
    try:
        for _ in range(steps + 1):
            beliefs.append(belief)
            speeds.append(np.linalg.norm(belief.mean[velocity], axis=1))
            sigmas.append(_sigma(belief.marginals(velocity)))
            belief = now.filter.predict(belief, now.model, u, now.noise, dt)
    except FloatingPointError as error:
        raise FrameError(f'the prediction fails: {error}') from None
    speed, sigma = np.array(speeds), np.array(sigmas)
    early, last, late = (_last_above(s, slow) + 1 for s in (speed - sigma, speed, speed + sigma))
    if late > steps:
        raise UncertainError(
            f'no end of the motion within {longest:g} s: speeds are still '
            f'{speed[-1].max():.2g} +- {sigma[-1].max():.2g} m/s'
        )
    there = beliefs[last]
    shape = surface(now, there.mean, there.marginals(rows), track.stamp, last * dt)
    return Rest(last * dt, 0.5 * (late - early) * dt, shape)


def _sigma(cov: FloatArray) -> FloatArray:
    """Sigma along the longest axis of each covariance, (k, 3, 3), shape (k,)."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(cov)[:, -1].clip(min=0.0)))


def _last_above(speeds: FloatArray, slow: float) -> int:
    """Last row in which any of the speeds, shape (steps, k), is above `slow`; -1 for none."""
    return int(np.flatnonzero((speeds > slow).any(axis=1))[-1:].max(initial=-1))
