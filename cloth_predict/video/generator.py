"""Makes the video of a sliding bar with known truth (Goeller et al. 2015, 2.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cloth_predict.config.ruler_video import CameraConfig
from cloth_predict.simulation.ruler import Slide
from cloth_predict.types import FloatArray
from cloth_predict.video.calibration import Calibration
from cloth_predict.video.files import Frame, Picture
from cloth_predict.video.opencv import cv2

TABLE = (150, 160, 165)
BAR = (40, 60, 190)
INK = (250, 250, 250)
"""Colours of table, bar and legend: blue, green, red."""
SHADE = 8.0
"""The table is darker by so many grey levels at its left than in the middle."""
STRIP = 24
"""Height [px] of the legend."""
MARGIN = 0.1
"""Room around the motion [m]."""
EXPOSURES = 8
"""Pictures of which one with motion blur is the mean."""
REST = 0.3
"""Time [s] for which the bar is filmed at rest."""


@dataclass(frozen=True)
class Filming:
    """How a bar is filmed.

    size: width and height [px]; fps [Hz]; noise: sigma of each pixel, of 255 grey levels; blur:
    part of the time between frames for which the shutter is open, around the frame's own time;
    width: of the bar [m].
    """

    size: tuple[int, int] = (960, 540)
    fps: float = 50.0
    noise: float = 2.0
    blur: float = 0.0
    width: float = 0.04


def camera_for(slide: Slide, length: float, size: tuple[int, int]) -> CameraConfig:
    """Camera that looks straight down and has the whole motion in view, below the legend."""
    poses = slide.at(np.linspace(0.0, slide.duration, 200))[:, :2]
    room = 0.5 * length + MARGIN
    low, high = poses.min(axis=0) - room, poses.max(axis=0) + room
    wide, tall = size[0], size[1] - STRIP
    scale = float(max((high - low) / [wide, tall]))
    middle = 0.5 * (low + high) / scale
    origin = (0.5 * wide - middle[0], STRIP + 0.5 * tall + middle[1])
    region = (0, STRIP, wide, tall)
    return CameraConfig(scale=scale, origin=tuple(map(float, origin)), region=region)


def film(
    slide: Slide, length: float, camera: CameraConfig, how: Filming, rng: np.random.Generator
) -> Iterator[Frame]:
    """Film a motion from its start until it has been at rest for a while."""
    calibration, empty = Calibration.from_config(camera), table(how.size)
    for number in range(int((slide.duration + REST) * how.fps) + 1):
        time = number / how.fps
        open_for = how.blur / how.fps
        offsets = np.linspace(-0.5, 0.5, EXPOSURES) * open_for if open_for else np.zeros(1)
        poses = slide.at(np.maximum(time + offsets, 0.0))[:, :3]
        picture = empty.copy()
        for pose in poses:
            _lay(picture, covered(pose, length, how.width, calibration, how.size), len(poses))
        if how.noise:
            picture += how.noise * rng.standard_normal(picture.shape, np.float32)
        shown = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
        _write_legend(shown, number, time, camera.scale)
        yield Frame(number, round(1e9 * time), shown)


def table(size: tuple[int, int]) -> FloatArray:
    """Return the empty table, shape (height, width, 3), a little darker to both sides."""
    light = 1.0 - np.linspace(-1.0, 1.0, size[0]) ** 2
    row = np.array(TABLE) + SHADE * (light[:, None] - 1.0)
    return np.broadcast_to(row, (size[1], size[0], 3)).astype(np.float32)


def covered(
    pose: FloatArray, length: float, width: float, calibration: Calibration, size: tuple[int, int]
) -> FloatArray:
    """Share of each pixel that a bar covers, shape (height, width), at a pose [m, rad]."""
    along = np.array([np.cos(pose[2]), np.sin(pose[2])])
    across = np.array([-along[1], along[0]])
    tips = calibration.to_pixels(pose[:2] + 0.5 * np.array([-length * along, length * along]))
    sides = calibration.to_pixels(pose[:2] + 0.5 * np.array([-width * across, width * across]))
    # a picture of the bar about as large as it is seen, so that its edges are a pixel soft
    shape = [max(round(float(np.linalg.norm(a - b))), 1) for a, b in (tips, sides)]
    step = np.array([length, width]) / shape
    first = 0.5 * (step - [length, width])
    moved = np.column_stack([step[0] * along, step[1] * across])
    corner = pose[:2] + first[0] * along + first[1] * across
    onto = np.vstack([np.column_stack([moved, corner]), [0.0, 0.0, 1.0]])
    bar = np.ones(shape[::-1], np.float32)
    return np.asarray(cv2.warpPerspective(bar, calibration.inverse @ onto, size))


def _lay(picture: FloatArray, cover: FloatArray, exposures: int) -> None:
    """Lay the bar over the table for one of several exposures."""
    v, u = np.nonzero(cover)
    share = cover[v, u, None] / exposures
    picture[v, u] += share * (np.array(BAR) - TABLE)


def _write_legend(picture: Picture, number: int, time: float, scale: float) -> None:
    text = f'frame {number}   t = {time:.2f} s   1 m = {1.0 / scale:.1f} px'
    picture[:STRIP] = 60
    cv2.putText(picture, text, (6, STRIP - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
