"""A surface moved on in time: to the next frame, and ahead to a horizon."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np

from cloth_predict.config import Config
from cloth_predict.driven import DrivenNodes
from cloth_predict.errors import FrameError
from cloth_predict.filters.linear import of_groups
from cloth_predict.starting import Start
from cloth_predict.types import FloatArray, IntArray, Surface

NANOSECONDS = 1e9


def moved(now: Start, driven: DrivenNodes, dt: float, config: Config) -> Start:
    """Surface dt [s] later; `driven` are the driven nodes as they are then."""
    now, belief = replace(now, driven=driven), now.belief
    steps, part = split(dt, config.filter.max_step)
    for u in _inputs(now, -dt, steps, part):
        belief = now.filter.predict(belief, now.model, u, now.noise, part)
    return replace(now, belief=belief)


def ahead(now: Start, horizon: float, config: Config) -> tuple[FloatArray, FloatArray]:
    """State `horizon` [s] ahead, shape (dim_x,), and covariances of free nodes, (free, 3, 3).

    Raises FrameError where the model does not get there.
    """
    steps, dt = split(horizon, config.filter.predict_step)
    inputs, groups = _inputs(now, 0.0, steps, dt), rows(now)
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
    """All nodes, of a state that is `horizon` [s] after the frame at `stamp` [ns].

    mean, shape (dim_x,); cov [m^2], shape (free, 3, 3): positions of the free nodes.
    """
    mesh, driven = now.mesh, now.driven.extrapolate(horizon)
    u, size = mesh.input(driven[0], driven[1]), 3 * len(mesh.free)
    position, velocity = mesh.surface(mean, u)
    acceleration, covariance = np.zeros_like(position), np.zeros((len(position), 3, 3))
    acceleration[mesh.free] = now.model.f(mean, u)[size : 2 * size].reshape(-1, 3)
    acceleration[mesh.driven] = driven[2]
    covariance[mesh.free] = cov
    covariance[mesh.driven] = now.driven.variances(horizon)[:, None, None] * np.eye(3)
    at = stamp + round(horizon * NANOSECONDS)
    return Surface(at, position, velocity, acceleration, covariance)


def rows(now: Start) -> IntArray:
    """Position rows of the state by free node, shape (free, 3)."""
    return np.arange(3 * len(now.mesh.free)).reshape(-1, 3)


def split(duration: float, longest: float) -> tuple[int, float]:
    """Number and length [s] of equal steps no longer than `longest` [s], but for rounding."""
    steps = ceil(duration / longest - 1e-6)
    return steps, duration / max(steps, 1)


def _inputs(now: Start, begin: float, steps: int, dt: float) -> list[FloatArray]:
    """Input of each of `steps` steps of dt [s], the first `begin` [s] after the last frame."""
    if not steps:
        return []
    path = now.driven.path([begin + k * dt for k in range(steps + 1)])
    return [now.mesh.input(position, velocity) for position, velocity in path]
