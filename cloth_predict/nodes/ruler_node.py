"""Follows a sliding bar in the pictures of a camera, and tells where it will rest."""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import Image
from visualization_msgs.msg import MarkerArray

from cloth_predict.config.ruler_video import build_ruler_video
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.nodes._diagnostics import Diagnostics
from cloth_predict.nodes._images import QOS, TOPIC, picture_of
from cloth_predict.nodes._ros import ParameterNode, nanoseconds, run
from cloth_predict.nodes._ruler import markers, pose
from cloth_predict.tracking.ruler_assembly import ANGLE, STATES
from cloth_predict.video.files import Frame
from cloth_predict.video.following import Rest, Seen, VideoFollower

POSE = np.array([STATES.index('x_G'), STATES.index('y_G'), ANGLE])
"""Where the joint state has the pose of the bar."""


class RulerNode(ParameterNode):
    """Publishes the estimate of each frame, and the stop from when it is known well enough."""

    def __init__(self, **options: object) -> None:
        super().__init__('ruler_node', **options)
        self._estimate = self.create_publisher(PoseWithCovarianceStamped, 'ruler/estimate', 10)
        self._stop = self.create_publisher(PoseWithCovarianceStamped, 'ruler/stop', 10)
        self._markers = self.create_publisher(MarkerArray, 'ruler/markers', 10)
        self._diagnostics = Diagnostics(self, self._values, self._findings)
        self._first: int | None = None
        self._seen: Seen | None = None
        self._told: Rest | None = None
        self.create_subscription(Image, TOPIC, self._on_image, QOS)

    def configure(self, values: dict[str, Any]) -> None:
        """Build the configuration."""
        self.config = build_ruler_video(values, self.get_name())
        self._follower = VideoFollower(self.config)

    def _on_image(self, message: Image) -> None:
        begin, stamp = time.perf_counter(), nanoseconds(message.header.stamp)
        self._first = stamp if self._first is None else self._first
        number = round(1e-9 * (stamp - self._first) * self.config.video.fps)
        try:
            seen = self._follower.see(Frame(number, stamp, picture_of(message)))
        except (FrameError, ConfigError) as error:
            self._diagnostics.drop('bad', str(error))
            return
        for fault in seen.sighting.faults:
            self.get_logger().warning(fault)
        if seen.outcome == 'late':
            self._diagnostics.drop('late', f'stamp {1e-9 * stamp:.3f} s is not after the last')
            return
        self._seen = seen
        if seen.belief is not None:
            self._publish(seen)
        self._diagnostics.frame(time.perf_counter() - begin)

    def _publish(self, seen: Seen) -> None:
        assert seen.belief is not None
        frame, belief = self.config.frame, seen.belief
        cov = belief.cov[np.ix_(POSE, POSE)]
        self._estimate.publish(pose(seen.frame.stamp, frame, belief.mean[POSE], cov))
        rest = seen.certain_rest
        if rest is not None and rest is not self._told:
            at = round(1e9 * rest.time)
            self._stop.publish(pose(at, frame, rest.stop.mean, rest.stop.cov))
        self._told = rest
        if self._markers.get_subscription_count():
            self._markers.publish(markers(seen, frame))

    def _findings(self) -> list[tuple[str, str]]:
        health = self._follower.tracker.health()
        return [] if health.level == 'OK' else [(health.level, health.text)]

    def _values(self) -> dict[str, object]:
        counts = self._follower.tracker.counts
        values: dict[str, object] = {f'{name}_steps': n for name, n in sorted(counts.items())}
        for name, (value, sigma) in (self._seen.values if self._seen else {}).items():
            values |= {name: f'{value:.5g}', f'{name}_sigma': f'{sigma:.2g}'}
        return values


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RulerNode, args)


if __name__ == '__main__':
    sys.exit(main())
