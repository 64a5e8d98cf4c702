"""Compares published predictions with the markers that arrive at the times predicted for."""

from __future__ import annotations

import heapq
from collections import defaultdict, deque
from dataclasses import dataclass
from itertools import count
from math import nan, sqrt
from typing import NamedTuple

import numpy as np

from cloth_predict.config import Config
from cloth_predict.metrics import at_times
from cloth_predict.surface.layout import free_markers
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.types import BoolArray, FloatArray, MarkerSequence, Surface

PENDING = 10_000
"""Predictions of one kind that may wait for their time: ten seconds of them at 1 kHz."""
JUDGED = 100_000
"""Predictions of one kind in a window, which are five numbers each."""
INTERVALS = 101
"""Frames over which the usual interval is the median."""
ENOUGH = 100
"""Predictions without which nothing is said of them: a second of a mocap system."""
FEWEST_WITHIN = 0.75
"""Share of errors within 2 sigma (0.954 of a normal error) below which sigma is far too small:
the share of a normal error whose sigma is 1.7 times the predicted one."""


@dataclass(frozen=True)
class Realised:
    """How predictions turned out, over the window; the terms are those of an evaluation.

    count: predictions of a frame that were compared; error_mm, hold_mm: RMS [mm] of the 3-D
    distances of all markers, and what the last measurement would have had; coverage: share of the
    coordinates of the free nodes within 1, 2 and 3 sigma. NaN where there are none.
    """

    count: int
    error_mm: float
    hold_mm: float
    coverage: tuple[float, float, float]

    @property
    def gain(self) -> float:
        """Share of the error of the last measurement that the prediction takes away."""
        return 1.0 - self.error_mm / self.hold_mm if self.hold_mm else nan


class _Pending(NamedTuple):
    """A prediction that waits for its time; `number` makes the order of equal targets."""

    target: int
    number: int
    position: FloatArray
    sigma: FloatArray
    hold: FloatArray


class _Judged(NamedTuple):
    """Sums over the markers of one prediction: squares [m^2], and counts of coordinates."""

    target: int
    markers: int
    squares: float
    hold_squares: float
    coordinates: int
    within: tuple[int, int, int]


class LiveCheck:
    """Takes each frame, then what was predicted from it; predictions of a kind share a name."""

    def __init__(self, window: float, noise: float, free: BoolArray) -> None:
        """Prepare: window [s]; noise [m] of a coordinate of a marker; free, shape (nodes,)."""
        self._window = round(window * NANOSECONDS)
        self._noise, self._free = noise, free
        self._labels = tuple(str(node) for node in range(len(free)))
        self._reset()

    @classmethod
    def of(cls, config: Config) -> LiveCheck:
        """Prepare for the configured surface."""
        noise = config.filter.measurement_noise
        return cls(config.live_check.window, noise, free_markers(config))

    def _reset(self) -> None:
        self._frames: deque[tuple[int, FloatArray, BoolArray]] = deque(maxlen=2)
        self._intervals: deque[int] = deque(maxlen=INTERVALS)
        self._last = np.full((len(self._free), 3), nan)
        self._numbers = count()
        self._pending: dict[str, list[_Pending]] = defaultdict(list)
        self._judged: dict[str, deque[_Judged]] = defaultdict(lambda: deque(maxlen=JUDGED))

    def measured(self, stamp: int, positions: FloatArray, visible: BoolArray) -> None:
        """Take a frame: stamp [ns], positions [m], shape (nodes, 3), visible, shape (nodes,).

        Time that runs back, as at the end of a bag in a loop, starts anew.
        """
        if self._frames and stamp <= self._frames[-1][0]:
            self._reset()
        if self._frames:
            self._intervals.append(stamp - self._frames[-1][0])
        self._frames.append((stamp, positions.copy(), visible.copy()))
        self._last = np.where(visible[:, None], positions, self._last)
        for name in self._pending:
            self._judge(name)

    def predicted(self, name: str, surface: Surface) -> None:
        """Take what was predicted from the last frame, for the time of its stamp."""
        pending = self._pending[name]
        if len(pending) < PENDING:
            entry = _Pending(
                surface.stamp, next(self._numbers), surface.position, surface.sigma, self._last
            )
            heapq.heappush(pending, entry)
        self._judge(name)

    def report(self) -> dict[str, Realised]:
        """Return how the predictions of each name turned out."""
        return {name: _summed(list(self._judged[name])) for name in self._pending}

    def _judge(self, name: str) -> None:
        """Compare the predictions whose time has come."""
        pending, judged = self._pending[name], self._judged[name]
        due = []
        # a stamp within a microsecond of the target is the target, as in `at_times`
        while pending and self._frames and pending[0].target <= self._frames[-1][0] + 1000:
            due.append(heapq.heappop(pending))
        if due:
            stamps, positions, visible = (
                np.array(part) for part in zip(*self._frames, strict=True)
            )
            pair = MarkerSequence(stamps, self._labels, positions, visible)
            usual = int(np.median(self._intervals)) if self._intervals else 0
            targets = np.array([one.target for one in due])
            for one, actual, shown in zip(due, *at_times(pair, targets, usual), strict=True):
                self._compare(judged, one, actual, shown)
        while judged and judged[0].target < self._frames[-1][0] - self._window:
            judged.popleft()

    def _compare(
        self, judged: deque[_Judged], one: _Pending, actual: FloatArray, shown: BoolArray
    ) -> None:
        known = shown & np.isfinite(one.position).all(axis=1) & np.isfinite(one.hold).all(axis=1)
        if not known.any():
            return
        off, held = (one.position - actual)[known], (one.hold - actual)[known]
        free = self._free[known]
        # the measurement that the prediction is compared with has an error of its own
        limit = np.hypot(one.sigma[known], self._noise)[free, None]
        within = [int((np.abs(off[free]) <= k * limit).sum()) for k in (1, 2, 3)]
        squares = float((off**2).sum()), float((held**2).sum())
        coordinates = 3 * int(free.sum())
        judged.append(
            _Judged(one.target, len(off), *squares, coordinates, (within[0], within[1], within[2]))
        )


def _summed(judged: list[_Judged]) -> Realised:
    if not judged:
        return Realised(0, nan, nan, (nan, nan, nan))
    markers = sum(one.markers for one in judged)
    coordinates = sum(one.coordinates for one in judged)
    error, hold = (
        1e3 * sqrt(sum(squares) / markers)
        for squares in ((one.squares for one in judged), (one.hold_squares for one in judged))
    )
    one, two, three = (
        sum(inside) / coordinates if coordinates else nan
        for inside in zip(*(one.within for one in judged), strict=True)
    )
    return Realised(len(judged), error, hold, (one, two, three))


def values(found: Realised) -> dict[str, str]:
    """Name the numbers, as the diagnostics show them."""
    within = {f'coverage_{k}_sigma': share for k, share in enumerate(found.coverage, 1)}
    return {
        'realised_count': f'{found.count}',
        'realised_error_mm': f'{found.error_mm:.3f}',
        'gain_over_hold': f'{found.gain:.4f}',
        **{name: f'{share:.4f}' for name, share in within.items()},
    }


def warning(found: Realised, noise: float) -> str:
    """Say what is wrong with predictions, or nothing; noise [m] of a coordinate of a marker.

    Errors of the size of the noise are not judged: of a surface at rest the last measurement is
    the best prediction there is.
    """
    if found.count < ENOUGH or found.error_mm < 1e3 * 2 * sqrt(3) * noise:
        return ''
    if found.gain < 0:
        return (
            f'predictions are worse than the last measurement: {found.error_mm:.1f} mm, '
            f'not {found.hold_mm:.1f} mm'
        )
    if found.coverage[1] < FEWEST_WITHIN:
        return (
            f'the predicted sigma is too small: {100 * found.coverage[1]:.0f} % of the errors '
            f'lie within 2 sigma, not 95 %'
        )
    return ''
