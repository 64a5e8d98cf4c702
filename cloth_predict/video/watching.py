"""What a video shows of a bar, frame by frame, and each of its faults, said once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.errors import FrameError
from cloth_predict.types import FloatArray
from cloth_predict.video.detector import BarDetector
from cloth_predict.video.files import Frame, Picture
from cloth_predict.video.opencv import cv2

STILL = 1.0
"""Pixels: a bar that moved by more from one frame to the next does not stop at once."""

ALIKE = 10
"""Grey levels by which a picture that is shown again may differ after compression (5 were seen).
The edge of a bar that moves by half a pixel changes by more, at half of its contrast."""


@dataclass(frozen=True)
class Sighting:
    """What a frame shows: z = [x_G, y_G, L, alpha] [m, rad] or None; new faults, a line each."""

    z: FloatArray | None
    faults: tuple[str, ...]


class Watcher:
    """Sees the frames of one video in turn; a fault that goes on is said in its first frame."""

    def __init__(self, detector: BarDetector) -> None:
        self._detector = detector
        self._last: Frame | None = None
        self._said = ''
        self._ends: FloatArray | None = None
        self._moving = False

    def see(self, frame: Frame) -> Sighting:
        """Find the bar in the next frame."""
        faults = []
        last, self._last = self._last, frame
        if last is not None and frame.number > last.number + 1:
            faults.append(_missing(last.number + 1, frame.number - 1))
        z, fault = None, ''
        if last is not None and self._moving and _same(last.picture, frame.picture):
            fault = 'the picture of the frame before again, though the bar moves'
        else:
            try:
                z = self._detector.find(frame.picture)
            except FrameError as error:
                fault = str(error)
            self._moving = self._moved(z)
        if fault and fault != self._said:
            faults.append(f'frame {frame.number}: {fault}')
        self._said = fault
        return Sighting(z, tuple(faults))

    def _moved(self, z: FloatArray | None) -> bool:
        """Whether an end of the bar is elsewhere in this picture than where it was seen last."""
        before, self._ends = self._ends, None
        if z is None:
            return False
        half = 0.5 * z[2] * np.array([np.cos(z[3]), np.sin(z[3])])
        ends = self._detector.calibration.to_pixels(z[:2] + np.array([half, -half]))
        self._ends = ends
        if before is None:
            return False
        ways = (np.abs(ends - other).max() for other in (before, before[::-1]))
        return bool(min(ways) > STILL)


def _same(before: Picture, after: Picture) -> bool:
    return before.shape == after.shape and int(cv2.absdiff(before, after).max()) <= ALIKE


def _missing(first: int, last: int) -> str:
    return (
        f'frame {first} is missing' if first == last else f'frames {first} to {last} are missing'
    )
