"""What compensation buys: where the light of a frame lands on the surface as it truly moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import nan
from typing import NamedTuple

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError, FormatError
from cloth_predict.evaluation.beam import TrueSurface
from cloth_predict.evaluation.between import between
from cloth_predict.evaluation.cases import Case
from cloth_predict.evaluation.judging import BLOCK, WARM_UP
from cloth_predict.evaluation.projection_methods import METHODS, Known, Shown, knowledge, show
from cloth_predict.formats.bag import Truth
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.surface.layout import free_markers
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import BoolArray, FloatArray, IntArray

__all__ = ['METHODS', 'Compensation', 'project']


@dataclass(frozen=True)
class Compensation:
    """Where the light of the frames landed, by method, field and vertex.

    starts [ns], shape (frames,), of those with a prediction; age [s], shape (frames,), of the last
    markers then; error [m] and error_px, shape (methods, frames, fields, nodes), NaN where not
    judged; missed, of that shape: rays that met no surface; dt [s], shape (frames, fields, nodes),
    and actual [m], (frames, fields, nodes, 3): when the beam truly meets the vertices, and where;
    known: what was known of each frame; asked: frames that were to be drawn; free, (nodes,);
    between [m], shape (methods, some frames, nodes of the mesh): as `between`.
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
    known: list[Known]
    asked: int
    free: BoolArray
    between: FloatArray | None

    @property
    def judged(self) -> BoolArray:
        """Which vertices count, shape (frames, fields, nodes)."""
        return np.asarray(np.isfinite(self.error[0]))

    @property
    def judged_frames(self) -> IntArray:
        """Indices of the frames of which something counts."""
        return np.flatnonzero(self.judged.any(axis=(1, 2)))

    def shown(self, frame: int) -> Shown:
        """What was drawn of a frame."""
        return show(self.known[frame], self.pinhole, self.scan, self.config)

    @property
    def has_picture(self) -> bool:
        """Whether the texture is known all over the surface."""
        surface = self.surface
        return bool(len(surface.triangles)) and (
            surface.mesh is surface.vertices or surface.grid is not None
        )

    @property
    def block(self) -> int:
        """Frames that the bootstrap keeps together."""
        return max(round(BLOCK * self.scan.fps), 1)


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
    if case.reference.surface:
        raise ConfigError(
            f'model.kind {config.model.kind}: where light lands is judged vertex by vertex, and '
            f'no vertex of this body is a marker'
        )
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
    times = np.asarray(1e-9 * (starts[rows] - surface.vertices.start))
    landed = [_landed(a, b, surface, pinhole, scan) for a, b in zip(times, shown, strict=True)]
    error = np.stack([one.error for one in landed], axis=1)
    if not np.isfinite(error).any():
        raise FormatError(
            f'{bag}: the surface is outside the frame of the projector in each of {len(rows)} '
            'frames: see projector.rotation, projector.translation and projector.alpha'
        )
    return Compensation(
        bag=bag,
        config=config,
        scan=scan,
        pinhole=pinhole,
        surface=surface,
        delay=delay,
        starts=starts[rows],
        age=1e-9 * (starts[rows] - np.array([one.stamp for one in chosen])),
        error=error,
        error_px=np.stack([one.error_px for one in landed], axis=1),
        missed=np.stack([one.missed for one in landed], axis=1),
        dt=np.array([one.dt for one in landed]),
        actual=np.array([one.actual for one in landed]),
        known=chosen,
        asked=len(known),
        free=free_markers(config),
        between=between(times, shown, surface, pinhole, scan, config.model.shape),
    )


class _Landed(NamedTuple):
    """As in `Compensation`, of one frame."""

    error: FloatArray
    error_px: FloatArray
    missed: BoolArray
    dt: FloatArray
    actual: FloatArray


def _landed(
    begin: float, shown: Shown, surface: TrueSurface, pinhole: Pinhole, scan: Scan
) -> _Landed:
    """Light the frame that begins at `begin` [s].

    Counted are vertices that the beam truly meets within the frame, and that every method draws.
    """
    shape = shown.pixels.shape[:-1]
    truly = [surface.drawn(begin, pinhole, scan, field) for field in range(scan.fields)]
    lit = np.stack(
        [scan.times(shown.pixels[:, field], field) for field in range(scan.fields)], axis=1
    )
    vertices = np.broadcast_to(np.arange(shape[-1]), shape).ravel()
    rays = shown.pixels.reshape(-1, 2)
    error, error_px, missed = surface.landing(begin + lit.ravel(), rays, vertices, pinhole)
    error, error_px = error.reshape(shape), error_px.reshape(shape)
    counts = np.array([one.visible for one in truly]) & np.isfinite(error + error_px).all(axis=0)
    return _Landed(
        np.where(counts, error, nan),
        np.where(counts, error_px, nan),
        missed.reshape(shape) & counts,
        np.array([one.dt for one in truly]),
        np.array([one.position for one in truly]),
    )
