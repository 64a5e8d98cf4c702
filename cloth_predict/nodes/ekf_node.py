"""Follows the markers and publishes the surface now and ahead."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from cloth_predict.errors import FrameError, UncertainError
from cloth_predict.formats.pointcloud import encode_surface
from cloth_predict.formats.prediction import Prediction, encode_prediction
from cloth_predict.nodes._clock import NodeClock
from cloth_predict.nodes._diagnostics import Diagnostics
from cloth_predict.nodes._intake import Intake
from cloth_predict.nodes._mesh import mesh_marker
from cloth_predict.nodes._overlay import no_markers, surface_markers
from cloth_predict.nodes._ros import LATEST_QOS, ConfiguredNode, cloud, nanoseconds, run
from cloth_predict.overlay import Shown
from cloth_predict.tracker import Step, Tracker
from cloth_predict.tracking import live_check
from cloth_predict.tracking.horizons import (
    NEXT_FRAME,
    PREDICTION,
    Backlog,
    FrameRequests,
    PipelineDelay,
    topics,
)
from cloth_predict.tracking.limits import Health
from cloth_predict.types import Surface

WAITED = 'it waited in a queue and is used, but nothing is predicted from it: frames come too fast'
VIEW = 50_000_000
"""Time [ns] from one augmented view to the next: that of a body takes some 10 ms to make."""


class EkfNode(ConfiguredNode):
    """Drives a Tracker: markers in; estimate, predictions, mesh and augmented view out."""

    def __init__(self, **options: object) -> None:
        super().__init__('ekf_node', **options)
        self._tracker = Tracker(self.config)
        self._check = live_check.LiveCheck.of(self.config)
        self._delay, self._requests = PipelineDelay(self.config), FrameRequests(self.config)
        self._backlog = Backlog(self.config)
        self._time = NodeClock(self)
        self._capture = 0
        self._step: Step | None = None
        self._health = Health('OK', 'no frame yet')
        self._refused: dict[str, str] = {}
        self._shown = -VIEW
        self._horizons = topics(self.config)
        self._predictions = {topic: self.publisher(PointCloud2, topic) for topic in self._horizons}
        self._estimate = self.publisher(PointCloud2, 'cloth/estimate')
        self._mesh = self.create_publisher(Marker, 'cloth/mesh', 1)  # as RViz asks for it
        self._overlay = self.create_publisher(MarkerArray, 'cloth/markers', 10)
        self._diagnostics = Diagnostics(self, self._values, self._findings)
        self._intake = Intake(self, self._tracker, self._diagnostics)
        self.subscribe(PointCloud2, 'markers', self._on_markers)
        if self.config.horizon_mode == 'vsync':
            self.subscribe(Header, NEXT_FRAME, self._on_request, LATEST_QOS)

    def _on_request(self, message: Header) -> None:
        self._requests.ask(nanoseconds(message.stamp))

    def _on_markers(self, message: PointCloud2) -> None:
        begin, stamp = time.perf_counter(), nanoseconds(message.header.stamp)
        age = 1e-9 * ((self._time.now() or 0) - stamp)
        step = self._intake.take(message)
        if step is None:
            return
        self._step = step
        if step.outcome == 'rewound':  # predicted is from the latest frame
            age -= 1e-9 * (self._capture - stamp)
        else:
            self._capture = stamp
        found: dict[str, Surface] = {}
        if self._backlog.leaves_out(age):
            self._diagnostics.drop('waited', WAITED)
        elif self._tracker.started:
            found = self._predict(begin, age)
            self._show(stamp, found.get(PREDICTION))
        else:
            self._health, self._refused = self._tracker.health(), {}
            self._show(stamp, None)
        latency = time.perf_counter() - begin
        if step.outcome != 'rewound':  # the check takes frames in their order
            self._check.measured(stamp, step.positions, step.visible)
            for topic, surface in found.items():
                self._check.predicted(topic, surface)
        self._diagnostics.frame(latency)

    def _predict(self, begin: float, age: float) -> dict[str, Surface]:
        """Publish the surface ahead, and then now; returns what is predicted by topic."""
        self._horizons[PREDICTION], self._refused = self._horizon(age), {}
        found = {}
        for topic, horizon in self._horizons.items():
            try:
                found[topic] = self._tracker.predict(horizon)
                if topic == PREDICTION:
                    self._publish_timed(found[topic], horizon, begin, age)
                else:
                    self._publish(self._predictions[topic], found[topic])
            except UncertainError as error:
                self._refused[topic] = str(error)
            except FrameError as error:
                self._diagnostics.drop('unpredicted', str(error))
            if topic == PREDICTION:  # of which the health speaks
                processing = time.perf_counter() - begin
                self._delay.add(age, processing)
                self._requests.add(processing)
                self._health = self._tracker.health()
        if PREDICTION in found:
            self._publish(self._estimate, self._tracker.estimate())
            self._draw(found[PREDICTION])
        return found

    def _horizon(self, age: float) -> float:
        if self.config.horizon_mode == 'vsync':
            return self._requests.horizon(self._capture, age)
        return self._delay.horizon

    def _publish_timed(self, surface: Surface, horizon: float, begin: float, age: float) -> None:
        """Publish what the projector uses: with the end of its frame, and the times it took."""
        projector = self.config.projector
        by_model = projector.motion == 'model'
        end = self._tracker.predict(horizon + 1.0 / projector.fps) if by_model else None
        filtered = age + time.perf_counter() - begin
        prediction = Prediction(surface, end, horizon, age, filtered)
        points = encode_prediction(prediction, *self.config.model.shape)
        self._predictions[PREDICTION].publish(cloud(surface.stamp, self.config.frame, points))

    def _draw(self, surface: Surface) -> None:
        triangles = self._tracker.triangles
        if len(triangles) and self._mesh.get_subscription_count():
            self._mesh.publish(mesh_marker(surface, triangles, self.config.frame))

    def _show(self, stamp: int, prediction: Surface | None) -> None:
        if not self._overlay.get_subscription_count():
            return
        if not self._tracker.started:
            self._overlay.publish(no_markers(stamp, self.config))
            return
        if abs(stamp - self._shown) < VIEW:
            return
        self._shown = stamp
        horizon, health = self._horizons[PREDICTION], self._health
        shown = Shown.of(self._tracker, prediction, horizon, health)
        self._overlay.publish(surface_markers(shown, self.config))

    def _publish(self, publisher: Publisher, surface: Surface) -> None:
        points = encode_surface(surface, *self.config.model.shape)
        publisher.publish(cloud(surface.stamp, self.config.frame, points))

    def _findings(self) -> Iterator[tuple[str, str]]:
        """What is wrong: with the surface, the clocks, and the predictions so far."""
        for topic, text in self._refused.items():
            yield ('ERROR', text) if topic == PREDICTION else ('WARN', f'{topic}: {text}')
        if self._health.level != 'OK' and PREDICTION not in self._refused:
            yield self._health.level, self._health.text
        for text in (self._delay.warning, self._requests.warning):
            if text:
                yield 'WARN', text
        for topic, realised in self._check.report().items():
            if text := live_check.warning(realised, self.config.filter.measurement_noise):
                yield 'WARN', f'{topic}: {text}'

    def _values(self) -> dict[str, object]:
        step, delay, horizon = self._step, self._delay.median, self._delay.horizon
        if self.config.horizon_mode == 'vsync':
            horizon = self._horizons[PREDICTION]
        innovation = step.innovation if step else None
        values: dict[str, object] = {
            'visible_markers': f'{step.visible.sum() if step else 0} of {self._tracker.nodes}',
            'unlabelled_markers': self._intake.unlabelled,
            'nis': f'{innovation.nis:.1f} of {len(innovation.residual)}' if innovation else 'none',
            'health': self._health.text,
            'horizon_ms': f'{1e3 * horizon:.1f}',
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
