"""A surface moved on in time: to the next frame, and ahead to a horizon."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.filters.linear import of_groups
from cloth_predict.surface.driven import DrivenNodes
from cloth_predict.surface.starting import Start
from cloth_predict.types import FloatArray, Surface

NANOSECONDS = 1e9


def moved(now: Start, driven: DrivenNodes, dt: float, config: Config) -> Start:
    """Surface dt [s] later; `driven` are the driven nodes as they are then."""
    now, belief = replace(now, driven=driven), now.belief
    steps, part = split(dt, config.filter.max_step)
    for u in _inputs(now, -dt, steps, part):
        belief = now.filter.predict(belief, now.model, u, now.noise, part)
    return replace(now, belief=belief)


def ahead(now: Start, horizon: float, config: Config) -> tuple[FloatArray, FloatArray]:
    """State `horizon` [s] ahead, shape (dim_x,), and covariances of free markers, (free, 3, 3).

    Raises FrameError where the model does not get there.
    """
    steps, dt = split(horizon, config.filter.predict_step)
    inputs, groups = _inputs(now, 0.0, steps, dt), now.layout.rows
    try:
        mean, cov = now.filter.forecast(now.belief, now.model, inputs, now.noise, dt, groups)
        owed = now.driven.spread(now.model, now.belief.mean, inputs, dt)[groups.ravel()]
    except FloatingPointError as error:
        raise FrameError(f'the prediction fails: {error}') from None
    if owed.size:
        cov = cov + of_groups(owed, owed, groups)
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        raise FrameError('the prediction is not finite: the model is too stiff for the step')
    return mean, cov


def surface(now: Start, mean: FloatArray, cov: FloatArray, stamp: int, horizon: float) -> Surface:
    """All markers, of a state that is `horizon` [s] after the frame at `stamp` [ns].

    mean, shape (dim_x,); cov [m^2], shape (free, 3, 3): positions of the free markers.
    """
    layout, driven = now.layout, now.driven.extrapolate(horizon)
    u = now.input(driven[0], driven[1])
    position, velocity = (of_all[layout.markers] for of_all in now.mesh.surface(mean, u))
    acceleration, covariance = np.zeros_like(position), spread(now, cov, horizon)
    acceleration[layout.free] = now.model.f(mean, u)[3 * len(now.mesh.free) + layout.rows]
    acceleration[layout.driven] = driven[2]
    at = stamp + round(horizon * NANOSECONDS)
    return Surface(at, position, velocity, acceleration, covariance)


def spread(now: Start, cov: FloatArray, horizon: float) -> FloatArray:
    """Covariance of each marker [m^2], shape (markers, 3, 3); cov, shape (free, 3, 3)."""
    layout = now.layout
    covariance = np.zeros((len(layout.markers), 3, 3))
    covariance[layout.free] = cov
    covariance[layout.driven] = now.driven.variances(horizon)[:, None, None] * np.eye(3)
    return covariance


def uncertainty(now: Start) -> float:
    """Root mean square of the sigma of a coordinate [m] of the free markers."""
    known = now.belief.marginals(now.layout.rows)
    return float(np.sqrt(np.trace(known, axis1=1, axis2=2).mean() / 3.0))


def split(duration: float, longest: float) -> tuple[int, float]:
    """Number and length [s] of equal steps no longer than `longest` [s], but for rounding."""
    steps = ceil(duration / longest - 1e-6)
    return steps, duration / max(steps, 1)


def _inputs(now: Start, begin: float, steps: int, dt: float) -> list[FloatArray]:
    """Input of each of `steps` steps of dt [s], the first `begin` [s] after the last frame."""
    if not steps:
        return []
    path = now.driven.path([begin + k * dt for k in range(steps + 1)])
    return [now.input(position, velocity) for position, velocity in path]
