"""A sliding bar at and between the frames of a recording, from the frames before and after."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.encoding.bar import bar_between, ends_of
from cloth_predict.filters.smoothing import Moment, smooth, stepped, taken
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import SPIN, VELOCITY
from cloth_predict.models.with_parameters import Parametrised
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.ruler import NO_INPUT, RulerTracker
from cloth_predict.tracking.ruler_assembly import (
    ANGLE,
    MEASURED,
    first_belief,
    joint_model,
    observation,
    process_noise,
    unwrapped,
)
from cloth_predict.types import FloatArray, Gaussian, IntArray, MarkerSequence

ROUNDS = 4
"""Passes, each linearised about what the one before found (Gauss and Newton): in the first frames
velocities and parameters are hardly known, and what is linearised about a wrong guess is wrong."""


@dataclass
class Stretch:
    """One motion of a bar: what was believed of each frame [ns], z, and parameters of it."""

    frames: dict[int, FloatArray] = field(default_factory=dict)
    parameters: FloatArray = field(default_factory=lambda: np.zeros(0))


def smoothed_bar(markers: MarkerSequence, config: RulerConfig, times: IntArray) -> FloatArray:
    """Places [m] of both ends at times [ns], which increase, shape (times, 2, 3).

    NaN before the first and after the last frame of each motion. Parameters are first found by the
    tracker; about them an extended filter runs forward, and what the future says comes back.
    """
    found = np.full((len(times), 2, 3), np.nan)
    for stretch in _stretches(markers, config):
        stamps = np.array(list(stretch.frames))
        inside = (times >= stamps[0]) & (times <= stamps[-1])
        line = np.union1d(times[inside], stamps)
        known: list[Gaussian] = []
        for _ in range(ROUNDS):
            known = list(smooth(_forward(stretch, config, line, known)))
        rows = np.searchsorted(line, times[inside])
        found[inside] = [ends_of(known[row].mean[MEASURED]) for row in rows]
    return found


def _stretches(markers: MarkerSequence, config: RulerConfig) -> list[Stretch]:
    """What the tracker believed, motion by motion."""
    tracker, found = RulerTracker(config), list[Stretch]()
    for stamp, ends, seen in zip(
        markers.stamps.tolist(), markers.positions, markers.visible, strict=True
    ):
        z = bar_between(ends) if seen.all() else None
        outcome = tracker.step(stamp, z).outcome
        if outcome in ('started', 'restarted'):
            found.append(Stretch())
        if z is not None and outcome in ('started', 'restarted', 'updated'):
            found[-1].frames[stamp] = z
            found[-1].parameters = tracker.belief.mean[tracker.model.at]
    return found


def _forward(
    stretch: Stretch, config: RulerConfig, line: IntArray, known: list[Gaussian]
) -> list[Moment]:
    """The filter at each time [ns], the frames of the stretch among them.

    known: what a pass before found at these times, about which the steps are linearised; of none
    it is what the filter has come to.
    """
    model, method = joint_model(config), Parametrised(Sliding(config.step))
    obs, noise, rows = observation(config), process_noise(config), np.arange(model.dim_x)
    belief, tangent = _first(stretch, config), None
    moments: list[Moment] = []
    for k, stamp in enumerate(line.tolist()):
        if k:
            dt = (stamp - int(line[k - 1])) / NANOSECONDS
            about = known[k - 1].mean if known else None
            belief, tangent = stepped(method, belief, model, NO_INPUT, noise, dt, about)
        learnt = None
        if stamp in stretch.frames:
            angle = known[k].mean[ANGLE] if known else belief.mean[ANGLE]
            belief, learnt = taken(belief, obs, unwrapped(config, stretch.frames[stamp], angle))
        moments.append(Moment.of(belief, rows, tangent, learnt))
    return moments


def _first(stretch: Stretch, config: RulerConfig) -> Gaussian:
    """The belief before the first frame, as fast as the first two say.

    About a bar at rest, as the tracker's is, no derivative tells what a velocity does.
    """
    model, stamps = joint_model(config), list(stretch.frames)
    first = stretch.frames[stamps[0]]
    prior = first_belief(config, model, first)
    own = prior.mean[model.own].copy()
    if len(stamps) > 1:
        dt = (stamps[1] - stamps[0]) / NANOSECONDS
        moved = (unwrapped(config, stretch.frames[stamps[1]], first[ANGLE]) - first) / dt
        own[VELOCITY], own[SPIN] = moved[:2], moved[ANGLE]
    return Gaussian(model.joint(own, stretch.parameters), prior.cov)
