"""What the methods of projecting know of the surface, and which pixels they draw it at.

`none` draws each vertex where it was last seen, `frame` where it will be when the frame starts,
`rows` by the thesis' time of its row of nodes (Gomes 2016, eq. 6.22-6.23), and `full` at the
moment at which its own line of pixels is lit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from cloth_predict.config import Config
from cloth_predict.config.schema import ModelConfig
from cloth_predict.errors import FrameError
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.predictors import Hold
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.projection.scanout import draw, row_times
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import FloatArray, IntArray, Surface

METHODS = ('none', 'frame', 'rows', 'full')


@dataclass(frozen=True)
class Known:
    """What is known when a frame is made.

    stamp [ns] of the last markers; seen [m], shape (nodes, 3), NaN of a marker that was never
    seen: where each was last; surface at the start of the frame, and at its `end`; None where
    there is no prediction, or where none is needed.
    """

    stamp: int
    seen: FloatArray
    surface: Surface | None
    end: Surface | None


@dataclass(frozen=True)
class Shown:
    """What the methods draw of one frame: pixels and the positions [m] meant by them.

    Shapes (methods, fields, nodes, 2) and (methods, fields, nodes, 3).
    """

    pixels: FloatArray
    position: FloatArray


def knowledge(
    tracker: Tracker,
    case: Case,
    starts: IntArray,
    delay: float,
    progress: Callable[[int], None],
) -> Iterator[Known]:
    """What is known of the markers `delay` [s] before the start [ns] of each frame."""
    config, stamps = tracker.config, case.markers.stamps.tolist()
    last, k, latest = Hold(config), 0, stamps[0]
    duration = 1.0 / config.projector.fps
    for start in starts.tolist():
        while k < len(stamps) and stamps[k] <= start - delay * NANOSECONDS:
            tracker.step(stamps[k], *case.frame(k, True))
            last.step(stamps[k], *case.frame(k, False))
            latest, k = max(latest, stamps[k]), k + 1
            progress(1)
        surface = end = None
        try:
            ahead = (start - latest) / NANOSECONDS
            surface = tracker.predict(ahead)
            if config.projector.motion == 'model':
                end = tracker.predict(ahead + duration)
        except FrameError:
            surface = None
        yield Known(latest, last.predict(0.0).position, surface, end)


def show(known: Known, pinhole: Pinhole, scan: Scan, config: Config) -> Shown:
    """Return what each method draws of a frame."""
    now = known.surface
    assert now is not None
    fields = range(scan.fields)
    row_dt = thesis_times(config.model, pinhole.project(now.position), scan)
    moved = Motion.constant_velocity(now.position, now.velocity).at(row_dt)
    still = [np.repeat(p[None], len(fields), axis=0) for p in (known.seen, now.position, moved)]
    motion = Motion.of(config.projector.motion, now, known.end)
    drawn = [draw(motion, pinhole, scan, field) for field in fields]
    position = np.stack([*still, np.array([one.position for one in drawn])])
    pixels = pinhole.project(position)
    pixels[METHODS.index('full')] = [one.pixels for one in drawn]
    return Shown(pixels, position)


def thesis_times(model: ModelConfig, pixels: FloatArray, scan: Scan) -> FloatArray:
    """Draw time m dT [s] of each vertex, m the place of its row of nodes (Gomes 2016, eq. 6.22).

    The rows of nodes of a grid are in the order in which the beam meets them; where the beam goes
    from column to column they are its columns. Where there are no rows, the lines on which the
    vertices are fill the frame. pixels, shape (nodes, 2), at the frame's start.
    """
    line = scan.along(pixels)
    across = 0 if scan.columns else 1
    if model.topology == 'grid' and model.shape[1 - across] > 1:
        place = line.reshape(model.shape).mean(axis=across)
        times = np.empty(len(place))
        times[np.argsort(place, kind='stable')] = row_times(len(place), scan.fps)
        shape = np.expand_dims(times, across)
        return np.asarray(np.broadcast_to(shape, model.shape).ravel())
    seen = line[np.isfinite(line)]
    if not len(seen):
        return np.zeros_like(line)
    return np.asarray((line - seen.min()) / (scan.fps * max(np.ptp(seen), 1e-9)))
