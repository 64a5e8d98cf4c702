"""The parameters of a video of a sliding bar: camera, frames and the bar."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cloth_predict.config.build import build_group, parameters_in
from cloth_predict.config.parameter import param
from cloth_predict.config.ruler import RulerConfig
from cloth_predict.errors import ConfigError


@dataclass(frozen=True)
class CameraConfig:
    """From pixels to metres on the table, and what in a picture is the bar."""

    pixels: tuple[float, ...] = param(
        (),
        'points on the table as the picture shows them: u, v, u, v, ...; two for a camera that '
        'looks straight down, four or more for any view; without them `scale` and `origin` count',
        'px',
    )
    metres: tuple[float, ...] = param((), 'the same points on the table: x, y, x, y, ...', 'm')
    scale: float = param(0.005, 'metres on the table by pixels', 'm/px', above=0)
    origin: tuple[float, ...] = param(
        (0.0, 0.0), 'where the picture shows x = y = 0; x is to the right, y up', 'px', length=2
    )
    region: tuple[int, ...] = param(
        (0, 0, 0, 0),
        'part of the picture that shows the table: left, top, width, height; 0, 0, 0, 0 is all',
        'px',
        low=0,
        length=4,
    )
    background: str = param(
        '', 'picture of the table without the bar; without it the table has one colour'
    )
    threshold: float = param(
        30.0, 'difference from the background from which on a pixel is of the bar', above=0
    )
    least: int = param(40, 'least size of a bar in the picture', 'px', low=1)


@dataclass(frozen=True)
class VideoConfig:
    """The frames of a video, what is predicted from them, and how a node publishes them."""

    path: str = param('', 'MP4 file or folder of numbered PNG files')
    fps: float = param(50.0, 'frames per second of a folder of PNG files', 'Hz', above=0)
    stop_period: float = param(
        0.1, 'time between predictions of where the bar will rest', 's', above=0
    )
    speed: float = param(1.0, 'speed of replay', above=0)
    subscribers: int = param(1, 'subscribers to wait for', low=0)


@dataclass(frozen=True)
class RulerVideoConfig:
    """A bar that is followed in a video; has a parameter file of its own."""

    frame: str = param('table', 'frame_id of all messages')
    ruler: RulerConfig = field(default_factory=RulerConfig)
    camera: CameraConfig = CameraConfig()
    video: VideoConfig = VideoConfig()


def build_ruler_video(values: dict[str, Any], source: str) -> RulerVideoConfig:
    """Build it from nested mappings; `source` names their origin in errors."""
    config = build_group(RulerVideoConfig, values, source)
    for name in ('length', 'contact', 'mu'):
        bounds = f'ruler.{name}_low', f'ruler.{name}_high'
        low, first, high = (getattr(config.ruler, name + end) for end in ('_low', '', '_high'))
        if low > high:
            raise ConfigError(f'{source}: {bounds[0]}: {low:g} is above {bounds[1]}, {high:g}')
        if not low <= first <= high:
            raise ConfigError(
                f'{source}: ruler.{name}: {first:g} is not within {bounds[0]} and {bounds[1]}, '
                f'{low:g} and {high:g}'
            )
    pixels, metres = len(config.camera.pixels), len(config.camera.metres)
    if pixels != metres:
        raise ConfigError(
            f'{source}: camera.metres: {metres} numbers, but camera.pixels has {pixels}'
        )
    if pixels % 2 or 0 < pixels < 4 or pixels == 6:
        raise ConfigError(
            f'{source}: camera.pixels: {pixels} numbers; two points have 4, four or more 8 on'
        )
    return config


def load_ruler_video(path: Path) -> RulerVideoConfig:
    """Read a ROS parameter file. Raises ConfigError."""
    return build_ruler_video(parameters_in(path), str(path))
