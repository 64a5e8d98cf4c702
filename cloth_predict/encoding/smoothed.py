"""A surface at and between the frames of a recording, from the frames before and after."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil, nan
from typing import cast

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError
from cloth_predict.evaluation.cases import frames_of
from cloth_predict.filters.kinematic_bank import KinematicBank
from cloth_predict.filters.smoothing import Moment, smooth, smooth_bank, stepped, taken
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.observations import VisiblePositions
from cloth_predict.surface.starting import Start, Starter
from cloth_predict.tracker import NANOSECONDS, NO_POINTS
from cloth_predict.types import BoolArray, FloatArray, Gaussian, IntArray, MarkerSequence

NO_ROWS = np.zeros(0, np.int64)
WINDOW, LAG = 0.5, 0.5
"""Seconds that are smoothed at a time, and how far into the future each looks at least."""

DOUBTED = 100.0
"""Normalised innovation squared by its degrees of freedom from which on the filter is lost."""


@dataclass(frozen=True)
class Stretch:
    """A surface from a start on, without a gap: markers, the first frame that of the start.

    line [ns], shape (times,): the steps of the filter; driven: the driven markers given all
    frames, one for each of them; frame, shape (times,): that at the time, or -1; wanted, shape
    (times,): whether the surface is asked for.
    """

    start: Start
    markers: MarkerSequence
    line: IntArray
    driven: list[KinematicBank]
    frame: IntArray
    wanted: BoolArray


def smoothed(
    markers: MarkerSequence,
    config: Config,
    times: IntArray,
    progress: Callable[[int], None] = lambda done: None,
    window: float = WINDOW,
    lag: float = LAG,
) -> tuple[FloatArray, FloatArray]:
    """Positions [m] of the nodes at times [ns], (times, nodes, 3), and sigma [m], (times, nodes).

    markers: what was measured of each node, in order; stamps and times increase strictly. NaN
    where no surface is followed, and beside frames that are nowhere near it. The filter is the
    extended Kalman filter whatever `filter.kind` is, its covariance exact. Raises ConfigError for
    a body.
    """
    if config.model.is_body:
        raise ConfigError(f'model.kind {config.model.kind}: only springs move between frames')
    positions = np.full((len(times), len(markers.labels), 3), nan)
    sigma = np.full(positions.shape[:2], nan)
    exact = replace(config, filter=replace(config.filter, kind='ekf', hold=1))
    for start, stretch in starts(markers, exact):
        inside = (times >= stretch.stamps[0]) & (times <= stretch.stamps[-1])
        followed = _stretch(start, stretch, times[inside], config.filter.max_step)
        doubted: list[int] = []
        surfaces = _surfaces(followed, exact, window, lag, doubted)
        for k, (position, deviation) in zip(np.flatnonzero(inside), surfaces, strict=True):
            positions[k], sigma[k] = position, deviation
            progress(1)
        nowhere = _beside(stretch.stamps, doubted, times)
        positions[nowhere], sigma[nowhere] = nan, nan
    return positions, sigma


def _beside(stamps: IntArray, doubted: list[int], times: IntArray) -> BoolArray:
    """Which times [ns] lie between a doubted frame and the one before or after, shape (times,)."""
    found = np.zeros(len(times), bool)
    for k in doubted:
        first, last = stamps[max(k - 1, 0)], stamps[min(k + 1, len(stamps) - 1)]
        found |= (times > first) & (times < last)
    return found


def starts(markers: MarkerSequence, config: Config) -> Iterator[tuple[Start, MarkerSequence]]:
    """Yield the parts of a recording without a gap, each from the first frame that it starts at.

    What takes some frames to calibrate is then known at the first frame too.
    """
    starter = Starter(config)
    gaps = np.diff(markers.stamps) > config.filter.max_gap * NANOSECONDS
    for frames in np.split(np.arange(len(markers)), np.flatnonzero(gaps) + 1):
        _started(starter, markers, frames)
        found = _started(starter, markers, frames)
        if found is not None:
            yield found[0], frames_of(markers, frames[frames >= found[1]])


def _started(
    starter: Starter, markers: MarkerSequence, frames: IntArray
) -> tuple[Start, int] | None:
    for k in frames.tolist():
        stamp, positions, visible = markers.stamps[k], markers.positions[k], markers.visible[k]
        start = starter.offer(int(stamp), positions, visible, NO_POINTS)
        if start is not None:
            return start, k
    return None


def timeline(stamps: IntArray, times: IntArray, longest: float) -> IntArray:
    """Stamps and times [ns], and so many between that no step is over `longest` [s]; in order."""
    known = np.union1d(stamps, times)
    parts = [known[:1]]
    for begin, end in pairwise(known):
        steps = ceil((end - begin) / (longest * NANOSECONDS) - 1e-6)
        parts.append(np.rint(np.linspace(begin, end, max(steps, 1) + 1)[1:]).astype(np.int64))
    return np.concatenate(parts)


def _stretch(start: Start, markers: MarkerSequence, times: IntArray, longest: float) -> Stretch:
    line = timeline(markers.stamps, times, longest)
    frame = np.searchsorted(markers.stamps, line)
    frame[markers.stamps[np.minimum(frame, len(markers) - 1)] != line] = -1
    driven = _driven(start, markers, line, frame)
    return Stretch(start, markers, line, driven, frame, np.isin(line, times))


def _driven(
    start: Start, markers: MarkerSequence, line: IntArray, frame: IntArray
) -> list[KinematicBank]:
    """Driven markers given all frames, at each time of the line [ns]."""
    nodes, dt = start.layout.driven, np.diff(line) / NANOSECONDS
    before = [start.driven.bank]
    after = before.copy()
    for step, k in zip(dt.tolist(), frame[1:].tolist(), strict=True):
        bank = after[-1].moved(step)
        before.append(bank)
        if k >= 0:
            bank, _ = bank.updated(markers.positions[k, nodes], markers.visible[k, nodes])
        after.append(bank)
    return smooth_bank(before, after, dt)


def _surfaces(
    stretch: Stretch, config: Config, window: float, lag: float, doubted: list[int]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Positions [m], shape (markers, 3), and sigma [m], (markers,), where they are asked for.

    Frames that the filter does not believe are added to those doubted.
    """
    layout, duration = stretch.start.layout, np.ptp(stretch.line) / NANOSECONDS
    rate = len(stretch.line) / max(duration, 1e-9)
    found = smooth(_moments(stretch, config, doubted), ceil(window * rate), ceil(lag * rate))
    for belief, driven, wanted in zip(found, stretch.driven, stretch.wanted, strict=True):
        if wanted:
            position, variance = np.empty((len(layout.markers), 3)), np.empty(len(layout.markers))
            position[layout.free] = belief.mean.reshape(-1, 3)
            position[layout.driven] = driven.mean[:, 0]
            variance[layout.free] = np.diag(belief.cov).reshape(-1, 3).mean(axis=1)
            variance[layout.driven] = driven.cov[:, 0, 0]
            yield position, np.sqrt(np.maximum(variance, 0.0))


def _moments(stretch: Stretch, config: Config, doubted: list[int]) -> Iterator[Moment]:
    """Filter along the line; keeps the positions of the free markers where they are asked for."""
    now, markers, line = stretch.start, stretch.markers, stretch.line
    integrator, free = INTEGRATORS[config.filter.integrator], now.layout.free
    kept = [now.layout.rows.ravel() if wanted else NO_ROWS for wanted in stretch.wanted]
    belief, path = cast('Gaussian', now.belief), [bank.mean[:, 0] for bank in stretch.driven]
    yield Moment.of(belief, kept[0])
    for k, dt in enumerate((np.diff(line) / NANOSECONDS).tolist()):
        u = now.input(path[k], (path[k + 1] - path[k]) / dt)
        belief, tangent = stepped(integrator, belief, now.model, u, now.noise, dt)
        learnt, frame = None, stretch.frame[k + 1]
        if frame >= 0:
            seen = markers.visible[frame, free]
            obs = VisiblePositions.of_rows(
                now.layout.rows[seen].ravel(), config.filter.measurement_noise
            )
            belief, learnt = taken(belief, obs, markers.positions[frame, free[seen]].ravel())
            if learnt is not None and learnt.nis > DOUBTED * len(learnt.residual):
                doubted.append(int(frame))
        yield Moment.of(belief, kept[k + 1], tangent, learnt)
