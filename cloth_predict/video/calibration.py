"""From pixels to metres on the table, and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cloth_predict.config.ruler_video import CameraConfig
from cloth_predict.errors import ConfigError
from cloth_predict.types import FloatArray
from cloth_predict.video.opencv import cv2

MIRROR = np.diag([1.0, -1.0, 1.0])
"""In a picture v points down, on the table y points up."""
FLAT = 1e-9
"""Share of the largest singular value under which a homography has lost a dimension."""


@dataclass(frozen=True)
class Calibration:
    """A homography, shape (3, 3): from pixels u, v (centres of pixels are whole) to metres."""

    homography: FloatArray

    @classmethod
    def from_config(cls, config: CameraConfig) -> Calibration:
        """By points, or by scale and origin. Raises ConfigError for points that fix none."""
        pixels = np.reshape(config.pixels, (-1, 2)).astype(float)
        metres = np.reshape(config.metres, (-1, 2)).astype(float)
        if not len(pixels):
            return cls.by_scale(config.scale, np.array(config.origin))
        found = cls.by_two_points if len(pixels) == 2 else cls.by_points
        return found(pixels, metres)

    @classmethod
    def by_scale(cls, scale: float, origin: FloatArray) -> Calibration:
        """Of a camera that looks straight down: scale [m/px], origin [px], shape (2,)."""
        shift = np.array([[1.0, 0.0, -origin[0]], [0.0, 1.0, -origin[1]], [0.0, 0.0, 1.0]])
        return cls(np.diag([scale, scale, 1.0]) @ MIRROR @ shift)

    @classmethod
    def by_two_points(cls, pixels: FloatArray, metres: FloatArray) -> Calibration:
        """Of a camera that looks straight down, turned as it may be: points of shape (2, 2)."""
        (u, v), (x, y) = (points @ [1.0, 1.0j] for points in (pixels * [1.0, -1.0], metres))
        if u == v or x == y:
            raise ConfigError('camera.pixels, camera.metres: two points that are one')
        turn = (y - x) / (v - u)  # scale and rotation
        shift = x - turn * u
        rows = [[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag]]
        return cls(np.array([*rows, [0.0, 0.0, 1.0]]) @ MIRROR)

    @classmethod
    def by_points(cls, pixels: FloatArray, metres: FloatArray) -> Calibration:
        """Of any view of the table, by least squares: points of shape (n, 2), n at least 4."""
        found, _ = cv2.findHomography(pixels, metres)
        if found is None or _flat(np.asarray(found, float)):
            raise ConfigError(
                'camera.pixels, camera.metres: no view of a table; are three points in line?'
            )
        return cls(np.asarray(found, float))

    @cached_property
    def inverse(self) -> FloatArray:
        """From metres to pixels, shape (3, 3)."""
        return np.asarray(np.linalg.inv(self.homography))

    def to_metres(self, pixels: FloatArray) -> FloatArray:
        """Points on the table [m] of pixels, shape (..., 2) both."""
        return _mapped(self.homography, pixels)

    def to_pixels(self, metres: FloatArray) -> FloatArray:
        """Pixels of points on the table [m], shape (..., 2) both."""
        return _mapped(self.inverse, metres)

    def slopes(self, pixels: FloatArray) -> FloatArray:
        """Derivative of the metres by the pixels, shape (..., 2, 2)."""
        whole = pixels @ self.homography[:, :2].T + self.homography[:, 2]
        places = whole[..., :2, None] / whole[..., 2, None, None]
        rows, last = self.homography[:2, :2], self.homography[2, :2]
        return np.asarray((rows - places * last) / whole[..., 2, None, None])


def _mapped(homography: FloatArray, points: FloatArray) -> FloatArray:
    whole = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(whole[..., :2] / whole[..., 2:])


def _flat(homography: FloatArray) -> bool:
    columns = np.abs(homography).max(axis=0)
    sizes = np.linalg.svd(homography / np.where(columns > 0.0, columns, 1.0), compute_uv=False)
    return bool(sizes[-1] < FLAT * sizes[0])
