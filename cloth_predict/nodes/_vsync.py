"""Wakes the projector node in time for each vsync, and asks for the prediction of its frame."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator

import numpy as np
from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from cloth_predict.nodes._clock import NodeClock
from cloth_predict.nodes._diagnostics import STEADY
from cloth_predict.nodes._ros import ConfiguredNode, nanoseconds, to_time
from cloth_predict.projection.vsync import HeardVsync
from cloth_predict.tracking.horizons import NEXT_FRAME

IDLE = 0.05
"""Seconds between looks at a clock that stands still; a tick wakes as well."""
WORK = 31
"""Frames of whose making the time is known."""
QUIET = 1.0
"""Seconds without a vsync, or ten periods if that is more, after which it is told."""
STEPPED = 1_000_000_000
"""Nanoseconds off the next vsync from which on the clock was set anew."""


class FrameTimer:
    """Calls `make` with the start [ns] of each frame, so early that it is out before its vsync.

    counts: frames that were out `late`, after their vsync, and vsyncs that were `missed`.
    """

    def __init__(
        self, node: ConfiguredNode, make: Callable[[int], None], forget: Callable[[], None]
    ) -> None:
        """Begin at once, by the clock of the node; `forget` is called where that is set anew."""
        config = self._config = node.config.projector
        self.clock = NodeClock(node, ticked=self._arm, jumped=self._again)
        self.counts: Counter[str] = Counter()
        self.start: int | None = None
        """Start [ns] of the frame that comes next."""
        self._make, self._forget, self._frame_id = make, forget, node.config.frame
        self._period, self._delay = round(1e9 / config.fps), round(1e9 * config.delay)
        self._vsync, self._last = 0, None
        self._work: deque[float] = deque([0.0], maxlen=WORK)
        self._heard = HeardVsync(config.fps, round(1e9 * config.vsync_phase))
        self._quiet_since, self._off, self._told = time.monotonic(), 0.0, 0
        self._requests = node.publisher(Header, NEXT_FRAME)
        if config.vsync == 'topic':
            node.subscribe(Time, '/vsync', self._on_vsync)
        self._timer = node.create_timer(IDLE, self._on_timer, clock=STEADY)

    def _on_timer(self) -> None:
        now = self.clock.now()
        if now is not None:
            if self.start is None or abs(now - self._vsync) > STEPPED + self._early:
                self._forget()
                self._plan(now, None)
            elif now >= self._vsync - self._early:
                self._frame(self.start, now)
        self._arm()

    def _frame(self, start: int, now: int) -> None:
        """Make the frame, unless its vsync is over, and ask for the next one."""
        if now <= self._vsync:
            begin = time.perf_counter()
            self._make(start)
            self._work.append(time.perf_counter() - begin)
            now = self.clock.now() or now
            self.counts['late'] += now > self._vsync
        else:
            self.counts['missed'] += 1
        self._plan(now, self._vsync)

    def _plan(self, now: int, last: int | None) -> None:
        """Choose the vsync of the next frame, and ask for a prediction that is for it."""
        # half a period: a phase that is known better now gives no frame twice
        soonest = now + self._early
        begin = soonest if last is None else max(soonest, last + self._period // 2)
        self._vsync = self._heard.vsync.after(begin)
        if last is not None:
            self.counts['missed'] += round((self._vsync - last) / self._period) - 1
        self.start = self._vsync + self._delay
        self._requests.publish(Header(stamp=to_time(self.start), frame_id=self._frame_id))

    @property
    def _early(self) -> int:
        """How long [ns] before the vsync a frame is begun: the lead, and what making it takes."""
        work = min(float(np.percentile(self._work, 90)), 0.5 / self._config.fps)
        return round(1e9 * (self._config.lead + work * self.clock.rate))

    def _arm(self) -> None:
        """Sleep until the frame is due."""
        now, seconds = self.clock.now(), IDLE
        if now is not None and self.start is None:
            seconds = 0.0
        elif now is not None and not self.clock.stands:
            due = 1e-9 * (self._vsync - self._early - now) / max(self.clock.rate, 1e-3)
            seconds = min(due, IDLE)
        # a period of zero would starve the executor
        self._timer.timer_period_ns = max(int(1e9 * seconds), 50_000)
        self._timer.reset()

    def _again(self) -> None:
        self.start = None

    def _on_vsync(self, message: Time) -> None:
        stamp, now = nanoseconds(message), self.clock.now()
        self._quiet_since = time.monotonic()
        self._off = 0.0 if now is None else 1e-9 * (stamp - now)
        self._heard.hear(stamp)

    def findings(self) -> Iterator[tuple[str, str]]:
        """What is wrong with the vsyncs, and frames that were late since the last call."""
        failed = self.counts.total() - self._told
        self._told += failed
        if failed:
            yield 'WARN', f'{failed} frames were out after their vsync, or not at all'
        if self._config.vsync != 'topic':
            return
        quiet = time.monotonic() - self._quiet_since
        if quiet > max(QUIET, 10.0 / self._config.fps):
            yield 'WARN', f'no /vsync for {quiet:.0f} s: frames go on at projector.fps'
        elif abs(self._off) > QUIET:
            yield 'WARN', f'/vsync is {self._off:.3g} s off the clock of this node'
        elif not self._heard.fits:
            yield 'WARN', f'/vsync does not come at projector.fps ({self._config.fps:g} Hz)'
