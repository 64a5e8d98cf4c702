"""Follows the markers and publishes the surface now and Ts ahead."""

from __future__ import annotations

import sys
import time

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import decode_markers, encode_surface
from cloth_predict.nodes._ros import ConfiguredNode, Diagnostics, cloud, nanoseconds, run, to_time
from cloth_predict.tracker import Step, Tracker
from cloth_predict.types import Surface


class EkfNode(ConfiguredNode):
    """Drives a Tracker: markers in, estimate, prediction and mesh out."""

    def __init__(self, **options: object) -> None:
        super().__init__('ekf_node', **options)
        self._tracker = Tracker(self.config)
        self._step: Step | None = None
        self._visible = self._unlabelled = 0
        self._estimate = self.publisher(PointCloud2, 'cloth/estimate')
        self._prediction = self.publisher(PointCloud2, 'cloth/prediction')
        self._mesh = self.create_publisher(Marker, 'cloth/mesh', 1)  # as RViz asks for it
        self._triangles = triangles(self.config.model.rows, self.config.model.cols)
        self._diagnostics = Diagnostics(self, self._values, self._waiting)
        self.subscribe(PointCloud2, 'markers', self._on_markers)

    def _on_markers(self, message: PointCloud2) -> None:
        begin = time.perf_counter()
        try:
            self.check_frame(message.header)
            positions, visible, unlabelled = decode_markers(message, self._tracker.nodes)
            step = self._tracker.step(nanoseconds(message.header.stamp), positions, visible)
        except FrameError as error:
            self._diagnostics.drop('bad', str(error))
            return
        self._unlabelled += unlabelled
        if step.outcome == 'late':
            self._diagnostics.drop('late', 'its stamp is not after the one before')
            return
        self._step, self._visible = step, int(visible.sum())
        if self._tracker.started:
            try:
                self._publish()
            except FrameError as error:
                self._diagnostics.drop('unpredicted', str(error))
        self._diagnostics.frame(time.perf_counter() - begin)

    def _publish(self) -> None:
        model = self.config.model
        prediction = self._tracker.predict(self.config.horizon)
        points = encode_surface(prediction, *model.shape)
        self._prediction.publish(cloud(prediction.stamp, self.config.frame, points))
        estimate = self._tracker.estimate()
        points = encode_surface(estimate, *model.shape)
        self._estimate.publish(cloud(estimate.stamp, self.config.frame, points))
        if len(self._triangles) and self._mesh.get_subscription_count():
            self._mesh.publish(self._mesh_marker(prediction))

    def _mesh_marker(self, surface: Surface) -> Marker:
        marker = Marker(
            header=Header(stamp=to_time(surface.stamp), frame_id=self.config.frame),
            ns='cloth',
            type=Marker.TRIANGLE_LIST,
            action=Marker.ADD,
            color=ColorRGBA(r=0.9, g=0.3, b=0.2, a=0.8),
        )
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        corners = [Point(x=x, y=y, z=z) for x, y, z in surface.position.tolist()]
        marker.points = [corners[i] for i in self._triangles]
        return marker

    def _waiting(self) -> str:
        if self._tracker.started or not self._tracker.counts['waiting']:
            return ''
        return (
            f'no surface yet: {self._visible} of {self._tracker.nodes} markers seen, needed are '
            f'three and every driven node'
        )

    def _values(self) -> dict[str, object]:
        innovation = self._step.innovation if self._step else None
        counts = {f'{name}_steps': n for name, n in sorted(self._tracker.counts.items())}
        return {
            'visible_markers': f'{self._visible} of {self._tracker.nodes}',
            'unlabelled_markers': self._unlabelled,
            'nis': f'{innovation.nis:.1f} of {len(innovation.residual)}' if innovation else 'none',
            **counts,
        }


def triangles(rows: int, cols: int) -> list[int]:
    """Node indices of two triangles per cell of a grid, shape (6 cells,)."""
    node: NDArray[np.int64] = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]
    indices: list[int] = np.stack([a, c, b, b, c, d], axis=-1).ravel().tolist()
    return indices


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(EkfNode, args)


if __name__ == '__main__':
    sys.exit(main())
