"""Where each vertex is at the moment at which its own line is lit (Gomes 2016, sec. 6.5)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from cloth_predict.projection.motion import Motion
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.types import BoolArray, FloatArray, IntArray

ITERATIONS = 20
"""Of the secant method; a surface that is slow by the beam's measure needs 2 or 3."""
CLOSE = 1e-3
"""Lines within which a draw time fits the line of its vertex."""
BETWEEN = np.array([0.25, 0.5, 0.75])
"""Where between two key rows the error is looked at: a parabola's is largest in the middle, a
cubic's may be zero there."""


def row_times(rows: int, fps: float) -> FloatArray:
    """Draw times [s] after the frame's start of rows 0 to rows - 1 of nodes, shape (rows,).

    Row m is drawn at m / (fps (rows - 1)) (Gomes 2016, eq. 6.22), which holds where the surface
    fills the frame from top to bottom; a single row is drawn at the start.
    """
    return np.arange(rows) / (fps * max(rows - 1, 1))


@dataclass(frozen=True)
class Drawn:
    """The vertices of a field, each at its own time.

    dt [s], shape (nodes,); pixels, shape (nodes, 2); position [m], shape (nodes, 3);
    converged, shape (nodes,): whether there is a time at which the beam meets the vertex.
    """

    dt: FloatArray
    pixels: FloatArray
    position: FloatArray
    converged: BoolArray


def draw(motion: Motion, pinhole: Pinhole, scan: Scan, field: int = 0) -> Drawn:
    """Find the moment at which each vertex is lit, which is that of the line it then is on.

    A vertex that runs along the scan faster than the beam has no such moment, or several: it is
    not converged, and drawn at the time of the line on which it is at the field's start. What is
    outside the frame is drawn with its first or last line; pixels are NaN behind the projector.
    """
    begin, end = scan.begins(field), scan.ends(field)
    nodes = motion.coefficients.shape[1]
    dt = np.full(nodes, begin)
    converged = np.ones(nodes, bool)
    if not scan.instant:
        dt, converged = _meet(motion, pinhole, scan, field)
        dt = np.clip(dt, begin, end)
    position = motion.at(dt)
    return Drawn(dt, pinhole.project(position), position, converged)


def _meet(
    motion: Motion, pinhole: Pinhole, scan: Scan, field: int
) -> tuple[FloatArray, BoolArray]:
    """Times [s] at which the beam of a field meets the vertices, and which it meets at all.

    The beam is thought to go on beyond the frame. The secant method finds the zero of dt less the
    time of the line at dt, whose slope is 1 less the speed of the vertex by that of the beam.
    """

    def late(dt: FloatArray) -> FloatArray:
        pixels = pinhole.project(motion.at(dt))
        return np.asarray(dt - scan.line_times(scan.along(pixels), field))

    before = np.full(motion.coefficients.shape[1], scan.begins(field))
    late_before = late(before)
    first = before - late_before
    now, slope = first, np.ones_like(first)
    close, far = CLOSE * scan.line_time, 2 * scan.lines * scan.line_time
    for _ in range(ITERATIONS):
        late_now = late(now)
        moved = now - before
        known = np.abs(moved) > 1e-6 * close
        slope = np.where(known, (late_now - late_before) / np.where(known, moved, 1.0), slope)
        if not (np.abs(late_now) > close).any():
            break
        before, late_before = now, late_now
        with np.errstate(divide='ignore', invalid='ignore'):
            step = np.where(slope != 0, late_now / slope, 0.0)
        now = np.clip(now - step, scan.begins(field) - far, scan.begins(field) + far)
    met = (np.abs(late_now) <= close) & (slope > 0)
    behind = np.isnan(late_now)
    return np.where(met, now, np.where(behind, scan.begins(field), first)), met | behind


@dataclass(frozen=True)
class KeyRows:
    """All vertices at the draw times of some lines, between which one may interpolate.

    lines, shape (k,), of the frame, rows or columns, in the order in which they are lit;
    dt [s], shape (k,); pixels, shape (k, nodes, 2); position [m], shape (k, nodes, 3).
    """

    lines: IntArray
    dt: FloatArray
    pixels: FloatArray
    position: FloatArray


def key_rows(
    motion: Motion, pinhole: Pinhole, scan: Scan, field: int, max_error: float
) -> KeyRows:
    """As few lines, evenly spaced, as keep the error of a vertex between them below `max_error`.

    max_error [px], of linear interpolation over the lines. A field that is lit at one instant has
    one line, which holds for all of them.
    """
    if scan.instant:
        return _at(np.zeros(1, np.int64), motion, pinhole, scan, field)
    parts = 1
    while True:
        lines = np.unique(np.linspace(0, scan.lines - 1, parts + 1).round().astype(np.int64))
        error = _error_between(lines, motion, pinhole, scan, field)
        if error <= max_error or len(lines) == scan.lines:
            break
        # the error falls with the square of the distance
        parts = min(max(ceil(parts * np.sqrt(error / max_error)), parts + 1), scan.lines - 1)
    return _at(lines, motion, pinhole, scan, field)


def _at(lines: IntArray, motion: Motion, pinhole: Pinhole, scan: Scan, field: int) -> KeyRows:
    dt = scan.line_times(lines, field)
    position = motion.at(dt[:, None])
    shown = lines if scan.direction in ('down', 'right') else scan.lines - 1 - lines
    return KeyRows(shown, dt, pinhole.project(position), position)


def _error_between(
    lines: IntArray, motion: Motion, pinhole: Pinhole, scan: Scan, field: int
) -> float:
    """Largest error [px] between key lines, counted as they are lit."""
    dt = scan.line_times(lines, field)
    inner = dt[:-1] + BETWEEN[:, None] * np.diff(dt)
    pixels = pinhole.project(motion.at(dt[:, None]))
    share = BETWEEN[:, None, None, None]
    straight = pixels[:-1] + share * (pixels[1:] - pixels[:-1])
    error = pinhole.project(motion.at(inner[..., None])) - straight
    worst = np.nanmax(np.square(error).sum(axis=-1), initial=0.0)
    return float(np.sqrt(worst))
