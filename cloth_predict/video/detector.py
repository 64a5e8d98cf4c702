"""Finds a bar in a picture: its centre, length and angle on the table."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cloth_predict.config.ruler_video import CameraConfig
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.types import BoolArray, FloatArray
from cloth_predict.video.calibration import Calibration
from cloth_predict.video.files import Picture, picture_in
from cloth_predict.video.opencv import cv2

EDGE = 3
"""Pixels around those that differ clearly which may still be of the bar: soft edges."""
AROUND = 8
"""Pixels around the bar of which the outer ones tell the background there."""
SLENDER = 2.0
"""Least length of a bar by its width."""
PIXEL = 1.0 / 12.0
"""Variance of a point within its pixel [px^2]."""


class BarDetector:
    """Finds the largest slender thing that differs from the table.

    How much of each pixel the bar covers follows from how far its colour is on the way from that
    of the table to that of the bar; the moments of the covered area on the table give the bar.
    """

    def __init__(self, config: CameraConfig) -> None:
        """Prepare. Raises ConfigError, and FormatError for a background that is no picture."""
        self.calibration = Calibration.from_config(config)
        self._config = config
        self._empty: Picture | None = None
        if config.background:
            self._empty = picture_in(Path(config.background))

    def find(self, picture: Picture) -> FloatArray:
        """Return z = [x_G, y_G, L, alpha] [m, rad], alpha from -pi/2 to pi/2.

        Raises FrameError where there is no bar, or only a part of one.
        """
        left, top, right, bottom = self._bounds(picture)
        view, table = picture[top:bottom, left:right], self._table(picture)
        empty = table if table.ndim == 1 else table[top:bottom, left:right]
        # OpenCV takes one colour for all pixels as four numbers
        differs = cv2.absdiff(view, np.append(empty, 0.0) if empty.ndim == 1 else empty)
        (u, v), mask = self._largest(differs.max(axis=2) > self._config.threshold)
        part = slice(v, v + mask.shape[0]), slice(u, u + mask.shape[1])
        there = view[part].astype(float) - (empty if empty.ndim == 1 else empty[part])
        weights = _covered(there, mask)
        z, slender = self._bar(weights, np.array([left + u, top + v]))
        if slender < SLENDER:
            raise FrameError('no bar: what differs from the table is not long')
        return z

    def _bounds(self, picture: Picture) -> tuple[int, int, int, int]:
        left, top, width, height = self._config.region
        high, wide = picture.shape[:2]
        if not width or not height:
            return 0, 0, wide, high
        if left + width > wide or top + height > high:
            raise ConfigError(f'camera.region: beyond the picture of {wide} x {high} pixels')
        return left, top, left + width, top + height

    def _table(self, picture: Picture) -> FloatArray | Picture:
        """Picture of the empty table, or the colour that it has, shape (3,)."""
        if self._empty is None:
            return np.asarray(np.median(picture[::8, ::8], axis=(0, 1)))
        if self._empty.shape != picture.shape:
            raise ConfigError('camera.background: not of the size of the video')
        return self._empty

    def _largest(self, different: BoolArray) -> tuple[tuple[int, int], BoolArray]:
        """Where, left and top, and which pixels are clearly of the bar, with room around."""
        count, labels, stats, _ = cv2.connectedComponentsWithStats(different.astype(np.uint8))
        if count < 2 or stats[1:, cv2.CC_STAT_AREA].max() < self._config.least:
            raise FrameError('no bar')
        which = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        left, top, width, height = stats[which, :4]
        high, wide = different.shape
        if left == 0 or top == 0 or left + width == wide or top + height == high:
            raise FrameError('the bar is not wholly in view')
        u, v = max(left - AROUND, 0), max(top - AROUND, 0)
        return (u, v), labels[v : top + height + AROUND, u : left + width + AROUND] == which

    def _bar(self, weights: FloatArray, corner: FloatArray) -> tuple[FloatArray, float]:
        """Bar by moments of what it covers of pixels, and its length by its width."""
        v, u = np.nonzero(weights)
        pixels = np.column_stack([u, v]) + corner
        slopes = self.calibration.slopes(pixels)
        weight = weights[v, u] * np.abs(np.linalg.det(slopes))
        points = self.calibration.to_metres(pixels)
        centre = weight @ points / weight.sum()
        apart = points - centre
        spread = (weight * apart.T) @ apart / weight.sum()
        middle = slopes.mean(axis=0)
        spread = spread - PIXEL * middle @ middle.T
        (across, along), axes = np.linalg.eigh(spread)
        if along <= 0.0:
            raise FrameError('no bar')
        x, y = axes[:, 1] * np.sign(axes[0, 1] or 1.0)
        z = np.array([*centre, np.sqrt(12.0 * along), np.arctan2(y, x)])
        return z, float(np.sqrt(along / max(across, 1e-4 * along)))


def _covered(differs: FloatArray, mask: BoolArray) -> FloatArray:
    """Share of each pixel that the bar covers, up to a factor; zero away from the bar."""
    near = _grown(mask, EDGE)
    around = _grown(mask, AROUND) & ~near
    # light that changes over the table: a plane through what is seen around the bar
    v, u = np.indices(mask.shape)
    plane = np.stack([np.ones(mask.shape), u, v], axis=-1)
    light, *_ = np.linalg.lstsq(plane[around], differs[around], rcond=None)
    differs = differs - plane @ light
    towards = differs[mask].mean(axis=0)
    return np.asarray(np.where(near, differs @ towards, 0.0))


def _grown(mask: BoolArray, pixels: int) -> BoolArray:
    size = 2 * pixels + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(mask.astype(np.uint8), shape).astype(bool)
