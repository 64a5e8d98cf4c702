"""Follows the markers and publishes when, and in which shape, the surface will rest.

A node beside the EKF node, with a tracker and a process of its own: to look ahead to the end of a
motion takes longer than a frame, and the predictions for the projector must not wait for it. Here
the frames wait meanwhile, in a long queue, and are caught up with.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.formats.prediction import encode_rest
from cloth_predict.nodes._diagnostics import Diagnostics
from cloth_predict.nodes._intake import Intake
from cloth_predict.nodes._ros import ConfiguredNode, cloud, nanoseconds, run
from cloth_predict.tracker import Tracker
from cloth_predict.tracking.settling import Rest

TOPIC = 'cloth/rest'
PATIENT_QOS = QoSProfile(depth=5000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
"""Frames of many seconds, so that none is lost while the node looks ahead."""
SHARE = 0.5
"""Of the time, at most this goes into looking ahead, and the rest into following."""


class RestNode(ConfiguredNode):
    """Drives a Tracker: markers in, the shape of rest out, once per `rest.period`."""

    def __init__(self, **options: object) -> None:
        super().__init__('rest_node', **options)
        self._tracker = Tracker(self.config)
        self._published = self.create_publisher(PointCloud2, TOPIC, 10)
        self._diagnostics = Diagnostics(self, self._values, self._findings)
        self._intake = Intake(self, self._tracker, self._diagnostics)
        self._took = 0.0
        self._begin(0)
        self.subscribe(PointCloud2, 'markers', self._on_markers, PATIENT_QOS)

    def configure(self, values: dict[str, Any]) -> None:
        """Build the configuration, of a surface that can rest."""
        super().configure(values)
        kind = self.config.model.kind
        if self.config.model.is_body:
            raise ConfigError(f'{self.get_name()}: model.kind: a {kind} tells no rest')

    def _begin(self, stamp: int) -> None:
        """Begin anew, as with another recording; at first nothing is known of velocities."""
        self._due = stamp + round(1e9 * self.config.rest.period)
        self._found: Rest | None = None
        self._told: Rest | None = None
        self._doubt = ''

    def _on_markers(self, message: PointCloud2) -> None:
        begin, stamp = time.perf_counter(), nanoseconds(message.header.stamp)
        step = self._intake.take(message)
        if step is None:
            return
        if step.outcome in ('started', 'restarted', 'waiting'):
            self._begin(stamp)
        elif stamp >= self._due:
            self._look(stamp)
        self._diagnostics.frame(time.perf_counter() - begin)

    def _look(self, stamp: int) -> None:
        """Look ahead from a frame, and publish what is certain and new."""
        begin = time.perf_counter()
        try:
            self._found = self._tracker.rest()
            self._doubt = self._found.doubt(self.config.rest)
        except FrameError as error:
            self._found, self._doubt = None, str(error)
        self._took = time.perf_counter() - begin
        self._due = stamp + round(1e9 * max(self.config.rest.period, self._took / SHARE))
        if self._found is None or self._doubt or not self._is_new(self._found):
            return
        self._told = self._found
        surface, time_sigma = self._found.surface, self._found.time_sigma
        points = encode_rest(surface, time_sigma, *self.config.model.shape)
        self._published.publish(cloud(surface.stamp, self.config.frame, points))

    def _is_new(self, found: Rest) -> bool:
        """Whether it says more than what was told last.

        Of a surface that rests already that is so where it was to rest later, or elsewhere.
        """
        if self._told is None or found.time > 0:
            return True
        now, told = found.surface, self._told.surface
        moved = np.linalg.norm(now.position - told.position, axis=1).max()
        return bool(now.stamp < told.stamp or moved > self.config.rest.position)

    def _findings(self) -> Iterator[tuple[str, str]]:
        """Why no rest is told."""
        if not self._tracker.started:
            health = self._tracker.health()
            yield health.level, health.text
        elif self._doubt:
            yield 'WARN', f'no rest: {self._doubt}'

    def _values(self) -> dict[str, object]:
        counts = sorted(self._tracker.counts.items())
        values: dict[str, object] = {f'{name}_steps': n for name, n in counts}
        values['look_ms'] = f'{1e3 * self._took:.1f}'
        if self._found is not None:
            values['time_to_rest'] = f'{self._found.time:.3f}'
            values['time_sigma'] = f'{self._found.time_sigma:.2g}'
            values['position_sigma'] = f'{self._found.surface.sigma.max():.2g}'
        return values


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RestNode, args)


if __name__ == '__main__':
    sys.exit(main())
