"""The augmented view: what is known of a bar, drawn over it (Goeller et al. 2015, annex F)."""

from __future__ import annotations

import numpy as np

from cloth_predict.overlay import ESTIMATE, FORCE, PREDICTION, dashes, polygon
from cloth_predict.types import FloatArray
from cloth_predict.video.calibration import Calibration
from cloth_predict.video.drawing import arrows, lines, words
from cloth_predict.video.files import Picture
from cloth_predict.video.following import Seen

WIDTH = 0.04
"""Width at which the bar is drawn [m]; no frame tells it."""
ARROW = 0.15
"""Length of an arrow [m] by friction by mass [m/s^2]."""
DASH = 0.07
"""Length of a dash, and of the gap after it [m]."""
ROW = 18


def augmented(seen: Seen, calibration: Calibration) -> Picture:
    """Picture with the estimate solid, where it will rest dashed, friction, and values.

    The place of rest is shown from when it is known as well as is asked for.
    """
    picture = seen.frame.picture.copy()
    if seen.state is None or seen.ruler is None:
        return picture
    here = polygon(outline(seen.state[:3], float(seen.ruler.L)))
    for segments, colour in ((dashed_rest(seen), PREDICTION), (here, ESTIMATE)):
        lines(picture, calibration.to_pixels(segments), colour, 2)
    arrows(picture, calibration.to_pixels(friction_arrows(seen)), FORCE, 2)
    for row, line in enumerate(reversed(told(seen))):
        words(picture, line, (8, picture.shape[0] - 10 - ROW * row))
    return picture


def dashed_rest(seen: Seen) -> FloatArray:
    """Dashes [m] round the place of rest, shape (d, 2, 2); none until it is known."""
    if seen.certain_rest is None or seen.ruler is None:
        return np.zeros((0, 2, 2))
    there = outline(seen.certain_rest.stop.mean, float(seen.ruler.L))
    return dashes(polygon(there), DASH)


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
