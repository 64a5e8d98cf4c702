"""When a surface that is followed comes to rest, and in which shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config, RestConfig
from cloth_predict.errors import FrameError, UncertainError
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.linear import propagate
from cloth_predict.integrators.implicit_midpoint import ImplicitMidpoint
from cloth_predict.surface.equilibrium import settled
from cloth_predict.surface.starting import Start
from cloth_predict.tracking.envelope import Envelope, adding_up, worst_sigma
from cloth_predict.tracking.motion import NANOSECONDS, split, spread
from cloth_predict.tracking.track import Track
from cloth_predict.types import FloatArray, Gaussian, Surface

KALMAN = ExtendedKalmanFilter(ImplicitMidpoint())
"""What looks ahead, whichever filter follows: a step that damps would end the motion early."""
LONG = 100.0
"""Step [s] on the way to the shape of rest, so long that it is all but Newton's: folds in a cloth
that hangs go flat over minutes."""
LOOK = 5
"""Steps after which it is looked again whether sigma can still matter."""
TINY = 1e-12
"""Spectral density [m^2/s^3] of the noise that is added so that none of the motion is without."""


@dataclass(frozen=True)
class Rest:
    """The end of a motion.

    time [s] from the last frame on, and its sigma; surface: all markers as they rest, at that
    time. Their covariance is that of what is left of the motion.
    """

    time: float
    time_sigma: float
    surface: Surface

    def doubt(self, bounds: RestConfig) -> str:
        """Return why it is not certain yet, in a line; nothing where it is."""
        sigma = float(self.surface.sigma.max())
        for what, value, unit, name, bound in (
            ('time', self.time_sigma, 's', 'rest.time', bounds.time),
            ('shape', sigma, 'm', 'rest.position', bounds.position),
        ):
            if not value <= bound:
                return (
                    f'the sigma of the {what} at rest is {value:.2g} {unit}, above {name} of '
                    f'{bound:g} {unit}'
                )
        return ''


def rest(track: Track, config: Config) -> Rest:
    """End of a motion: from when on no marker is farther than `rest.near` from its place at rest.

    What drives the surface is taken to stay where it is, and the unknown forces to be none at
    rest. The sigma of the time is half of what lies between the ends of the motions one sigma
    nearer and one sigma farther, and the step's own. Raises UncertainError where these do not end
    within `rest.longest`, as under forces that last, and FrameError where the model does not get
    there.
    """
    bounds = config.rest
    steps, dt = split(bounds.longest, bounds.step)
    try:
        way = _Way.of(track.now, dt)
        envelope = way.envelope(steps, bounds.near)
        away = way.distances(steps)
        unclear = f'no end of the motion within {bounds.longest:g} s: markers are still'
        if (away[-1] > bounds.near).any():
            raise UncertainError(f'{unclear} {away[-1].max():.2g} m from where they rest')
        covariances = way.covariances(away, bounds.near, envelope)
    except FloatingPointError as error:
        raise FrameError(f'the prediction fails: {error}') from None
    away, sigma = away[: len(covariances)], worst_sigma(covariances)
    early, last, late = (_from(d, bounds.near) for d in (away - sigma, away, away + sigma))
    if late > steps:
        raise UncertainError(
            f'{unclear} {away[-1].max():.2g} +- {sigma[-1].max():.2g} m from where they rest'
        )
    time = max(last - 0.5, 0.0) * dt  # it ends somewhere in the step before
    place, still = way.place, np.zeros_like(way.place)
    covariance = spread(track.now, covariances[last], 0.0)
    at = track.stamp + round(time * NANOSECONDS)
    return Rest(
        time,
        float(np.hypot(0.5 * (late - early) * dt, dt / 12**0.5)),
        Surface(at, place, still, still, covariance),
    )


@dataclass(frozen=True)
class _Way:
    """Steps of dt [s] to the rest of a surface under the input u.

    still, shape (dim_x,): the state at rest; place [m], shape (markers, 3).
    """

    now: Start
    u: FloatArray
    still: FloatArray
    place: FloatArray
    dt: float

    @classmethod
    def of(cls, now: Start, dt: float) -> _Way:
        """Find the shape of rest. Raises FloatingPointError."""
        held = now.driven.extrapolate(0.0)[0]
        u = now.input(held, np.zeros_like(held))
        shape = settled(now.mesh, u, now.mesh.surface(now.belief.mean, u)[0], LONG)
        still = np.zeros(now.model.dim_x)
        still[: 3 * len(now.mesh.free)] = shape[now.mesh.free].ravel()
        return cls(now, u, still, shape[now.layout.markers], dt)

    def distances(self, steps: int) -> FloatArray:
        """Distance [m] of each free marker from its place, shape (steps + 1, free)."""
        x, rows, found = self.now.belief.mean, self.now.layout.rows, []
        for _ in range(steps + 1):
            found.append(np.linalg.norm(x[rows] - self.still[rows], axis=1))
            x = KALMAN.integrator.step(self.now.model, x, self.u, self.dt)
        if not np.isfinite(found).all():
            raise FloatingPointError('it is not finite: the model is too stiff for the step')
        return np.array(found)

    def covariances(self, away: FloatArray, near: float, envelope: Envelope | None) -> FloatArray:
        """Covariances [m^2] of the free markers, (steps + 1, free, 3, 3), or of fewer steps.

        away [m], shape (steps + 1, free): their distances. It ends where none of them, and the
        sigma of none, takes a marker out of `near` [m] any more.
        """
        now, steps, found = self.now, len(away) - 1, []
        most = near - np.maximum.accumulate(away.max(axis=1)[::-1])[::-1]
        most *= _fade(steps) ** np.arange(steps, -1, -1)
        whole = now.belief.marginals(np.arange(now.model.dim_x)[None])[0]
        belief = Gaussian(now.belief.mean, whole)
        for k in range(steps + 1):
            found.append(belief.marginals(now.layout.rows))
            if k % LOOK == 0 and envelope and envelope.keeps(belief.cov, most[k]):
                break
            belief = KALMAN.predict(belief, now.model, self.u, now.noise, self.dt)
        return np.array(found)

    def envelope(self, steps: int, near: float) -> Envelope | None:
        """Bound of what is near its rest; None where noise takes a marker out of `near` [m].

        Raises UncertainError where it does so within `steps`.
        """
        model, rows = self.now.model, self.now.layout.rows
        noise, size = self.now.noise.copy(), 3 * len(self.now.mesh.free)
        noise[size : 2 * size] = np.maximum(noise[size : 2 * size], TINY)
        _, tangent = KALMAN.integrator.step_tangent(model, self.still, self.u, self.dt)
        one = propagate(np.zeros((model.dim_x,) * 2), tangent, self.dt * noise)
        for count, cov in adding_up(_fade(steps) * tangent.push(np.eye(model.dim_x)), one):
            sigma = worst_sigma(Gaussian(self.still, cov).marginals(rows)).max()
            if sigma > near and count > steps:
                return None
            if sigma > near:
                raise UncertainError(
                    'no end of the motion: where it rests, the noise and the unknown forces that '
                    f'the filter assumes move markers by {sigma:.2g} m within '
                    f'{count * self.dt:.2g} s, more than rest.near of {near:g} m'
                )
        return Envelope.of(cov, rows)


def _fade(steps: int) -> float:
    """What an envelope forgets in a step, so that it holds for motions that last for `steps`."""
    return float(np.exp(-0.5 / max(steps, 1)))


def _from(distances: FloatArray, near: float) -> int:
    """First row, of shape (steps, k), from which on all are near."""
    far = np.flatnonzero(~(distances <= near).all(axis=1))  # a NaN is not near
    return int(far[-1]) + 1 if len(far) else 0
