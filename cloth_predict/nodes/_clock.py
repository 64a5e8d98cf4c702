"""The time of a node, also between the ticks of a clock that comes in steps."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

TICKS = 11
"""Ticks of which rate and distance are medians."""
ANY = JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1))
"""Every step of a clock that comes in steps is told."""


class Ticks:
    """A clock that stands still between ticks, taken to run evenly from one to the next.

    It never runs ahead of the tick that is due, so that it stands still where no tick comes.
    """

    def __init__(self) -> None:
        """Prepare; no tick yet."""
        self._ticks: deque[tuple[int, float]] = deque(maxlen=TICKS)

    def tick(self, stamp: int, steady: float) -> None:
        """Take the time [ns] that the clock shows from `steady` [s] on; a step back clears."""
        if self._ticks and stamp < self._ticks[-1][0]:
            self._ticks.clear()
        self._ticks.append((stamp, steady))

    @property
    def rate(self) -> float:
        """How fast the clock runs, 1 of real time."""
        distance, apart = self._apart()
        return 1e-9 * distance / apart if apart > 0 else 1.0

    def now(self, steady: float) -> int | None:
        """Time [ns] at `steady` [s]; None before the first tick."""
        if not self._ticks:
            return None
        stamp, since = self._ticks[-1]
        distance, _ = self._apart()
        return stamp + round(min(1e9 * self.rate * max(steady - since, 0.0), distance))

    def stands(self, steady: float) -> bool:
        """Whether the clock waits for a tick at `steady` [s]."""
        if not self._ticks:
            return True
        _, apart = self._apart()
        return bool(steady - self._ticks[-1][1] >= apart)

    def _apart(self) -> tuple[float, float]:
        """Median distance of two ticks by the clock [ns], and by real time [s]."""
        if len(self._ticks) < 2:
            return 0.0, 0.0
        stamps, steady = np.array(self._ticks, float).T
        return float(np.median(np.diff(stamps))), float(np.median(np.diff(steady)))


class NodeClock:
    """The time of a node [ns]: of the system, or of /clock with what is between its ticks."""

    def __init__(
        self,
        node: Node,
        ticked: Callable[[], None] = lambda: None,
        jumped: Callable[[], None] = lambda: None,
    ) -> None:
        """Follow the clock of a node; `ticked` is called at each tick, `jumped` at a step back."""
        self._clock, self._ticks = node.get_clock(), Ticks()
        self._ticked, self._jumped = ticked, jumped
        self._handle = self._clock.create_jump_callback(ANY, post_callback=self._on_jump)

    def now(self) -> int | None:
        """Return the time [ns]; None while there is none, before the first /clock."""
        if not self._clock.ros_time_is_active:
            return int(self._clock.now().nanoseconds)
        return self._ticks.now(time.monotonic())

    @property
    def rate(self) -> float:
        """How fast it runs, 1 of real time."""
        return self._ticks.rate if self._clock.ros_time_is_active else 1.0

    @property
    def stands(self) -> bool:
        """Whether it waits for a tick."""
        return self._clock.ros_time_is_active and self._ticks.stands(time.monotonic())

    def _on_jump(self, jump: TimeJump) -> None:
        self._ticks.tick(int(self._clock.now().nanoseconds), time.monotonic())
        if jump.delta.nanoseconds < 0:
            self._jumped()
        self._ticked()
