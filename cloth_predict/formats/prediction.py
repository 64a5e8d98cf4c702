"""A prediction as a live message: the surface, and when it was measured and made; or at rest."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import SURFACE, decode, encode_surface
from cloth_predict.types import FloatArray, Surface

END = tuple(f'{prefix}{axis}_end' for prefix in ('', 'v') for axis in 'xyz')
"""Position and velocity at the end of the projector's frame."""
RESTING = ('x', 'y', 'z', 'sigma')
"""What is told of a point of a surface at rest."""
TIMES = ('horizon', 'received', 'filtered')
"""Seconds after the capture of the markers: the stamp, their arrival, the end of filtering."""


class UnsafeError(FrameError):
    """A prediction of the right form that cannot be shown: a number of it is not finite."""


@dataclass(frozen=True)
class Prediction:
    """A predicted surface; end: the same at the end of the frame, if known.

    horizon, received, filtered [s] after the capture of the markers; NaN where not known.
    """

    surface: Surface
    end: Surface | None
    horizon: float
    received: float
    filtered: float

    @property
    def stamp(self) -> int:
        """Time [ns] for which it is predicted."""
        return self.surface.stamp

    @property
    def capture(self) -> int | None:
        """Time [ns] of the markers that it is made of."""
        return self.stamp - round(1e9 * self.horizon) if isfinite(self.horizon) else None


def encode_prediction(prediction: Prediction, rows: int, cols: int) -> NDArray[np.void]:
    """Pack a prediction as an organised cloud, shape (rows, cols)."""
    end = END if prediction.end else ()
    surface = encode_surface(prediction.surface, rows, cols)
    names = surface.dtype.names or ()
    points = np.empty((rows, cols), [(name, '<f4') for name in (*names, *end, *TIMES)])
    for name in names:
        points[name] = surface[name]
    if prediction.end:
        after = np.column_stack([prediction.end.position, prediction.end.velocity])
        for name, values in zip(END, after.T, strict=True):
            points[name] = values.reshape(rows, cols)
    for name in TIMES:
        points[name] = getattr(prediction, name)
    return points


def encode_rest(surface: Surface, time_sigma: float, rows: int, cols: int) -> NDArray[np.void]:
    """Pack a surface at rest as an organised cloud, shape (rows, cols), with sigma [s] of when."""
    whole = encode_surface(surface, rows, cols)
    points = np.empty((rows, cols), [(name, '<f4') for name in (*RESTING, 'time_sigma')])
    for name in RESTING:
        points[name] = whole[name]
    points['time_sigma'] = time_sigma
    return points


def decode_prediction(
    message: Any, stamp: int, shape: tuple[int, int], duration: float
) -> Prediction:
    """Unpack a message of this stamp [ns]; duration [s] from it to the end of the frame.

    What is beyond the surface may be missing. Raises FrameError for another form or shape, and its
    kind UnsafeError where a number of the surface is not finite.
    """
    given = [field.name for field in message.fields]
    ends = set(END) <= set(given)
    names = (*(SURFACE.names or ()), *(END if ends else ()))
    points = decode(message, (*names, *(name for name in TIMES if name in given)))
    if points.shape != shape:
        raise FrameError(f'a surface of {points.shape} nodes, expected {shape}')
    surface = _surface(points, stamp, ('x', 'vx', 'ax'))
    end = None
    if ends:
        after = stamp + round(1e9 * duration)
        end = _surface(points, after, ('x_end', 'vx_end'))
    for one in (surface, end):
        if one and not all(
            np.isfinite(values).all() for values in (one.position, one.velocity, one.acceleration)
        ):
            raise UnsafeError('a node of the surface is not finite')
    times = [float(points[n].ravel()[0]) if n in given else np.nan for n in TIMES]
    return Prediction(surface, end, *times)


def _surface(points: NDArray[np.void], stamp: int, names: tuple[str, ...]) -> Surface:
    """Unpack vectors, each named by its first component; what is not given is zero."""
    flat = points.ravel()

    def vector(name: str) -> FloatArray:
        columns = [flat[name.replace('x', axis, 1)] for axis in 'xyz']
        return np.column_stack(columns).astype(float)

    position, velocity = (vector(name) for name in names[:2])
    acceleration = vector(names[2]) if len(names) > 2 else np.zeros_like(position)
    variance = np.square(flat['sigma'].astype(float))
    covariance = variance[:, None, None] * np.eye(3)
    return Surface(stamp, position, velocity, acceleration, covariance)
