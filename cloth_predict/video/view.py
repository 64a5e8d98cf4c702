"""From where a recording is looked at: a camera that stands still and has all of it in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.types import FloatArray

SIZE = (800, 720)
"""Width and height of a picture [px]."""
MARGIN, BAND = 60, 110
"""What is left free round the surface, and below it, for words [px]."""
TURN, ELEVATION = 35.0, 15.0
"""Without a view that is given: degrees off the broad side of what is seen, and above it."""
DISTANCE = 4.0
"""Distance of the camera by half the diagonal of what is seen."""
OUTERMOST = 0.01
"""Share of the coordinates at either end that do not count: markers that are none."""
SMALLEST = 1e-6
"""Extent under which what is seen is a point, in metres at a distance of 1 m."""


@dataclass(frozen=True)
class View:
    """Direction to the camera [degrees]: about the vertical, and above the horizontal.

    With y upwards the azimuth counts from z to x, with z upwards from x to y.
    """

    azimuth: float
    elevation: float


class Camera(NamedTuple):
    """A camera, and how large it shows what is in the middle of its view [px/m]."""

    pinhole: Pinhole
    scale: float


def camera_for(points: FloatArray, up: FloatArray, view: View | None = None) -> Camera:
    """Camera that has points [m], shape (k, 3), in view; up, shape (3,): unit vector.

    Without a view it looks at their broad side, a little from the right and from above.
    """
    low, high = _extent(points)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    first, second = level_axes(up)
    view = view or _broad_side(points @ np.stack([first, second], axis=1))
    azimuth, elevation = np.radians([view.azimuth, view.elevation])
    level = np.cos(azimuth) * first + np.sin(azimuth) * second
    back = np.cos(elevation) * level + np.sin(elevation) * up
    right = np.cos(azimuth) * second - np.sin(azimuth) * first
    rotation = np.stack([right, np.cross(right, back), -back])
    distance = DISTANCE * max(float(np.linalg.norm(high - low)) / 2.0, SMALLEST)
    pose = rotation, distance * np.array([0.0, 0.0, 1.0]) - rotation @ ((low + high) / 2.0)
    seen = Pinhole(np.eye(3), *pose, np.zeros(8), *SIZE).project(points)
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = np.array(SIZE) - 2.0 * MARGIN - np.array([0.0, BAND])
    focal = float((room / np.maximum(high - low, SMALLEST)).min())
    centre = MARGIN + room / 2.0 - focal * (low + high) / 2.0
    intrinsic = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    return Camera(Pinhole(intrinsic, *pose, np.zeros(8), *SIZE), focal / distance)


def level_axes(up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two horizontal unit vectors at which the azimuth is 0 and 90 degrees."""
    first = np.roll(np.eye(3), 1, axis=1)[np.abs(up).argmax()]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def _broad_side(level: FloatArray) -> View:
    """View of points by their horizontal coordinates [m], shape (k, 2)."""
    centred = level - level.mean(axis=0)
    across = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    across = across * np.sign(across[np.abs(across).argmax()])
    return View(float(np.degrees(np.arctan2(across[1], across[0]))) + TURN, ELEVATION)


def _extent(points: FloatArray) -> FloatArray:
    """Lowest and highest coordinates, shape (2, n) of (k, n)."""
    return np.asarray(np.quantile(points, [OUTERMOST, 1.0 - OUTERMOST], axis=0))
