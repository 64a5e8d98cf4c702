"""A node's health, published once per second and logged."""

from __future__ import annotations

import math
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
REPEAT = 10.0
"""Seconds before the same trouble is logged again."""
LEVELS = {
    'WARN': DiagnosticStatus.WARN,
    'ERROR': DiagnosticStatus.ERROR,
    'STALE': DiagnosticStatus.STALE,
}
"""In rising order."""


class Diagnostics:
    """Publishes a node's health once per second of real time."""

    def __init__(
        self,
        node: Node,
        values: Callable[[], dict[str, object]],
        findings: Callable[[], Iterable[tuple[str, str]]] = tuple,
        now: Callable[[], Time] | None = None,
    ) -> None:
        """Read at each publication: `values` of the node, and `now`.

        findings: troubles, each WARN or ERROR and a line.
        """
        self.counts: Counter[str] = Counter()
        self._node, self._values, self._findings = node, values, findings
        self._now = now or (lambda: node.get_clock().now().to_msg())
        self._drops: dict[str, tuple[int, str]] = {}
        self._logged: dict[str, float] = {}
        self._latencies: deque[float] = deque(maxlen=1000)
        self._frames = 0
        self._last = time.monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, 'diagnostics', 10)
        node.create_timer(1.0, self._publish, clock=STEADY)

    def frame(self, latency: float) -> None:
        """Count a frame that took `latency` [s] from its arrival to the last publication."""
        self._frames += 1
        self._latencies.append(latency)

    def drop(self, reason: str, text: str) -> None:
        """Count a frame that cannot be used, and log its cause."""
        self.counts[reason] += 1
        self._drops[reason] = self._drops.get(reason, (0, ''))[0] + 1, text
        self._log('WARN', f'frame dropped: {text}')

    def _publish(self) -> None:
        now = time.monotonic()
        rate, self._frames = self._frames / (now - self._last), 0
        self._last = now
        values: dict[str, object] = {'rate_hz': f'{rate:.1f}'}
        if self._latencies:
            for percent in (50, 99):
                value = 1e3 * np.percentile(self._latencies, percent)
                values[f'latency_p{percent}_ms'] = f'{value:.2f}'
            self._latencies.clear()
        values.update({f'{k}_frames': v for k, v in sorted(self.counts.items())})
        values.update(self._values())
        level, text = self._judged(rate)
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=text,
            hardware_id='cloth_predict',
            values=[KeyValue(key=k, value=str(v)) for k, v in values.items()],
        )
        header = Header(stamp=self._now())
        self._publisher.publish(DiagnosticArray(header=header, status=[status]))

    def _judged(self, rate: float) -> tuple[bytes, str]:
        """Level and message: the worst trouble comes first."""
        found = list(self._findings())
        for level, text in found:
            self._log(level, text)
        if self._drops:
            drops = (f'{n} {reason} ({text})' for reason, (n, text) in self._drops.items())
            found.append(('WARN', 'frames dropped: ' + ', '.join(drops)))
            self._drops = {}
        elif rate == 0:
            found.append(('STALE', 'no frames'))
        if not found:
            return DiagnosticStatus.OK, 'running'
        found.sort(key=lambda one: -list(LEVELS).index(one[0]))
        return LEVELS[found[0][0]], '; '.join(text for _, text in found)

    def _log(self, level: str, text: str) -> None:
        """Log a trouble now and then, whatever the numbers in it."""
        now, kind = time.monotonic(), re.sub(r'\d+', '#', text)
        if now - self._logged.get(kind, -math.inf) < REPEAT:
            return
        self._logged = {k: at for k, at in self._logged.items() if now - at < REPEAT}
        self._logged[kind] = now
        if level == 'ERROR':  # a line of a program logs one severity only
            self._node.get_logger().error(text)
        else:
            self._node.get_logger().warning(text)
