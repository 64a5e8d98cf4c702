"""When a surface that is followed comes to rest, and in which shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FrameError, UncertainError
from cloth_predict.surface.equilibrium import settled
from cloth_predict.tracking.motion import split
from cloth_predict.tracking.track import Track
from cloth_predict.types import FloatArray

NEAR = 0.005
"""Distance [m] from its place at rest within which a marker is taken to be there."""
LONG = 1.0
"""Step [s] on the way to the shape of rest, which has not to follow the motion."""


@dataclass(frozen=True)
class Rest:
    """The end of a motion.

    time [s] from the last frame on, and its sigma; position [m], shape (markers, 3), at rest;
    covariance [m^2] of what is left of the motion then, shape (free markers, 3, 3).
    """

    time: float
    time_sigma: float
    position: FloatArray
    covariance: FloatArray


def rest(track: Track, config: Config, near: float = NEAR, longest: float = 30.0) -> Rest:
    """End of a motion: from when on no marker is farther than `near` [m] from its place at rest.

    What drives the surface is taken to stay where it is, and the unknown forces to be none at
    rest. The sigma of the time is half of what lies between the ends of the motions one sigma
    nearer and one sigma farther. Raises UncertainError where these do not end within `longest`
    [s], as under forces that last, and FrameError where the model does not get there.
    """
    now, rows = track.now, track.now.layout.rows
    held = now.driven.extrapolate(0.0)[0]
    u = now.input(held, np.zeros_like(held))
    steps, dt = split(longest, config.filter.predict_step)
    belief, distances, sigmas, covariances = now.belief, [], [], []
    try:
        shape = settled(now.mesh, u, now.mesh.surface(belief.mean, u)[0], LONG)
        place = shape[now.layout.markers]
        for _ in range(steps + 1):
            cov = belief.marginals(rows)
            covariances.append(cov)
            sigmas.append(np.sqrt(np.linalg.eigvalsh(cov)[:, -1].clip(min=0.0)))
            distances.append(np.linalg.norm(belief.mean[rows] - place[now.layout.free], axis=1))
            belief = now.filter.predict(belief, now.model, u, now.noise, dt)
    except FloatingPointError as error:
        raise FrameError(f'the prediction fails: {error}') from None
    away, sigma = np.array(distances), np.array(sigmas)
    early, last, late = (_from(d, near) for d in (away - sigma, away, away + sigma))
    if late > steps:
        raise UncertainError(
            f'no end of the motion within {longest:g} s: markers are still '
            f'{away[-1].max():.2g} +- {sigma[-1].max():.2g} m from where they rest'
        )
    return Rest(last * dt, 0.5 * (late - early) * dt, place, covariances[last])


def _from(distances: FloatArray, near: float) -> int:
    """First row, of shape (steps, k), from which on all are near."""
    far = np.flatnonzero((distances > near).any(axis=1))
    return int(far[-1]) + 1 if len(far) else 0
