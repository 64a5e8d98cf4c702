"""Lines, arrows, dots and words in a picture, by OpenCV."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_predict.types import FloatArray
from cloth_predict.video.files import Picture
from cloth_predict.video.opencv import cv2

Colour = tuple[float, float, float]
"""Red, green, blue, each from 0 to 1."""
INK = (0.08, 0.08, 0.08)
SHIFT = 4
"""Binary digits of a pixel's fraction, as OpenCV draws."""
FARTHEST = 1e5
"""Coordinate [px] beyond which nothing is drawn: OpenCV counts in 32 bits."""
HEAD, HEAD_SHARE = 9.0, 0.4
"""Length of the head of an arrow [px], but no more than this share of it."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def lines(picture: Picture, segments: FloatArray, colour: Colour, width: int) -> None:
    """Draw segments [px], shape (s, 2, 2), `width` [px] wide; none that are not finite."""
    cv2.polylines(picture, list(_fine(segments)), False, bgr(colour), width, cv2.LINE_AA, SHIFT)


def arrows(picture: Picture, ends: FloatArray, colour: Colour, width: int) -> None:
    """Draw arrows [px], shape (a, 2, 2): tails and tips; none that are shorter than 1 px."""
    for tail, tip in _fine(ends):
        length = float(np.hypot(*(tip - tail))) / 2**SHIFT
        if length < 1.0:
            continue
        head = min(HEAD / length, HEAD_SHARE)
        ends_of = tail.tolist(), tip.tolist()
        cv2.arrowedLine(picture, *ends_of, bgr(colour), width, cv2.LINE_AA, SHIFT, head)


def dots(picture: Picture, places: FloatArray, colour: Colour, radius: float) -> None:
    """Draw filled circles [px], shape (d, 2)."""
    fine = round(radius * 2**SHIFT)
    for place in _fine(places).tolist():
        cv2.circle(picture, place, fine, bgr(colour), cv2.FILLED, cv2.LINE_AA, SHIFT)


def words(
    picture: Picture, line: str, at: tuple[int, int], colour: Colour = INK, size: float = 0.45
) -> None:
    """Write a line of text; at [px]: its left end, on the base line."""
    cv2.putText(picture, line, at, FONT, size, bgr(colour), 1, cv2.LINE_AA)


def bgr(colour: Colour) -> tuple[int, int, int]:
    """Return a colour as pictures have it: blue, green, red, from 0 to 255."""
    red, green, blue = (round(255 * part) for part in colour)
    return blue, green, red


def _fine(places: FloatArray) -> NDArray[np.int32]:
    """Places [px], shape (k, ...), as OpenCV counts; without those that are nowhere."""
    known = (np.abs(places) < FARTHEST).all(axis=tuple(range(1, places.ndim)))
    return np.asarray(np.rint(places[known] * 2**SHIFT).astype(np.int32))
