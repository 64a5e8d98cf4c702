"""Follows the markers and publishes the surface now and ahead."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker

from cloth_predict.errors import FrameError, UncertainError
from cloth_predict.formats.pointcloud import decode_markers, encode_surface
from cloth_predict.nodes._diagnostics import Diagnostics
from cloth_predict.nodes._mesh import mesh_marker
from cloth_predict.nodes._ros import ConfiguredNode, cloud, nanoseconds, run
from cloth_predict.tracker import Step, Tracker
from cloth_predict.tracking import live_check
from cloth_predict.tracking.horizons import PREDICTION, PipelineDelay, topics
from cloth_predict.tracking.limits import Health
from cloth_predict.types import Surface

DROPPED = {
    'late': 'its stamp is too far before the latest one, see filter.rewind',
    'duplicate': 'there is one with its stamp already',
}


class EkfNode(ConfiguredNode):
    """Drives a Tracker: markers in, estimate, predictions and mesh out."""

    def __init__(self, **options: object) -> None:
        super().__init__('ekf_node', **options)
        self._tracker = Tracker(self.config)
        self._check = live_check.LiveCheck.of(self.config)
        self._delay = PipelineDelay(self.config)
        self._step: Step | None = None
        self._health = Health('OK', 'no frame yet')
        self._refused: dict[str, str] = {}
        self._unlabelled = 0
        self._horizons = topics(self.config)
        self._predictions = {topic: self.publisher(PointCloud2, topic) for topic in self._horizons}
        self._estimate = self.publisher(PointCloud2, 'cloth/estimate')
        self._mesh = self.create_publisher(Marker, 'cloth/mesh', 1)  # as RViz asks for it
        self._diagnostics = Diagnostics(self, self._values, self._findings)
        self.subscribe(PointCloud2, 'markers', self._on_markers)

    def _on_markers(self, message: PointCloud2) -> None:
        begin, stamp = time.perf_counter(), nanoseconds(message.header.stamp)
        age = 1e-9 * (self.get_clock().now().nanoseconds - stamp)
        try:
            self.check_frame(message.header)
            positions, visible, points = decode_markers(message, self._tracker.nodes)
            step = self._tracker.step(stamp, positions, visible, points)
        except FrameError as error:
            self._diagnostics.drop('bad', str(error))
            return
        if step.outcome in DROPPED:
            self._diagnostics.drop(step.outcome, DROPPED[step.outcome])
            return
        self._unlabelled = len(points)
        self._step = step
        found: dict[str, Surface] = {}
        if self._tracker.started:
            found = self._predict(begin, age)
        else:
            self._health, self._refused = self._tracker.health(), {}
        latency = time.perf_counter() - begin
        if step.outcome != 'rewound':  # the check takes frames in their order
            self._check.measured(stamp, step.positions, step.visible)
            for topic, surface in found.items():
                self._check.predicted(topic, surface)
        self._diagnostics.frame(latency)

    def _predict(self, begin: float, age: float) -> dict[str, Surface]:
        """Publish the surface ahead, and then now; returns what is predicted by topic."""
        self._horizons[PREDICTION], self._refused = self._delay.horizon, {}
        found = {}
        for topic, horizon in self._horizons.items():
            try:
                found[topic] = self._tracker.predict(horizon)
                self._publish(self._predictions[topic], found[topic])
            except UncertainError as error:
                self._refused[topic] = str(error)
            except FrameError as error:
                self._diagnostics.drop('unpredicted', str(error))
            if topic == PREDICTION:  # of which the health speaks
                self._delay.add(age, time.perf_counter() - begin)
                self._health = self._tracker.health()
        if PREDICTION in found:
            self._publish(self._estimate, self._tracker.estimate())
            self._draw(found[PREDICTION])
        return found

    def _draw(self, surface: Surface) -> None:
        triangles = self._tracker.triangles
        if len(triangles) and self._mesh.get_subscription_count():
            self._mesh.publish(mesh_marker(surface, triangles, self.config.frame))

    def _publish(self, publisher: Publisher, surface: Surface) -> None:
        points = encode_surface(surface, *self.config.model.shape)
        publisher.publish(cloud(surface.stamp, self.config.frame, points))

    def _findings(self) -> Iterator[tuple[str, str]]:
        """What is wrong: with the surface, the clocks, and the predictions so far."""
        for topic, text in self._refused.items():
            yield ('ERROR', text) if topic == PREDICTION else ('WARN', f'{topic}: {text}')
        if self._health.level != 'OK' and PREDICTION not in self._refused:
            yield self._health.level, self._health.text
        if self._delay.warning:
            yield 'WARN', self._delay.warning
        for topic, realised in self._check.report().items():
            if text := live_check.warning(realised, self.config.filter.measurement_noise):
                yield 'WARN', f'{topic}: {text}'

    def _values(self) -> dict[str, object]:
        step, delay = self._step, self._delay.median
        innovation = step.innovation if step else None
        values: dict[str, object] = {
            'visible_markers': f'{step.visible.sum() if step else 0} of {self._tracker.nodes}',
            'unlabelled_markers': self._unlabelled,
            'nis': f'{innovation.nis:.1f} of {len(innovation.residual)}' if innovation else 'none',
            'health': self._health.text,
            'horizon_ms': f'{1e3 * self._delay.horizon:.1f}',
            'pipeline_delay_ms': 'unknown' if delay is None else f'{1e3 * delay:.1f}',
            **{f'{name}_steps': n for name, n in sorted(self._tracker.counts.items())},
            **{f'{name}_markers': n for name, n in sorted(self._tracker.markers.items())},
        }
        for topic, realised in self._check.report().items():
            end = topic.removeprefix(PREDICTION)
            values |= {f'{k}{end}': v for k, v in live_check.values(realised).items()}
        return values


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(EkfNode, args)


if __name__ == '__main__':
    sys.exit(main())
