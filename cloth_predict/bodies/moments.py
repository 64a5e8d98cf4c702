"""The first guess of a body: an ellipsoid by the moments of the points (M. & T. 1993, VI)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.errors import FrameError
from cloth_predict.types import FloatArray

THIN = 1e-3
"""Spread along an axis, by that along the longest, below which there is none."""
ROOM = 0.8
"""Longest semi-axis by the scale a0: aspect ratios end at 1, and the body may turn out longer."""


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid in space: centre [m], (3,); rotation, (3, 3), from its frame; semi_axes [m]."""

    centre: FloatArray
    rotation: FloatArray
    semi_axes: FloatArray

    def in_axes(self, points: FloatArray) -> FloatArray:
        """Points [m], (m, 3), seen from the centre in its axes, each in its length."""
        return np.asarray((points - self.centre) @ self.rotation / self.semi_axes)

    @property
    def parameters(self) -> FloatArray:
        """Its 11 parameters as a superquadric: without taper or bend, the bend ready to grow."""
        scale = self.semi_axes.max() / ROOM
        return np.array([scale, *self.semi_axes / scale, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5])


def ellipsoid(points: FloatArray) -> Ellipsoid:
    """Return the ellipsoid whose evenly covered surface has the moments of points [m], (m, 3).

    Its z axis is the longest. The variance of an axis of the unit sphere is 1/3. Raises FrameError
    where the points lie on a line or in a plane, which no body fits.
    """
    centre = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - centre, full_matrices=False)
    if len(spread) < 3 or spread[1] <= THIN * spread[0]:
        raise FrameError(f'all {len(points)} points lie on a line: they show no body')
    if spread[2] <= THIN * spread[0]:
        raise FrameError(f'all {len(points)} points lie in a plane: they show no body')
    z, y = axes[0], axes[1]
    rotation = np.stack([np.cross(y, z), y, z], axis=1)
    semi_axes = np.sqrt(3.0 / len(points)) * spread[::-1]
    return Ellipsoid(centre, rotation, semi_axes)
