"""When the frames of a projector begin: vsyncs of a known rate, at a phase given or heard."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

HEARD = 15
"""Vsyncs of which the phase is the median."""
FEWEST = 5
"""Vsyncs before which nothing is said of how well they fit the rate."""
SPREAD = 0.15
"""Median distance from the phase, in periods, from which on vsyncs do not fit the rate: it is 0.25
where they come at any time."""
FARTHEST = 10.0
"""Seconds between two vsyncs after which the earlier ones tell nothing of the phase."""


@dataclass(frozen=True)
class Vsync:
    """Vsyncs at `phase` [ns] and then, and before, every 1 / `fps` [s]."""

    phase: int
    fps: float

    def after(self, time: int) -> int:
        """Time [ns] of the first vsync later than `time` [ns].

        Vsync k is at phase + floor(k T), in whole numbers: a float has 256 ns at today's date.
        """
        periods = Fraction(self.fps) / 10**9  # per ns
        since = time - self.phase
        k = -((-(since + 1) * periods.numerator) // periods.denominator)
        return self.phase + k * periods.denominator // periods.numerator


def moved_on(frame: int, after: int, fps: float) -> int:
    """Return the start [ns] of `frame`, or of the first one that follows later than `after`."""
    return frame if frame > after else Vsync(frame, fps).after(after)


class HeardVsync:
    """The phase of vsyncs that are told by messages, some of which are late, early or missing."""

    def __init__(self, fps: float, phase: int) -> None:
        """Prepare: fps [Hz]; phase [ns], which holds until the first message."""
        self._fps, self._phase = fps, phase
        self._period = 1e9 / fps
        self._heard: deque[int] = deque(maxlen=HEARD)

    def hear(self, stamp: int) -> None:
        """Take the time [ns] of a vsync; a jump back in time starts anew."""
        if self._heard and not 0 < stamp - self._heard[-1] < FARTHEST * 1e9:
            self._heard.clear()
        self._heard.append(stamp)

    @property
    def vsync(self) -> Vsync:
        """The vsyncs, by the median phase of the latest ones."""
        if not self._heard:
            return Vsync(self._phase, self._fps)
        return Vsync(self._heard[-1] + round(float(np.median(self._off()))), self._fps)

    @property
    def fits(self) -> bool:
        """Whether vsyncs come at whole numbers of periods, as far as is known."""
        if len(self._heard) < FEWEST:
            return True
        off = self._off()
        return float(np.median(np.abs(off - np.median(off)))) < SPREAD * self._period

    def _off(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """How far [ns] each is from whole periods before the last one, the nearest way round."""
        since = np.array([stamp - self._heard[-1] for stamp in self._heard], float)
        half = 0.5 * self._period
        return (since + half) % self._period - half
