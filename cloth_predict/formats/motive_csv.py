"""OptiTrack Motive CSV exports, format 1.20 and later.

The first line is ``key,value,...``; then come header rows for type, name, ID and parent (the last
two not in every version), the property (Position, Rotation, Marker Quality ...) and the axes,
beginning with ``Frame``. One row per frame follows; an empty cell is a marker that was not seen.
"""

from __future__ import annotations

import codecs
import csv
import io
import itertools
import math
import warnings
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TypeAlias

import numpy as np

from cloth_predict.errors import ClothPredictWarning, FormatError
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

Rows: TypeAlias = Iterator[tuple[int, list[str]]]

UNITS_PER_METRE = {'meters': 1.0, 'centimeters': 100.0, 'millimeters': 1000.0}
TIME_TOLERANCE = 1.5e-3  # s; the Time column may be rounded to milliseconds
TIME_LIMIT = 9e9  # s; later times do not fit into int64 nanoseconds


@dataclass(frozen=True)
class _Header:
    """What stands above the data: the markers with their columns X, and the numbers of line 1.

    Y and Z follow X; rate [Hz] and announced frames are NaN where not stated.
    """

    labels: tuple[str, ...]
    columns: tuple[int, ...]
    width: int
    units_per_metre: float
    rate: float
    announced: float


def read_motive_csv(path: Path) -> MarkerSequence:
    """Read the markers of a Motive CSV export, in the order of its columns.

    Solved markers of rigid bodies and bones come with the measured ones; poses and qualities do
    not. Positions in m, shape (frames, markers, 3); stamps in ns on the clock of the file.

    Raises FormatError, one line that begins with the path, for a file that cannot be read, is not
    a Motive export, has no markers or frames, or has a bad cell, a cut row or times out of order.
    Warns when whole lines seem to be missing at the end.
    """
    raw = _read_bytes(path)
    rows = _rows(path, raw)
    header = _read_header(path, rows)
    cut = 0 if raw.endswith((b'\n', b'\r')) else raw.count(b'\n') + 1
    lines, table = _read_table(path, rows, header, cut)
    _check_end(path, table[:, 0], header.announced, cut)
    stamps = _stamps(path, lines, table, header.rate)
    positions = table[:, 2:].reshape(len(table), -1, 3) / header.units_per_metre
    visible = np.asarray(np.isfinite(positions).all(axis=2))
    positions[~visible] = np.nan  # a marker with one coordinate missing has no position
    return MarkerSequence(stamps, header.labels, positions, visible)


def _read_bytes(path: Path) -> bytes:
    try:
        raw = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise FormatError(f'{path}: cannot be read: {error.strerror}') from error
    if not raw.strip():
        raise FormatError(f'{path}: empty file')
    if b'\0' in raw:
        raise FormatError(f'{path}: not a text file, so not a Motive CSV export')
    return raw


def _rows(path: Path, raw: bytes) -> Rows:
    """Yield line number and cells of every row that is not blank."""
    try:
        raw.decode()
        encoding = 'utf-8'
    except UnicodeDecodeError:
        encoding = 'cp1252'  # names in the code page of a Western Windows
    # Decoded as it goes: a long recording held as rows of str would take gigabytes.
    with io.TextIOWrapper(io.BytesIO(raw), encoding, errors='replace', newline='') as stream:
        reader = csv.reader(stream)
        try:
            yield from ((reader.line_num, row) for row in reader if any(row))
        except csv.Error as error:
            raise FormatError(f'{path}:{reader.line_num}: {error}') from error


def _read_header(path: Path, rows: Rows) -> _Header:
    """Consume the rows down to the axes."""
    first = [cell.strip() for _, row in itertools.islice(rows, 1) for cell in row]
    if first[:1] != ['Format Version']:
        begin = ','.join(first)[:40]
        raise FormatError(f'{path}: begins with {begin!r}: not a Motive CSV export with header')
    titles: list[list[str]] = [['']]
    while titles[-1][0] != 'Frame':
        row = next(rows, (0, []))[1]
        if not row:
            raise FormatError(f'{path}: no header row that begins with "Frame"')
        titles.append([cell.strip() for cell in row])
    width = max(map(len, titles))
    labels, columns = _find_markers(path, [row + [''] * (width - len(row)) for row in titles[1:]])
    unit = _setting(first, 'Length Units') or 'Meters'
    if unit.lower() not in UNITS_PER_METRE:
        raise FormatError(f'{path}: unknown Length Units "{unit}"')
    scale, rate = UNITS_PER_METRE[unit.lower()], _number(_setting(first, 'Export Frame Rate'))
    announced = _number(_setting(first, 'Total Exported Frames'))
    return _Header(labels, columns, width, scale, rate, announced)


def _setting(first: list[str], key: str) -> str:
    """Return the cell after the key, or '' where there is none."""
    # Not by pairs: a comma in the take's name or notes would shift them, and lose the unit.
    return first[first.index(key) + 1] if key in first[:-1] else ''


def _find_markers(path: Path, titles: list[list[str]]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return labels and X columns of the markers; header rows of one length, the axes last."""
    if not ''.join(titles[-1][1:2]).startswith('Time'):
        raise FormatError(f'{path}: no "Time" column beside "Frame"')
    *named, properties, axes = [[''] * len(titles[-1])] * (4 - len(titles)) + titles
    # Format 1.21 leaves out the row labels in the second cell; the order has always been this.
    by_label = {row[1]: row for row in named}
    kinds, names = by_label.get('Type', named[0]), by_label.get('Name', named[1])
    cells = list(zip(kinds, names, properties, strict=True))
    found = [i for i, cell in enumerate(cells) if cell[0].endswith('Marker')]
    columns = [i for i in found if properties[i] == 'Position'][::3]
    if not columns:
        raise FormatError(f'{path}: no marker columns; export the take with its markers')
    for x in columns:
        if axes[x : x + 3] != ['X', 'Y', 'Z'] or len(set(cells[x : x + 3])) > 1:
            raise FormatError(f'{path}: marker "{names[x]}" does not have the columns X, Y, Z')
    return _unique_labels([cells[x][:2] for x in columns]), tuple(columns)


def _unique_labels(markers: list[tuple[str, str]]) -> tuple[str, ...]:
    """Return a label per type and name; a solved marker yields its name to the measured one."""
    measured = {name for kind, name in markers if kind == 'Marker'}
    wanted = [
        f'{name} ({kind})' if kind != 'Marker' and name in measured else name
        for kind, name in markers
    ]
    labels: list[str] = []
    taken = set(wanted)
    for i, label in enumerate(wanted):
        copies = (f'{label} #{n}' for n in itertools.count(2))
        free = (copy for copy in copies if copy not in taken)
        labels.append(next(free) if label in wanted[:i] else label)
        taken.add(labels[-1])
    return tuple(labels)


def _read_table(path: Path, rows: Rows, header: _Header, cut: int) -> tuple[IntArray, FloatArray]:
    """Return line numbers and, one row per frame, frame number, time [s] and coordinates.

    Shapes (frames,) and (frames, 2 + 3 markers), in the units of the file, NaN for empty cells;
    `cut` is the number of the last line if it lacks its end-of-line, else 0.
    """
    pick = itemgetter(0, 1, *(x + axis for x in header.columns for axis in range(3)))
    owners = ['frame', 'time', *(f'marker "{label}"' for label in header.labels for _ in 'XYZ')]
    lines, values = array('q'), array('d')
    for line, row in rows:
        cells = pick(row if len(row) == header.width else _padded(path, line, row, header, cut))
        numbers = list(map(_number, cells))
        if math.inf in numbers:
            bad = numbers.index(math.inf)
            raise FormatError(f'{path}:{line}: {owners[bad]}: {cells[bad][:40]!r} is no number')
        values.extend(numbers)
        lines.append(line)
    if not lines:
        raise FormatError(f'{path}: no frames below the header')
    return np.frombuffer(lines, np.int64), np.frombuffer(values).reshape(len(lines), -1)


def _number(cell: str) -> float:
    """Return the cell's number: NaN for an empty cell, infinity for one that is not a number."""
    if not cell or cell.isspace():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        return math.inf
    # Python reads 1_0 as ten.
    return value if math.isfinite(value) and '_' not in cell else math.inf


def _padded(path: Path, line: int, row: list[str], header: _Header, cut: int) -> list[str]:
    """Return the row with the empty cells that an editor trimmed from its end."""
    count, width = len(row), header.width
    split = count < 2 or any(x < count < x + 3 for x in header.columns)
    if split or any(row[width:]) or (line == cut and count < width):
        hint = 'file truncated?' if count < width else 'decimal commas?'
        raise FormatError(f'{path}: line {line} has {count} cells of {width}: {hint}')
    return row + [''] * (width - count)


def _check_end(path: Path, frames: FloatArray, announced: float, cut: int) -> None:
    """Refuse or report a file that stops early; frames missing in between are no reason."""
    text = f'{path}: {len(frames)} frames, but the header announces {announced:.0f}'
    if cut and len(frames) < announced:
        raise FormatError(f'{text} and line {cut} has no end: file truncated?')
    if max(len(frames), frames[-1] + 1) < announced:
        warnings.warn(text, ClothPredictWarning, stacklevel=3)


def _stamps(path: Path, lines: IntArray, table: FloatArray, rate: float) -> IntArray:
    """Return the time of each frame [ns], shape (frames,), from its number or its time."""
    frames, seconds = table[:, 0], table[:, 1]
    usable = (np.abs(table[:, :2]) < TIME_LIMIT).all(axis=1)
    if not usable.all():
        raise FormatError(f'{path}:{lines[~usable][0]}: frame or time is missing or too large')
    nanoseconds = seconds * 1e9
    # The rate is exact where the column is rounded, unless the column follows another clock.
    if rate > 0 and np.all(np.abs(seconds - frames / rate) <= TIME_TOLERANCE):
        nanoseconds = frames * 1e9 / rate
    stamps = np.rint(nanoseconds).astype(np.int64)
    late = np.flatnonzero(np.diff(stamps) <= 0) + 1
    if late.size:
        row = f'frame {frames[late[0]]:.0f} at {seconds[late[0]]:.6f} s'
        raise FormatError(f'{path}:{lines[late[0]]}: {row} is not later than the one before')
    return stamps
