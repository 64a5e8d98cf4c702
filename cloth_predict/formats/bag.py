"""MCAP bags in rosbag2 layout: a folder with metadata.yaml and one .mcap of zstd chunks."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cloth_predict.errors import FormatError, FrameError
from cloth_predict.formats.files import writing
from cloth_predict.formats.pointcloud import (
    MARKERS,
    UNLABELLED,
    decode,
    encode_markers,
    fields_of,
    whole,
    xyz,
)
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

TYPES = get_typestore(Stores.ROS2_JAZZY)
CLOUD = 'sensor_msgs/msg/PointCloud2'
UNNAMED_FRAME = 'mocap'
"""Frame of markers whose recording names none, such as a Motive CSV."""

LATEST = 2**31 * 10**9
"""First time [ns] that a ROS message cannot hold."""

MOST_MARKERS = 4096
"""Largest marker id that is believed; a larger one is a cloud of something else."""

OWN_KEY = 'cloth_predict'
"""Key of the bag's custom data that holds the labels and marks a bag as made by this project."""


@dataclass(frozen=True)
class Truth:
    """The true motion of a simulated surface.

    stamps [ns], shape (frames,); surface [m], shape (frames, rows, cols, 3); ids, shape
    (rows, cols): the marker on each node, or -1.
    """

    stamps: IntArray
    surface: FloatArray
    ids: IntArray

    def markers(self, like: MarkerSequence) -> MarkerSequence:
        """Return the true positions of the markers of a measured sequence, all visible."""
        place = {int(marker): k for k, marker in enumerate(self.ids.ravel()) if marker >= 0}
        nodes = [place[i] for i in range(len(like.labels))]
        positions = self.surface.reshape(len(self.stamps), -1, 3)[:, nodes]
        visible = np.ones(positions.shape[:2], bool)
        return MarkerSequence(self.stamps, like.labels, positions, visible, like.frame_id)

    def nodes(self) -> MarkerSequence:
        """Return the true positions of all nodes, each named by its number."""
        positions = self.surface.reshape(len(self.stamps), -1, 3)
        names = tuple(map(str, range(positions.shape[1])))
        return MarkerSequence(self.stamps, names, positions, np.ones(positions.shape[:2], bool))


@dataclass(frozen=True)
class Recording:
    """A bag's content: measured markers and, from the simulator, the true motion."""

    markers: MarkerSequence
    truth: Truth | None = None


class BagWriter:
    """Writes messages with log and publish time equal to their stamp."""

    def __init__(self, writer: Writer, path: Path) -> None:
        self._writer, self._path = writer, path
        self._connections: dict[str, Connection] = {}

    def cloud(self, topic: str, stamp: int, frame_id: str, points: NDArray[np.void]) -> None:
        """Write structured points, shape (width,) or (height, width), at stamp [ns]."""
        if not 0 <= stamp < LATEST:
            raise FormatError(f'{self._path}: a message cannot hold the stamp {stamp} ns')
        self.message(topic, CLOUD, stamp, cloud_message(stamp, frame_id, points))

    def message(self, topic: str, msgtype: str, stamp: int, message: Any) -> None:
        """Write a message of rosbags' types."""
        self.raw(topic, msgtype, stamp, bytes(TYPES.serialize_cdr(message, msgtype)))

    def raw(self, topic: str, msgtype: str, stamp: int, data: bytes) -> None:
        """Write a message that is already serialised, as it came over the wire."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, msgtype, typestore=TYPES)
        self._writer.write(self._connections[topic], stamp, data)


@contextmanager
def create_bag(path: Path, labels: tuple[str, ...] = ()) -> Iterator[BagWriter]:
    """Open a new bag; it appears under `path` only when it is complete.

    A bag that this project made before is replaced; anything else at `path` is an error.
    """
    if os.path.exists(path) and not (_is_own(path) or _is_empty_folder(path)):
        raise FormatError(f'{path}: exists and was not made by cloth-predict; not overwritten')
    partial = path.parent / f'.{path.name}.partial'
    shutil.rmtree(partial, ignore_errors=True)
    try:
        with writing(path):
            # The inner name is fixed, because the file's own metadata holds it and the same
            # content is to give the same bytes under any name.
            writer = Writer(partial / 'bag', version=9, storage_plugin=StoragePlugin.MCAP)
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            writer.set_custom_data(OWN_KEY, json.dumps({'labels': labels}))
            with writer:
                yield BagWriter(writer, path)
            _replace(partial / 'bag', path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _replace(new: Path, path: Path) -> None:
    """Move a finished bag to its place; other files in the folder of the old one stay."""
    if not path.exists():
        new.rename(path)
        return
    for old in path.glob('*.mcap'):
        old.unlink()
    for file in new.iterdir():
        file.replace(path / file.name)


def cloud_message(stamp: int, frame_id: str, points: NDArray[np.void]) -> Any:
    """Build a PointCloud2 of rosbags' types."""
    types = TYPES.types
    header = types['std_msgs/msg/Header'](
        types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9)), frame_id
    )
    fields = [types['sensor_msgs/msg/PointField'](*f) for f in fields_of(points.dtype)]
    grid = np.atleast_2d(points)
    height, width = grid.shape
    step = points.dtype.itemsize
    data = np.frombuffer(grid.tobytes(), np.uint8)
    return types[CLOUD](header, height, width, fields, False, step, step * width, data, True)


def write_recording(path: Path, recording: Recording) -> None:
    """Write the markers and, where there is one, the truth."""
    markers, truth = recording.markers, recording.truth
    frame_id = markers.frame_id or UNNAMED_FRAME
    unlabelled = markers.unlabelled
    with create_bag(path, markers.labels) as bag:
        for k, stamp in enumerate(markers.stamps.tolist()):
            points = encode_markers(markers.positions[k], markers.visible[k], unlabelled)
            bag.cloud('/markers', stamp, frame_id, points)
        if truth is not None:
            points = np.zeros(truth.ids.shape, MARKERS)
            points['id'] = np.where(truth.ids < 0, UNLABELLED, truth.ids)
            for k, stamp in enumerate(truth.stamps.tolist()):
                for i, axis in enumerate('xyz'):
                    points[axis] = truth.surface[k, ..., i]
                bag.cloud('/truth', stamp, frame_id, points)


def read_recording(path: Path, topic: str = 'markers') -> Recording:
    """Read a bag's markers and truth. Raises FormatError naming the bag and what is wrong."""
    clouds, labels = _read_clouds(path, (topic, 'truth'))
    if topic not in clouds:
        raise FormatError(f'{path}: the topic {topic} has no messages')
    markers = _sequence(clouds[topic], labels, f'{path}: {topic}')
    if 'truth' not in clouds:
        return Recording(markers)
    return Recording(markers, _truth(clouds['truth'], len(markers.labels), f'{path}: truth'))


def read_clouds(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Read the stamps [ns] and PointCloud2 messages of one topic."""
    return _read_clouds(path, (topic,))[0].get(topic, [])


def _read_clouds(
    path: Path, topics: tuple[str, ...]
) -> tuple[dict[str, list[tuple[int, Any]]], tuple[str, ...]]:
    clouds: dict[str, list[tuple[int, Any]]] = {}
    try:
        with Reader(path) as reader:
            labels = _labels(reader)
            wanted = [c for c in reader.connections if c.topic.lstrip('/') in topics]
            missing = topics[0] not in {c.topic.lstrip('/') for c in wanted}
            found = ', '.join(sorted(c.topic for c in reader.connections)) or 'none'
            kinds = {c.topic: c.msgtype for c in wanted if c.msgtype != CLOUD}
            if not missing and not kinds:
                for connection, _, data in reader.messages(wanted):
                    message: Any = TYPES.deserialize_cdr(data, CLOUD)
                    time = message.header.stamp
                    stamp = time.sec * 10**9 + time.nanosec
                    clouds.setdefault(connection.topic.lstrip('/'), []).append((stamp, message))
    except FileNotFoundError:
        raise FormatError(f'{path}: no bag is there') from None
    except Exception as error:  # the library raises many kinds for a damaged file
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise FormatError(f'{path}: not a readable rosbag2 recording: {reason}') from None
    if missing:
        raise FormatError(f'{path}: no topic {topics[0]} (topics: {found})')
    for name, kind in kinds.items():
        raise FormatError(f'{path}: topic {name} holds {kind}, expected {CLOUD}')
    return clouds, labels


def _labels(reader: Reader) -> tuple[str, ...]:
    custom = reader.storage.metadata.custom or {}
    labels = json.loads(custom.get(OWN_KEY, '{"labels": []}'))['labels']
    if not all(isinstance(label, str) for label in labels) or len(set(labels)) < len(labels):
        raise ValueError(f'the custom data {OWN_KEY} holds no list of different labels')
    return tuple(labels)


def _is_own(path: Path) -> bool:
    try:
        with Reader(path) as reader:
            return OWN_KEY in (reader.storage.metadata.custom or {})
    except Exception:  # whatever is there, it is not a bag of ours
        return False


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _sequence(
    clouds: list[tuple[int, Any]], labels: tuple[str, ...], source: str
) -> MarkerSequence:
    """Gather clouds into one array, in the order recorded."""
    frames = []
    for k, (_, message) in enumerate(clouds):
        try:
            columns, positions = _columns(message)
        except FrameError as error:
            raise FormatError(f'{source}: message {k}: {error}') from None
        bad = ~np.isfinite(positions).all(axis=1)
        if bad.any():
            column = int(columns[int(bad.argmax())])
            name = labels[column] if 0 <= column < len(labels) else f'marker{column}'
            name = 'a point without a label' if column < 0 else name
            raise FormatError(f'{source}: message {k}: {name} has a coordinate that is not finite')
        frames.append((columns, positions))
    every = np.concatenate([columns for columns, _ in frames])
    if not every.size and not labels:
        raise FormatError(f'{source}: no markers in any message')
    known = max(len(labels), int(every.max(initial=-1)) + 1)
    strangers = max(0, -int(every.min(initial=0)))
    names = labels + tuple(f'marker{i}' for i in range(len(labels), known))
    names += tuple(f'Unlabeled {i}' for i in range(strangers))
    stacked = np.full((len(frames), len(names), 3), np.nan)
    for k, (columns, positions) in enumerate(frames):
        stacked[k, np.where(columns < 0, known - 1 - columns, columns)] = positions
    stamps = np.array([stamp for stamp, _ in clouds], np.int64)
    frame_id = clouds[0][1].header.frame_id
    for k, (_, message) in enumerate(clouds):
        if message.header.frame_id != frame_id:
            raise FormatError(
                f'{source}: message {k} is in the frame {message.header.frame_id!r}, those before '
                f'in {frame_id!r}'
            )
    return MarkerSequence(stamps, names, stacked, ~np.isnan(stacked[..., 0]), frame_id)


def _columns(message: Any) -> tuple[IntArray, FloatArray]:
    """Columns, shape (points,), and positions [m]; the k-th unlabelled point is column -1 - k."""
    track = ('track',) if 'track' in [field.name for field in message.fields] else ()
    points = decode(message, ('x', 'y', 'z', 'id', *track)).ravel()
    columns = whole(points, 'track' if track else 'id')
    unlabelled = columns == UNLABELLED
    if columns[~unlabelled].max(initial=0) > MOST_MARKERS:
        raise FrameError(f'marker id {columns[~unlabelled].max()} is above {MOST_MARKERS}')
    if len(np.unique(columns[~unlabelled])) < np.count_nonzero(~unlabelled):
        raise FrameError('a marker id is there twice')
    columns[unlabelled] = -1 - np.arange(np.count_nonzero(unlabelled))
    return columns, xyz(points)


def _truth(clouds: list[tuple[int, Any]], markers: int, source: str) -> Truth:
    try:
        grids = [decode(message, ('x', 'y', 'z', 'id')) for _, message in clouds]
    except FrameError as error:
        raise FormatError(f'{source}: {error}') from None
    ids = whole(grids[0], 'id')
    ids[ids == UNLABELLED] = -1
    if any(grid.shape != ids.shape for grid in grids):
        raise FormatError(f'{source}: the surface changes its size')
    if not set(range(markers)) <= set(ids.ravel().tolist()):
        raise FormatError(f'{source}: not every marker is on the surface')
    surface = np.array([xyz(grid).reshape(*ids.shape, 3) for grid in grids])
    if not np.isfinite(surface).all():
        raise FormatError(f'{source}: a coordinate is not finite')
    return Truth(np.array([stamp for stamp, _ in clouds], np.int64), surface, ids)
