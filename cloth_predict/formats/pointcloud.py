"""The layout of the project's PointCloud2 messages; works on any object with those fields.

rclpy's and rosbags' messages name their fields alike, so one codec serves the live graph and bags.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cloth_predict.errors import FrameError
from cloth_predict.types import BoolArray, FloatArray, IntArray, Surface

UNLABELLED = 0xFFFFFFFF
"""The `id` of a point that the mocap system did not identify."""

MARKERS = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4')])
TRACKS = np.dtype([*((name, MARKERS[name]) for name in MARKERS.names or ()), ('track', '<u4')])
"""Markers with the column of the recording that each came from, where some are unlabelled."""
SURFACE = np.dtype(
    [(name, '<f4') for name in ('x', 'y', 'z', 'vx', 'vy', 'vz', 'ax', 'ay', 'az', 'sigma')]
)
NORMAL = ('normal_x', 'normal_y', 'normal_z')
"""Unit, outward: of closed surfaces only; the names are those of PCL."""
WARPED = np.dtype(
    [
        *((name, '<f4') for name in ('u', 'v', 's', 't', 'x', 'y', 'z', 'dt')),
        ('flags', '<u2'),
        ('field', '<u2'),
    ]
)
SCANLINE = np.dtype(
    [*((name, '<f4') for name in ('u', 'v', 'dt')), ('line', '<u2'), ('field', '<u2')]
)

DATATYPES = {
    'int8': 1, 'uint8': 2, 'int16': 3, 'uint16': 4, 'int32': 5, 'uint32': 6, 'float32': 7,
    'float64': 8,
}  # fmt: skip
_NAMES = {number: name for name, number in DATATYPES.items()}


def fields_of(dtype: np.dtype[Any]) -> list[tuple[str, int, int, int]]:
    """Name, offset, datatype and count of each PointField of a structured dtype."""
    return [
        (name, dtype.fields[name][1], DATATYPES[dtype[name].name], 1)  # type: ignore[index]
        for name in dtype.names or ()
    ]


def decode(message: Any, required: tuple[str, ...]) -> NDArray[np.void]:
    """Return the points, structured, shape (height, width).

    Raises FrameError where the message has no such points. Fields beyond the required ones are
    accepted. The result may share the message's memory.
    """
    names, formats, offsets = [], [], []
    order: Literal['<', '>'] = '>' if message.is_bigendian else '<'
    for field in message.fields:
        if field.name in required:
            if field.datatype not in _NAMES or field.count != 1:
                raise FrameError(f'field {field.name!r} of the cloud is not one number')
            names.append(field.name)
            formats.append(np.dtype(_NAMES[field.datatype]).newbyteorder(order))
            offsets.append(field.offset)
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FrameError(f'field {twice!r} of the cloud is there twice')
    missing = [name for name in required if name not in names]
    if missing:
        found = ', '.join(field.name for field in message.fields) or 'none'
        raise FrameError(f'the cloud has no field {missing[0]!r} (fields: {found})')
    height, width, step = message.height, message.width, message.point_step
    ends = [o + f.itemsize for o, f in zip(offsets, formats, strict=True)]
    buffer = np.frombuffer(message.data, np.uint8)
    if (
        max(ends) > step
        or width * step > message.row_step
        or len(buffer) < height * message.row_step
    ):
        raise FrameError('the sizes of the cloud do not fit its data')
    dtype = np.dtype({'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': step})
    rows = buffer[: height * message.row_step].reshape(height, message.row_step)
    flat = np.ascontiguousarray(rows[:, : width * step])
    return (
        flat.view(dtype).reshape(height, width) if flat.size else np.empty((height, width), dtype)
    )


def xyz(points: NDArray[np.void]) -> FloatArray:
    """Return the positions [m] in double precision, shape (points, 3)."""
    flat = points.ravel()
    return np.column_stack([flat[axis] for axis in 'xyz']).astype(float)


def whole(points: NDArray[np.void], name: str) -> IntArray:
    """Return an integer field, shape (points,).

    Raises FrameError where it holds no integers, or negative ones.
    """
    values = points[name]
    if values.dtype.kind not in 'iu' or (values < 0).any():
        raise FrameError(f'field {name!r} of the cloud is not a whole number from zero')
    return values.astype(np.int64)


def encode_markers(
    positions: FloatArray, visible: BoolArray, unlabelled: BoolArray
) -> NDArray[np.void]:
    """Pack the visible markers of one frame, shape (visible,); the id is the marker's column.

    Raises FrameError for a coordinate beyond float32.
    """
    columns = np.flatnonzero(visible)
    points = np.zeros(len(columns), TRACKS if unlabelled.any() else MARKERS)
    with np.errstate(over='ignore'):
        for k, axis in enumerate('xyz'):
            points[axis] = positions[columns, k]
            if not np.isfinite(points[axis]).all():
                raise FrameError('a coordinate does not fit into a float32')
    points['id'] = np.where(unlabelled[columns], UNLABELLED, columns)
    if unlabelled.any():
        points['track'] = columns
    return points


def decode_markers(message: Any, nodes: int) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Positions [m], shape (nodes, 3), and visible, shape (nodes,), of the labelled markers.

    The third are the points [m] without a label, shape (m, 3), in the order of the cloud. Raises
    FrameError for a cloud with other fields, an id that is no node, or an id given twice.
    """
    cloud = decode(message, ('x', 'y', 'z', 'id')).ravel()
    ids, points = whole(cloud, 'id'), xyz(cloud)
    labelled = ids != UNLABELLED
    ids, placed = ids[labelled], points[labelled]
    if ids.size and ids.max() >= nodes:
        raise FrameError(
            f'{len(ids)} markers with ids up to {ids.max()} do not fit a model of {nodes} nodes'
        )
    if len(np.unique(ids)) != len(ids):
        raise FrameError('a marker id is there twice')
    positions, visible = np.full((nodes, 3), np.nan), np.zeros(nodes, bool)
    positions[ids], visible[ids] = placed, True
    return positions, visible, points[~labelled]


def encode_surface(surface: Surface, rows: int, cols: int) -> NDArray[np.void]:
    """Pack a surface as an organised cloud, shape (rows, cols), with its normals if it has any."""
    normal = () if surface.normal is None else NORMAL
    dtype = np.dtype([*SURFACE.descr, *((name, '<f4') for name in normal)])
    points = np.empty(len(surface.position), dtype)
    for k, name in enumerate(normal):
        points[name] = surface.normal[:, k]  # type: ignore[index]
    for prefix, values in (
        ('', surface.position),
        ('v', surface.velocity),
        ('a', surface.acceleration),
    ):
        for k, axis in enumerate('xyz'):
            points[prefix + axis] = values[:, k]
    points['sigma'] = surface.sigma
    return points.reshape(rows, cols)
