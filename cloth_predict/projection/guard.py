"""What of the predictions is safe to show, and what is shown when none is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cloth_predict.config import ProjectorConfig
from cloth_predict.projection.warp import Warped
from cloth_predict.types import FloatArray, Surface


def flaw_of(surface: Surface, age: float, config: ProjectorConfig) -> str:
    """Return why a prediction is not safe to show, or nothing; age [s] since the markers."""
    if age > config.max_age:
        return (
            f'the markers of the latest prediction are {age:.3g} s old, above projector.max_age '
            f'({config.max_age:g} s)'
        )
    worst = int(surface.sigma.argmax())
    sigma = float(surface.sigma[worst])
    if not sigma <= config.max_sigma:
        return (
            f'sigma of vertex {worst} is {1e3 * sigma:.0f} mm, above projector.max_sigma '
            f'({1e3 * config.max_sigma:.0f} mm)'
        )
    return ''


class Guard:
    """Keeps what was last shown: for a hold, and so that the picture does not jump after one."""

    def __init__(self, config: ProjectorConfig) -> None:
        """Prepare; nothing is shown yet."""
        self._config = config
        self._shown: Warped | None = None
        self._at = 0
        self.catching_up = False
        """Whether the picture is still on its way back from where it was held."""

    @property
    def started(self) -> bool:
        """Whether a safe frame was ever shown, which a hold can show again."""
        return self._shown is not None

    def safe(self, start: int, warped: Warped) -> Warped:
        """Return what to show in the frame at `start` [ns] of a warp that is safe.

        It is the warp itself, except after a hold: then all pixels go the same share of the way to
        it, so that the picture keeps its shape and none moves by more than `max_speed` allows.
        """
        before, shown = self._shown, warped
        if before is not None and self.catching_up:
            shown, share = approached(before, warped, self._config.max_speed * self._since(start))
            self.catching_up = share < 1.0
        self._shown, self._at = shown, start
        return shown

    def unsafe(self, start: int) -> Warped | None:
        """Return what to show in the frame at `start` [ns] while none is safe; None is black."""
        self._at = start
        self.catching_up = self._config.fallback == 'hold'
        return self._shown if self.catching_up else None

    def _since(self, start: int) -> float:
        """Time [s] in which the picture may move: that since the last frame, but one frame's."""
        frame, since = 1.0 / self._config.fps, 1e-9 * (start - self._at)
        return since if 0 < since < frame else frame


def approached(before: Warped, after: Warped, farthest: float) -> tuple[Warped, float]:
    """Return `after` with pixels on the way from `before`, and the share of the way, up to 1.

    No pixel of a vertex moves by more than `farthest` [px]. Those of the key lines move with their
    vertex. A vertex that has no pixel before or after (behind the projector) moves at once.
    """
    ways = [b.pixels - a.pixels for a, b in zip(before.drawn, after.drawn, strict=True)]
    longest = float(np.nanmax([np.hypot(*way.T) for way in ways], initial=0.0))
    share = min(1.0, farthest / longest) if longest else 1.0
    if share == 1.0:
        return after, share
    back = [np.nan_to_num(way) * (share - 1.0) for way in ways]
    drawn = tuple(
        replace(one, pixels=one.pixels + off) for one, off in zip(after.drawn, back, strict=True)
    )
    keys = tuple(
        replace(one, pixels=one.pixels + off) for one, off in zip(after.keys, back, strict=True)
    )
    return replace(after, drawn=drawn, keys=keys), share


def finite(warped: Warped) -> bool:
    """Whether every vertex has a place; that it has no pixel means that it is behind."""
    return all(_finite(drawn.position) for drawn in warped.drawn)


def _finite(values: FloatArray) -> bool:
    return bool(np.isfinite(values).all())
