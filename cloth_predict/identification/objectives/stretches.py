"""Stretches of a recording that the model, left to itself, is to follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.evaluation.cases import Case, frames_of
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.objectives.trajectory import Scenario, Trajectory
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.surface.assembly import build_mass_spring
from cloth_predict.surface.layout import Layout
from cloth_predict.surface.starting import Start, Starter
from cloth_predict.tracking.motion import NANOSECONDS, split
from cloth_predict.types import FloatArray, MarkerSequence

REACH = 5
"""Frames to both sides of a start through which its position and velocity are fitted."""
DEGREE = 2
"""Of the polynomials that are fitted: position, velocity, acceleration."""
FEWEST = 2 * DEGREE + 1
"""Frames that have to show a marker for that."""
SHORTEST = 5
"""Frames after the start of a stretch without which it tells nothing."""


@dataclass(frozen=True)
class Rebuilt:
    """Builds the model of one recording again, with other parameters.

    surface [m], shape (markers, 3); rest_length [m], shape (springs,), before any prestretch.
    """

    surface: FloatArray
    layout: Layout
    rest_length: FloatArray

    def __call__(self, config: Config) -> MassSpring:
        """Return the model of a configuration."""
        return build_mass_spring(config, self.surface, self.layout, self.rest_length)


def trajectories(case: Case, space: Space, window: float, alpha: float = 0.0) -> Trajectory:
    """Cut a recording into stretches of `window` [s], each a scenario with a start of its own.

    Positions and velocities at a start are those of parabolas through the markers around it.
    Raises FormatError where the recording is too short or too gappy.
    """
    config = space.config
    markers = case.markers if case.ahead.all() else frames_of(case.markers, case.ahead)
    start, first, surface = _started(case, config)
    base = start.mesh.springs.rest_length / (1.0 - config.model.prestretch)
    build = Rebuilt(surface, start.layout, base)
    scenarios, k = [], first + REACH
    while k + SHORTEST < len(markers):
        found = _scenario(case.name, markers, k, window, start.layout, config)
        if found is None:
            k += 1
            continue
        scenario, k = found
        scenarios.append(scenario)
    if not scenarios:
        raise FormatError(
            f'{case.name}: no stretch to follow: the recording is too short, or too gappy (a '
            f'start needs every marker in {FEWEST} of {2 * REACH + 1} frames)'
        )
    return Trajectory(space, tuple(scenarios), build, start.layout.topology, alpha)


def _started(case: Case, config: Config) -> tuple[Start, int, FloatArray]:
    """Start, the frame of it, and its markers [m], shape (markers, 3)."""
    starter = Starter(config)
    for k, stamp in enumerate(case.markers.stamps.tolist()):
        positions, visible, points = case.frame(k, associates=False)
        if (start := starter.offer(stamp, positions, visible, points)) is not None:
            seen = start.belief.mean[: 3 * len(start.mesh.free)].reshape(-1, 3)
            driven = start.driven.extrapolate(0.0)[0]
            of_mesh = np.empty((start.mesh.nodes, 3))
            of_mesh[start.mesh.free] = seen
            of_mesh[start.mesh.driven] = start.layout.drive @ driven
            return start, k, of_mesh[start.layout.markers]
    raise FormatError(f'{case.name}: the surface does not start: {starter.reason}')


def _scenario(
    name: str, markers: MarkerSequence, k: int, window: float, layout: Layout, config: Config
) -> tuple[Scenario, int] | None:
    """Scenario from frame k on, and the frame of the next one; None where none starts here."""
    begun = _fitted(markers, k)
    last = _end(markers, k, window, layout, config)
    if begun is None or last < k + SHORTEST:
        return None
    stamps = markers.stamps[k : last + 1]
    at = (stamps - stamps[0]) / NANOSECONDS
    parts = [split(float(dt), config.filter.max_step)[0] for dt in np.diff(at)]
    times = np.interp(np.arange(sum(parts) + 1), np.concatenate([[0], np.cumsum(parts)]), at)
    driven = _filled(at, markers.positions[k : last + 1, layout.driven], times)
    if config.anchors.motion == 'fixed':
        driven[:] = driven.mean(axis=0)  # what moves them is noise
    target = np.full((len(times), len(layout.free), 3), np.nan)
    target[np.concatenate([[0], np.cumsum(parts)])] = markers.positions[k : last + 1, layout.free]
    target[0] = np.nan  # the start is given
    position, velocity = (layout.between @ part for part in begun)
    driven_mesh = layout.drive @ driven
    compared = layout.markers[layout.free]
    label = f'{name} from {(stamps[0] - markers.stamps[0]) / NANOSECONDS:.2f} s'
    return Scenario(label, times, position, velocity, driven_mesh, target, compared), last


def _fitted(markers: MarkerSequence, k: int) -> tuple[FloatArray, FloatArray] | None:
    """Positions [m] and velocities [m/s], (markers, 3), at frame k; None where too few show."""
    around = slice(max(k - REACH, 0), k + REACH + 1)
    at = (markers.stamps[around] - markers.stamps[k]) / NANOSECONDS
    seen = markers.visible[around]
    if (seen.sum(axis=0) < FEWEST).any():
        return None
    terms = np.vander(at, DEGREE + 1, increasing=True)
    found = np.empty((2, seen.shape[1], 3))
    for i in range(seen.shape[1]):
        own = seen[:, i]
        fit = np.linalg.lstsq(terms[own], markers.positions[around, i][own], rcond=None)[0]
        found[:, i] = fit[:2]
    return found[0], found[1]


def _end(markers: MarkerSequence, k: int, window: float, layout: Layout, config: Config) -> int:
    """Last frame of a stretch from frame k: no gap of time or of a driven marker is too long."""
    stamps, longest = markers.stamps, config.filter.max_gap * NANOSECONDS
    stop = np.searchsorted(stamps, stamps[k] + round(window * NANOSECONDS), 'right') - 1
    seen = np.asarray(markers.visible[:, layout.driven].all(axis=1), bool)
    if not seen[k]:
        return k
    last = k
    for j in range(k + 1, int(stop) + 1):
        if stamps[j] - stamps[last] > longest:
            break
        last = j if seen[j] else last
    return last


def _filled(at: FloatArray, driven: FloatArray, times: FloatArray) -> FloatArray:
    """Driven markers [m] at times [s], shape (times, driven, 3), straight between frames."""
    found = np.empty((len(times), *driven.shape[1:]))
    for i in range(driven.shape[1]):
        known = np.isfinite(driven[:, i]).all(axis=1)
        for c in range(3):
            found[:, i, c] = np.interp(times, at[known], driven[known, i, c])
    return found
