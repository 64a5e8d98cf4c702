"""When each row of the surface is drawn, and where the surface is then (Gomes 2016, sec. 6.5)."""

from __future__ import annotations

import numpy as np

from cloth_predict.types import FloatArray


def row_times(rows: int, fps: float) -> FloatArray:
    """Draw times [s] after the frame's start of rows 0 to rows - 1 of nodes, shape (rows,).

    Row m is drawn at m / (fps (rows - 1)) (Gomes 2016, eq. 6.22), which holds where the surface
    fills the frame from top to bottom; a single row is drawn at the start.
    """
    return np.arange(rows) / (fps * max(rows - 1, 1))


def moved(position: FloatArray, velocity: FloatArray, dt: FloatArray) -> FloatArray:
    """Positions p + v dt [m] of nodes drawn dt [s] after the frame's start (Gomes 2016, eq. 6.23).

    position and velocity have shape (..., 3), dt any shape that broadcasts with the leading ones.
    """
    return position + velocity * np.asarray(dt)[..., None]
