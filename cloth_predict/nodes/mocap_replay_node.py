"""Replays a recording as a mocap system would publish it: markers, and /clock."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

from cloth_predict.errors import ConfigError
from cloth_predict.evaluation.cases import split
from cloth_predict.formats.pointcloud import encode_markers
from cloth_predict.formats.recording import read
from cloth_predict.nodes._diagnostics import STEADY, Diagnostics
from cloth_predict.nodes._ros import ConfiguredNode, cloud, run, to_time

LINGER = 0.5
"""Seconds after the last frame before the node ends, so that it still arrives."""
SETTLE = 1.0
"""Seconds from the first sight of all subscribers to the first frame: discovery blocks."""
POLL = 0.02
"""Seconds between looks for subscribers."""


class MocapReplayNode(ConfiguredNode):
    """Publishes each frame when it is due; waits first until somebody listens."""

    def __init__(self, **options: object) -> None:
        super().__init__('mocap_replay_node', **options)
        replay = self.config.replay
        if not replay.path:
            raise ConfigError(f'{self.get_name()}: replay.path: no recording is given')
        recording = read(Path(replay.path)).markers
        of_nodes, others = split(recording, self.config, replay.path)
        self._markers = markers = of_nodes.beside(others)
        # what was chosen by its label is a node, whatever the mocap system called it
        self._unlabelled = markers.unlabelled
        self._unlabelled[: len(of_nodes.labels)] &= not self.config.labels
        self._rng = np.random.default_rng(replay.seed)
        seconds = (markers.stamps - markers.stamps[0]) / 1e9
        self._first = int(np.searchsorted(seconds, replay.start))
        if self._first == len(seconds):
            raise ConfigError(
                f'{self.get_name()}: replay.start: {replay.start} s is after the end of '
                f'{replay.path} ({seconds[-1]:.2f} s)'
            )
        self._due = (seconds - seconds[self._first]) / replay.rate
        self._next = self._first
        self._stamped = int(markers.stamps[self._first])
        self._publisher = self.publisher(PointCloud2, 'markers')
        self._clock_publisher = self.create_publisher(Clock, '/clock', 10)
        self._diagnostics = Diagnostics(self, self._values, now=self._replayed)
        self.create_service(SetBool, 'pause', self._on_pause)
        self.finished = False
        self._origin: float | None = None
        self._paused_at: float | None = None
        self._ends_at: float | None = None
        self._give_up = time.monotonic() + replay.timeout
        self.get_logger().info(f'waiting for {replay.subscribers} subscribers of markers')
        self._timer = self.create_timer(POLL, self._on_timer, clock=STEADY)

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._paused_at is not None or (self._origin is None and not self._ready(now)):
            return
        if self._ends_at is not None:
            self.finished = now >= self._ends_at
            return
        while self._ends_at is None and self._time_of_next() <= now:
            self._publish()
            self._advance(now)
        self._sleep(POLL if self._ends_at is not None else self._time_of_next() - now)

    def _ready(self, now: float) -> bool:
        listeners = self._publisher.get_subscription_count()
        if listeners < self.config.replay.subscribers and now < self._give_up:
            return False
        self._origin = now + (SETTLE if listeners else 0.0)
        # from the steady clock, by which frames are due, to the node's
        self._epoch = int(self.get_clock().now().nanoseconds) - round(1e9 * now)
        self._delay = 0.0
        self.get_logger().info(
            f'{self.config.replay.path}: {len(self._markers) - self._first} frames, '
            f'{len(self._markers.labels)} markers, {listeners} subscribers'
        )
        return True

    def _time_of_next(self) -> float:
        assert self._origin is not None
        return self._origin + float(self._due[self._next]) + self._delay

    def _stamp(self) -> int:
        """Time [ns] of the capture of the next frame."""
        if self.config.replay.live:
            return self._epoch + round(1e9 * (self._time_of_next() - self._delay))
        return int(self._markers.stamps[self._next])

    def _publish(self) -> None:
        markers, k, replay = self._markers, self._next, self.config.replay
        self._stamped = stamp = self._stamp()
        visible = markers.visible[k] & (self._rng.random(len(markers.labels)) >= replay.drop)
        points = encode_markers(markers.positions[k], visible, self._unlabelled)
        if replay.clock and not replay.live:
            self._clock_publisher.publish(Clock(clock=to_time(stamp)))
        self._publisher.publish(cloud(stamp, self.config.frame, points))
        self._diagnostics.frame(time.monotonic() - self._time_of_next())

    def _advance(self, now: float) -> None:
        self._next += 1
        self._delay = abs(self._rng.normal(0.0, self.config.replay.jitter))
        if self._next < len(self._markers):
            return
        self._next = self._first
        if self.config.replay.loop:
            usual = float(np.median(np.diff(self._due))) if len(self._due) > 1 else 1.0
            self._origin = (self._origin or now) + float(self._due[-1]) + usual
        else:
            self._ends_at = now + LINGER

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        now = time.monotonic()
        if request.data and self._paused_at is None:
            self._paused_at = now
        elif not request.data and self._paused_at is not None:
            if self._origin is not None:
                self._origin += now - self._paused_at
            self._paused_at = None
            self._sleep(0.0)
        response.success = True
        response.message = 'paused' if self._paused_at is not None else 'running'
        return response

    def _sleep(self, seconds: float) -> None:
        # a period of zero would starve the executor
        self._timer.timer_period_ns = max(int(seconds * 1e9), 100_000)
        self._timer.reset()

    def _replayed(self) -> Time:
        return to_time(self._stamped)

    def _values(self) -> dict[str, object]:
        return {'next_frame': f'{self._next} of {len(self._markers)}'}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(MocapReplayNode, args)


if __name__ == '__main__':
    sys.exit(main())
