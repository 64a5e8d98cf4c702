"""The model between frames, beside linear and cubic interpolation: on frames that are withheld."""

from __future__ import annotations

from collections.abc import Callable
from math import nan

import numpy as np
from scipy.interpolate import CubicSpline, interp1d

from cloth_predict.config import Config
from cloth_predict.encoding.smoothed import smoothed
from cloth_predict.evaluation.cases import frames_of
from cloth_predict.surface.layout import free_markers
from cloth_predict.tracker import NANOSECONDS
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

LINES = {'linear': interp1d, 'cubic': CubicSpline}
"""By name: what makes a line through the frames in which a marker is seen."""
WARM_UP = 1.0
"""Seconds from the first frame that do not count, nor do as many frames at the end as are
withheld in a row: there the splines have neighbours on one side only."""


def errors_between(
    markers: MarkerSequence,
    reference: MarkerSequence,
    config: Config,
    every: int,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, float]:
    """RMS error [m] of the free nodes at the frames that are withheld, by method.

    markers, reference: in node order, of the same frames; every: of so many frames one is given.
    """
    given = frames_of(markers, np.arange(0, len(markers), every))
    found = {name: through(given, markers.stamps, name) for name in LINES}
    found['model'], _ = smoothed(given, config, markers.stamps, progress)
    counts = np.arange(len(markers)) % every != 0
    counts &= markers.stamps >= markers.stamps[0] + WARM_UP * NANOSECONDS
    counts &= markers.stamps < given.stamps[-2]
    seen = reference.visible[counts][:, free_markers(config)]
    errors = {
        name: (positions - reference.positions)[counts][:, free_markers(config)][seen]
        for name, positions in found.items()
    }
    return {name: float(np.sqrt((e**2).sum(axis=-1).mean())) for name, e in errors.items()}


def through(markers: MarkerSequence, times: IntArray, line: str) -> FloatArray:
    """Positions [m] at times [ns] on lines through the frames, shape (times, markers, 3).

    NaN outside the frames in which a marker is seen.
    """
    found = np.full((len(times), len(markers.labels), 3), nan)
    for k, visible in enumerate(markers.visible.T):
        at, position = markers.stamps[visible] / NANOSECONDS, markers.positions[visible, k]
        inside = (times >= markers.stamps[visible][0]) & (times <= markers.stamps[visible][-1])
        found[inside, k] = LINES[line](at, position, axis=0)(times[inside] / NANOSECONDS)
    return found
