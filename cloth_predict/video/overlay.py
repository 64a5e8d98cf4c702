"""The augmented view: what is known of a bar, drawn over it (Goeller et al. 2015, annex F)."""

from __future__ import annotations

import numpy as np

from cloth_predict.types import FloatArray
from cloth_predict.video.calibration import Calibration
from cloth_predict.video.files import Picture
from cloth_predict.video.following import Seen
from cloth_predict.video.opencv import cv2

ESTIMATE, PREDICTION, FORCE, INK = (0, 0, 255), (255, 80, 0), (0, 220, 255), (20, 20, 20)
"""Colours: blue, green, red."""
WIDTH = 0.04
"""Width at which the bar is drawn [m]; no frame tells it."""
ARROW = 0.15
"""Length of an arrow [m] by friction by mass [m/s^2]."""
DASH = 8.0
"""Length of a dash, and of the gap after it [px]."""
SHIFT = 4
"""Binary digits of a pixel's fraction, as OpenCV draws."""
ROW = 18


def augmented(seen: Seen, calibration: Calibration) -> Picture:
    """Picture with the estimate solid, where it will rest dashed, friction, and values.

    The place of rest is shown from when it is known as well as is asked for.
    """
    picture = seen.frame.picture.copy()
    if seen.state is None or seen.ruler is None:
        return picture
    length = float(seen.ruler.L)
    if seen.certain_rest:
        _dashed(picture, calibration.to_pixels(outline(seen.certain_rest.stop.mean, length)))
    edges = calibration.to_pixels(outline(seen.state[:3], length))
    cv2.polylines(picture, [_fine(edges)], True, ESTIMATE, 2, cv2.LINE_AA, SHIFT)
    for tail, tip in calibration.to_pixels(friction_arrows(seen)):
        cv2.arrowedLine(picture, _point(tail), _point(tip), FORCE, 2, cv2.LINE_AA, SHIFT, 0.2)
    for row, line in enumerate(reversed(told(seen))):
        place = (8, picture.shape[0] - 10 - ROW * row)
        cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return picture


def outline(pose: FloatArray, length: float) -> FloatArray:
    """Corners [m] of a bar at a pose [m, rad], shape (4, 2), in order around it."""
    along = 0.5 * length * np.array([np.cos(pose[2]), np.sin(pose[2])])
    across = 0.5 * WIDTH * np.array([-np.sin(pose[2]), np.cos(pose[2])])
    corners = [along + across, along - across, -along - across, across - along]
    return np.asarray(pose[:2] + np.array(corners))


def friction_arrows(seen: Seen) -> FloatArray:
    """Tails and tips [m] of the friction at both contacts, shape (2, 2, 2)."""
    assert seen.ruler is not None
    assert seen.state is not None
    at, force = seen.ruler.contacts(seen.state), seen.ruler.friction(seen.state)
    points = np.stack([at, at + ARROW * force], axis=-1)
    return np.stack([points.real, points.imag], axis=-1)


def told(seen: Seen) -> list[str]:
    """Lines of identified values, and of the stop where it is known."""
    lines = [
        f'{name} = {value:.3f} +- {sigma:.3f}' for name, (value, sigma) in seen.values.items()
    ]
    if seen.certain_rest:
        lines.append(f'rests at {seen.certain_rest.time:.2f} s')
    return lines


def _dashed(picture: Picture, corners: FloatArray) -> None:
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        reach = float(np.linalg.norm(end - start))
        way = (end - start) / max(reach, 1.0)
        for begin in np.arange(0.0, reach, 2.0 * DASH):
            dash = [start + way * begin, start + way * min(begin + DASH, reach)]
            tail, tip = (_point(point) for point in dash)
            cv2.line(picture, tail, tip, PREDICTION, 2, cv2.LINE_AA, SHIFT)


def _fine(points: FloatArray) -> FloatArray:
    return np.asarray(np.rint(points * 2**SHIFT).astype(np.int32))


def _point(point: FloatArray) -> tuple[int, int]:
    u, v = _fine(point).tolist()
    return u, v
