"""Warps the predicted surface for the moment at which each of its rows is drawn."""

from __future__ import annotations

import sys
import time

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import SCANLINE, WARPED, decode, xyz
from cloth_predict.nodes._diagnostics import Diagnostics
from cloth_predict.nodes._ros import ConfiguredNode, cloud, nanoseconds, run
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scanout import moved, row_times
from cloth_predict.types import FloatArray


class ProjectorNode(ConfiguredNode):
    """Takes the stamp of a prediction as the start of the projector's frame."""

    def __init__(self, **options: object) -> None:
        super().__init__('projector_node', **options)
        model = self.config.model
        self._shape = rows, cols = model.shape
        self._pinhole = Pinhole.from_config(self.config.projector)
        self._times = row_times(rows, self.config.projector.fps)
        self._texture = np.meshgrid(fractions(cols), fractions(rows))
        self._vertices = self.publisher(PointCloud2, 'projector/vertices')
        self._scanlines = self.publisher(PointCloud2, 'projector/scanlines')
        self._outside = 0
        self._diagnostics = Diagnostics(self, lambda: {'vertices_outside': self._outside})
        self.subscribe(PointCloud2, 'cloth/prediction', self._on_prediction)

    def _on_prediction(self, message: PointCloud2) -> None:
        begin = time.perf_counter()
        try:
            self.check_frame(message.header)
            points = decode(message, ('x', 'y', 'z', 'vx', 'vy', 'vz'))
            if points.shape != self._shape:
                raise FrameError(f'a surface of {points.shape} nodes, expected {self._shape}')
            position = xyz(points)
            velocity = np.column_stack([points[f'v{axis}'].ravel() for axis in 'xyz'])
            if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
                raise FrameError('a node of the surface is not finite')
        except FrameError as error:
            self._diagnostics.drop('bad', str(error))
            return
        stamp, frame = nanoseconds(message.header.stamp), message.header.frame_id
        vertices = self._warp(position.reshape(*self._shape, 3), velocity.reshape(*self._shape, 3))
        self._vertices.publish(cloud(stamp, frame, vertices))
        scanlines = self._scan(position, velocity.astype(float))
        self._scanlines.publish(cloud(stamp, frame, scanlines))
        self._diagnostics.frame(time.perf_counter() - begin)

    def _warp(self, position: FloatArray, velocity: FloatArray) -> NDArray[np.void]:
        """Every vertex at the moment at which its own row is drawn, shape (rows, cols)."""
        drawn = moved(position, velocity, self._times[:, None])
        pixels = self._pinhole.project(drawn)
        projector = self.config.projector
        with np.errstate(invalid='ignore'):
            inside = (pixels >= 0) & (pixels < (projector.width, projector.height))
        self._outside = int((~inside.all(axis=-1)).sum())
        vertices = np.empty(self._shape, WARPED)
        vertices['u'], vertices['v'] = pixels[..., 0], pixels[..., 1]
        vertices['s'], vertices['t'] = self._texture
        for k, axis in enumerate('xyz'):
            vertices[axis] = drawn[..., k]
        vertices['dt'] = self._times[:, None]
        return vertices

    def _scan(self, position: FloatArray, velocity: FloatArray) -> NDArray[np.void]:
        """All vertices at the draw time of each row, shape (rows, rows * cols)."""
        pixels = self._pinhole.project(moved(position, velocity, self._times[:, None]))
        scanlines = np.empty((len(self._times), len(position)), SCANLINE)
        scanlines['u'], scanlines['v'] = pixels[..., 0], pixels[..., 1]
        scanlines['dt'] = self._times[:, None]
        return scanlines


def fractions(count: int) -> FloatArray:
    """Texture coordinates 0 to 1 of `count` nodes in a row, shape (count,)."""
    return np.linspace(0.0, 1.0, count) if count > 1 else np.zeros(1)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(ProjectorNode, args)


if __name__ == '__main__':
    sys.exit(main())
