"""From predictions to the frames of a projector: which prediction serves, and what is shown."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import SCANLINE, WARPED
from cloth_predict.formats.prediction import Prediction
from cloth_predict.projection.guard import Guard, finite, flaw_of
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.visibility import Flag
from cloth_predict.projection.warp import Warped, Warper

ROUNDING = 1000
"""Nanoseconds by which a stamp may miss the frame that it is meant for."""
KEPT = 16
"""Predictions for frames to come that are kept: a mocap system is that much faster at most."""


@dataclass(frozen=True)
class Shown:
    """A frame: vertices, shape (fields * rows, cols), and scanlines, shape (key lines, nodes).

    Both have a width of 0 where nothing is shown. warped: what they are packed from; prediction:
    what that was made of, None of a hold or of nothing.
    """

    start: int
    vertices: NDArray[np.void]
    scanlines: NDArray[np.void]
    warped: Warped | None
    prediction: Prediction | None


class Frames:
    """Keeps the predictions that may serve, and makes frames of them.

    counts: frames that were `held`, `blanked`, `empty` (no vertex within the frame), and
    predictions that came too `late` for the frame that they were made for.
    """

    def __init__(self, config: Config) -> None:
        """Prepare; the first prediction tells what the surface is."""
        self._config = config
        self._guard = Guard(config.projector)
        self._warper: Warper | None = None
        self._kept: dict[int, Prediction] = {}
        self.counts: Counter[str] = Counter()
        self.flags = {(flag.name or '').lower(): 0 for flag in Flag}
        """Vertices of the last frame that was made, by what keeps them from being lit."""
        self.flaw = ''
        """Why the last frame was not made of a prediction, or nothing."""
        self.empty = False
        """Whether no vertex of the last frame was within it."""

    @property
    def warper(self) -> Warper | None:
        """What warps the surface, once there was one."""
        return self._warper

    @property
    def started(self) -> bool:
        """Whether there is anything to show, or was."""
        return self._guard.started

    @property
    def catching_up(self) -> bool:
        """Whether the picture is on its way back from where it was held."""
        return self._guard.catching_up and not self.flaw

    def offer(self, prediction: Prediction, start: int) -> bool:
        """Keep a prediction for the frame that comes next, at `start` [ns]; False: it is late."""
        if prediction.stamp < start - ROUNDING:
            self.counts['late'] += 1
            return False
        self._kept[prediction.stamp] = prediction
        while len(self._kept) > KEPT:
            del self._kept[max(self._kept)]
        return True

    def forget(self) -> None:
        """Drop what is kept, as after a jump of the clock."""
        self._kept.clear()

    def choose(self, start: int) -> Prediction | None:
        """Return the prediction nearest to the frame at `start` [ns], and drop what is before."""
        if not self._kept:
            return None
        best = min(self._kept, key=lambda stamp: (abs(stamp - start), -stamp))
        self._kept = {s: p for s, p in self._kept.items() if s >= min(best, start)}
        far = 1e-9 * abs(best - start)
        return self._kept[best] if far <= self._config.projector.max_age else None

    def make(self, start: int, prediction: Prediction | None, age: float) -> Shown | None:
        """Return the frame at `start` [ns]; None where there was never anything to show.

        prediction: moved on to the frame, or back; age [s] of its markers. Without one, or where
        it is not safe, the fallback is shown.
        """
        if prediction is None:
            return self.fall_back(start, 'no prediction serves the frame')
        try:
            if flaw := flaw_of(prediction.surface, age, self._config.projector):
                return self.fall_back(start, flaw)
            warped = self._warp(start, prediction)
        except FrameError as error:
            return self.fall_back(start, str(error))
        if not finite(warped):
            return self.fall_back(start, 'a vertex is not finite when it is drawn')
        self.flaw, self.empty = '', warped.empty
        if warped.empty:
            self.counts['empty'] += 1
        self._count(warped)
        return self._pack(start, self._guard.safe(start, warped), prediction)

    def fall_back(self, start: int, flaw: str) -> Shown | None:
        """Return the frame at `start` [ns] that is shown for want of a safe one."""
        self.flaw, self.empty = flaw, False
        if not self._guard.started:
            return None
        warped = self._guard.unsafe(start)
        self.counts['blanked' if warped is None else 'held'] += 1
        return self._pack(start, warped, None)

    def _warp(self, start: int, prediction: Prediction) -> Warped:
        surface = prediction.surface
        if self._warper is None:
            self._warper = Warper.of(self._config, surface.position)
        motion = Motion.of(self._config.projector.motion, surface, prediction.end)
        by = 1e-9 * (start - surface.stamp)
        return self._warper.warp(motion if by == 0 else motion.shifted(by))

    def _pack(self, start: int, warped: Warped | None, prediction: Prediction | None) -> Shown:
        assert self._warper is not None
        if warped is None or warped.empty:
            return Shown(
                start, np.empty((1, 0), WARPED), np.empty((1, 0), SCANLINE), None, prediction
            )
        vertices, scanlines = self._warper.vertices(warped), self._warper.scanlines(warped)
        return Shown(start, vertices, scanlines, warped, prediction)

    def _count(self, warped: Warped) -> None:
        flags = np.bitwise_or.reduce(warped.flags, axis=0)
        for flag in Flag:
            self.flags[(flag.name or '').lower()] = int(np.count_nonzero(flags & flag))
