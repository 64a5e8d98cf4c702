"""What compensation buys: where the light of a frame lands on the surface as it truly moves.

Four methods say which pixel each vertex is drawn at: `none` where it was last seen, `frame` where
it will be when the frame starts, `rows` by the thesis' time of its row of nodes (Gomes 2016, eq.
6.22-6.23), and `full` at the moment at which its own line of pixels is lit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import nan

import numpy as np

from cloth_predict.config import Config
from cloth_predict.config.schema import ModelConfig
from cloth_predict.errors import ConfigError, FormatError, FrameError
from cloth_predict.evaluation.beam import TrueSurface
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.judging import WARM_UP
from cloth_predict.evaluation.predictors import Hold
from cloth_predict.formats.bag import Truth
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.projection.scanout import draw, row_times
from cloth_predict.surface.layout import free_markers
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import BoolArray, FloatArray, IntArray, Surface

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


@dataclass(frozen=True)
class Compensation:
    """Where the light of the frames landed, by method, field and vertex.

    starts [ns], shape (frames,), of those with a prediction; age [s], shape (frames,), of the last
    markers then; error [m] and error_px, shape (methods, frames, fields, nodes), NaN where not
    judged; missed, of that shape: rays that met no surface; dt [s], shape (frames, fields, nodes),
    and actual [m], (frames, fields, nodes, 3): when the beam truly meets the vertices, and where;
    shown: what was drawn; asked: frames that were to be drawn; free, shape (nodes,).
    """

    bag: str
    config: Config
    scan: Scan
    pinhole: Pinhole
    surface: TrueSurface
    delay: float
    starts: IntArray
    age: FloatArray
    error: FloatArray
    error_px: FloatArray
    missed: BoolArray
    dt: FloatArray
    actual: FloatArray
    shown: list[Shown]
    asked: int
    free: BoolArray

    @property
    def judged(self) -> BoolArray:
        """Which vertices count, shape (frames, fields, nodes)."""
        return np.asarray(np.isfinite(self.error[0]))

    def of(self, method: str) -> int:
        """Index of a method in the arrays."""
        return METHODS.index(method)


def project(
    case: Case,
    truth: Truth | None,
    config: Config,
    delay: float,
    progress: Callable[[int], None] = lambda frames: None,
) -> Compensation:
    """Light every frame of a recording on its true surface.

    delay [s]: from the capture of the markers of a frame to its start. Raises ConfigError or
    FormatError, which name the parameter or the recording, where no frame can be judged.
    """
    if not 0 <= delay < np.inf:
        raise ConfigError(f'the delay is {delay} s: a frame shows no markers that come after it')
    starts = starts_of(case, config.projector.fps)
    tracker = Tracker(config)
    known = list(knowledge(tracker, case, starts, delay, progress))
    triangles = tracker.triangles
    surface = TrueSurface.of(case, truth, triangles)
    return light(case.name, known, starts, surface, config, delay)


def starts_of(case: Case, fps: float) -> IntArray:
    """Starts [ns] of the frames that end before what is known of the surface does."""
    first = int(case.markers.stamps[0])
    begin = first + WARM_UP * NANOSECONDS
    last = int(case.reference.markers.stamps[-1])
    count = int(np.floor((last - begin) / NANOSECONDS * fps + 1e-6))
    if count < 1:
        seconds = (last - first) / NANOSECONDS
        raise FormatError(
            f'{case.name}: no frame can be judged: the recording lasts {seconds:.2f} s, of which '
            f'the first {WARM_UP} s are the warm-up, and a frame takes {1 / fps:.3g} s'
        )
    return np.round(begin + np.arange(count) / fps * NANOSECONDS).astype(np.int64)


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


def light(
    bag: str,
    known: list[Known],
    starts: IntArray,
    surface: TrueSurface,
    config: Config,
    delay: float,
) -> Compensation:
    """Light the frames that start at `starts` [ns] with what was known of them."""
    pinhole = Pinhole.from_config(config.projector)
    scan = Scan.of(config.projector, pinhole.width, pinhole.height)
    rows = [k for k, one in enumerate(known) if one.surface is not None]
    if not rows:
        raise FormatError(f'{bag}: there is a prediction for none of its {len(known)} frames')
    chosen = [known[k] for k in rows]
    shown = [show(one, pinhole, scan, config) for one in chosen]
    times = 1e-9 * (starts[rows] - surface.vertices.start)
    landed = [_landed(a, b, surface, pinhole, scan) for a, b in zip(times, shown, strict=True)]
    error, error_px, missed, dt, actual = map(np.array, zip(*landed, strict=True))
    if not np.isfinite(error).any():
        raise FormatError(
            f'{bag}: the surface is outside the frame of the projector in each of {len(rows)} '
            'frames: see projector.rotation, projector.translation and projector.alpha'
        )
    swapped = (np.moveaxis(each, 1, 0) for each in (error, error_px, missed))
    age = 1e-9 * (starts[rows] - np.array([one.stamp for one in chosen]))
    return Compensation(
        bag, config, scan, pinhole, surface, delay, starts[rows], age, *swapped, dt, actual,
        shown, len(known), free_markers(config),
    )  # fmt: skip


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
    begin, span = np.nanmin(line, initial=np.inf), np.ptp(line[np.isfinite(line)])
    return np.asarray((line - begin) / (scan.fps * max(span, 1e-9)))


def _landed(
    begin: float, shown: Shown, surface: TrueSurface, pinhole: Pinhole, scan: Scan
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    """Errors [m] and [px], and misses, (methods, fields, nodes), of the frame at `begin` [s].

    With them when the beam truly meets the vertices, [s], (fields, nodes), and where [m]. Counted
    are vertices that it meets within the frame and on which every method puts light.
    """
    shape = shown.pixels.shape[:-1]
    truly = [surface.drawn(begin, pinhole, scan, field) for field in range(scan.fields)]
    lit = np.stack(
        [scan.times(shown.pixels[:, field], field) for field in range(scan.fields)], axis=1
    )
    vertices = np.broadcast_to(np.arange(shape[-1]), shape)
    error, error_px, missed = (
        each.reshape(shape)
        for each in surface.landing(
            begin + lit.ravel(), shown.pixels.reshape(-1, 2), vertices.ravel(), pinhole
        )
    )
    counts = np.array([one.visible for one in truly]) & np.isfinite(error + error_px).all(axis=0)
    dt, actual = (np.array([getattr(one, name) for one in truly]) for name in ('dt', 'position'))
    return (
        np.where(counts, error, nan),
        np.where(counts, error_px, nan),
        missed & counts,
        dt,
        actual,
    )
