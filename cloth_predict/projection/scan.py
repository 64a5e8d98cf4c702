"""When the projector lights each place of its frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import ProjectorConfig
from cloth_predict.types import FloatArray, IntArray

FIELDS = {'progressive': 1, 'interlaced': 2, 'global': 1}
"""Pictures of which a frame is made, one after the other; `colour_sequential` has its colours."""


@dataclass(frozen=True)
class Scan:
    """The beam goes from line to line; lines are rows (down, up) or columns (right, left).

    A frame takes 1 / fps [s], each of its fields an equal part of it, the last share `blanking` of
    which is dark. An interlaced frame draws every second line, and then the others; a colour,
    and the whole frame of a global shutter, is lit at one instant, for which the middle of
    the time of its light is taken.
    """

    mode: str
    direction: str
    width: int
    height: int
    fps: float
    blanking: float = 0.0
    colours: int = 1

    @classmethod
    def of(cls, config: ProjectorConfig, width: int, height: int) -> Scan:
        """Return the configured scan of a frame of this size [px]."""
        colours = config.colours if config.scan == 'colour_sequential' else 1
        return cls(
            config.scan, config.direction, width, height, config.fps, config.blanking, colours
        )

    @property
    def fields(self) -> int:
        """Number of fields of a frame."""
        return FIELDS.get(self.mode, self.colours)

    @property
    def instant(self) -> bool:
        """Whether a whole field is lit at one instant."""
        return self.mode in ('colour_sequential', 'global')

    @property
    def columns(self) -> bool:
        """Whether lines are columns."""
        return self.direction in ('right', 'left')

    @property
    def lines(self) -> int:
        """Lines of the frame."""
        return self.width if self.columns else self.height

    @property
    def line_time(self) -> float:
        """Time [s] in which the beam of a field gets from a line of the frame to the next."""
        lit = (1.0 - self.blanking) / (self.fields * self.fps)
        return 0.0 if self.instant else lit / self.lines

    def begins(self, field: int) -> float:
        """Time [s] after the frame's start of the first light of a field."""
        begin = field / (self.fields * self.fps)
        middle = 0.5 * (1.0 - self.blanking) / (self.fields * self.fps)
        return begin + middle if self.instant else begin

    def ends(self, field: int) -> float:
        """Time [s] after the frame's start at which the last line of a field is lit."""
        return self.begins(field) + self.line_time * (self.lines - 1 - self._first(field))

    def line_times(self, lines: FloatArray | IntArray, field: int) -> FloatArray:
        """Time [s] at which lines of the frame, counted as they are lit, are lit by a field.

        It goes on beyond the frame, and between the lines of a field.
        """
        return np.asarray(self.begins(field) + self.line_time * (lines - self._first(field)))

    def along(self, pixels: FloatArray) -> FloatArray:
        """Line through pixels u, v, shape (..., 2), counted as they are lit from 0, no integer."""
        place = pixels[..., 0 if self.columns else 1]
        return np.asarray(place if self.direction in ('down', 'right') else self.lines - 1 - place)

    def times(self, pixels: FloatArray, field: int) -> FloatArray:
        """Time [s] after the frame's start at which pixels, shape (..., 2), are lit by a field.

        What is before or behind the frame has the time of its first or last line; NaN for NaN.
        """
        held = np.clip(self.along(pixels), self._first(field), self.lines - 1)
        return self.line_times(held, field)

    def lit_by(self, field: int) -> slice:
        """Lines of the frame, rows or columns as they are counted there, that a field lights."""
        if self.mode != 'interlaced':
            return slice(None)
        forward = self.direction in ('down', 'right')
        return slice(field if forward else (self.lines - 1 - field) % 2, None, 2)

    def _first(self, field: int) -> int:
        return field if self.mode == 'interlaced' else 0
