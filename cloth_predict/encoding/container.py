"""The file of an encoded recording: an MCAP file of CDR messages whose schemas it holds.

Any MCAP reader reads it. Each message is a chunk of its own, with a checksum. The first, on
`/encoding`, says what the others need; those on `/frames` are the frames, some at a time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cloth_predict.errors import FormatError
from cloth_predict.formats.files import writing

VERSION = 1
"""Of the format. The first field of the first message of every version is its number."""
ENCODING, FRAMES = '/encoding', '/frames'
SCHEMAS = {
    'cloth_predict/msg/Encoding': """\
# A recording of markers as the model expects it, and how far each marker was from that.
uint32 version      # of the format
string software     # that wrote it
string parameters   # of the model and the filter, YAML as ROS reads it
string[] labels     # of the markers, in the order of `visible` and `residual`
string frame_id
float64 max_error   # m; no rebuilt marker is farther from the recorded one
float64 step        # m; rebuilt coordinates are whole multiples of it
uint32 frames       # of the whole recording
""",
    'cloth_predict/msg/Frames': """\
# Some frames. Each uint8[] is a zlib stream (RFC 1950) of little-endian numbers.
uint32 frames
uint8[] stamps      # int64, ns; the first, its difference to the next, then second differences
uint8[] visible     # bits from the highest on; frame by frame, marker by marker
uint8[] rounding    # uint8 per frame: which offset rounds what is expected
uint8[] residual    # int8; x, y, z of each visible marker in turn; -128: see `large`
uint8[] large       # int64; residuals beyond int8, in turn
uint32 checksum     # CRC-32 of the rebuilt multiples of the step, int64, 0 where not visible
""",
}
TYPES = get_typestore(Stores.EMPTY)
for _name, _text in SCHEMAS.items():
    TYPES.register(get_types_from_msg(_text, _name))
_KINDS = {ENCODING: 'cloth_predict/msg/Encoding', FRAMES: 'cloth_predict/msg/Frames'}


class EncodedWriter:
    """Writes the messages of an encoded recording."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._written = 0

    def write(self, topic: str, stamp: int, **fields: Any) -> None:
        """Write a message of the topic's kind at stamp [ns]."""
        kind = _KINDS[topic]
        if topic not in self._channels:
            schema = self._writer.register_schema(kind, 'ros2msg', SCHEMAS[kind].encode())
            self._channels[topic] = self._writer.register_channel(topic, 'cdr', schema)
        data = bytes(TYPES.serialize_cdr(TYPES.types[kind](**fields), kind))
        self._writer.add_message(self._channels[topic], stamp, data, stamp, self._written)
        self._written += 1


@contextmanager
def create_encoded(path: Path) -> Iterator[EncodedWriter]:
    """Open a new file; it appears under `path` only when it is complete.

    A file that this project encoded before is replaced; anything else there is an error.
    """
    if os.path.lexists(path) and not _is_own(path):
        raise FormatError(f'{path}: exists and was not made by `encode`; not overwritten')
    partial = path.with_name(f'.{path.name}.partial')
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open('wb') as file:
                writer = Writer(file, chunk_size=1)  # a checksum for each message
                writer.start('ros2', 'cloth-predict')
                yield EncodedWriter(writer)
                writer.finish()  # type: ignore[no-untyped-call]
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_encoded(path: Path) -> Iterator[tuple[str, Any]]:
    """Yield topic and message, in order, up to the first fault.

    Raises FormatError, which names the file and what is wrong with it, at the fault: what was
    yielded before is sound.
    """
    expected = 0
    try:
        with path.open('rb') as file:
            size, topics = os.fstat(file.fileno()).st_size, dict[int, str]()
            reader = StreamReader(file, validate_crcs=True, record_size_limit=size)
            for record in reader.records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    topic = topics[record.channel_id]
                    _check(topic, record.data, path)
                    if record.sequence != expected:
                        raise ValueError(f'message {expected} is missing')
                    message = TYPES.deserialize_cdr(record.data, _KINDS[topic])
                    expected += 1
                    yield topic, message
    except FileNotFoundError:
        raise FormatError(f'{path}: no such file') from None
    except FormatError:
        raise
    except Exception as error:  # the libraries raise many kinds for a damaged file
        reason = ' '.join(str(error).split()) or type(error).__name__
        damaged = f'damaged after message {expected}'
        where = damaged if expected else 'not made by `encode`, or damaged from its start on'
        raise FormatError(f'{path}: {where}: {reason}') from None


def _check(topic: str, data: bytes, path: Path) -> None:
    """Raise FormatError of a topic or a version that is not known, whatever else is in it."""
    if topic not in _KINDS:
        raise FormatError(f'{path}: not a recording made by `encode`')
    version = int.from_bytes(data[4:8], 'little')  # after the four bytes that say how it is coded
    if topic == ENCODING and version != VERSION:
        raise FormatError(
            f'{path}: version {version} of the format, and this software reads version {VERSION}'
        )


def _is_own(path: Path) -> bool:
    try:
        with path.open('rb') as file:
            return make_reader(file).get_header().library == 'cloth-predict'
    except Exception:  # whatever is there, it is no file of ours
        return False
