"""OptiTrack Motive CSV exports, format 1.20 and later.

The first line is ``key,value,...``; then come header rows for type, name, ID and parent (the last
two not in every version), the property (Position, Rotation, Marker Quality ...) and the axes, which
begin with ``Frame``. One row per frame follows; an empty cell is a marker that was not seen.
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

from cloth_predict.errors import FormatError
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

Rows: TypeAlias = Iterator[tuple[int, list[str]]]

UNITS_PER_METRE = {'meters': 1.0, 'centimeters': 100.0, 'millimeters': 1000.0}
POSITION = ('Marker', 'Position')
TIME_TOLERANCE = 1.5e-3  # s; the Time column may be rounded to milliseconds
TIME_LIMIT = 9e9  # s; later times do not fit into int64 nanoseconds


@dataclass(frozen=True)
class _Header:
    """What stands above the data.

    A marker's X, Y and Z are the columns start, start + 1 and start + 2 of the file's `width`;
    rate [Hz] and the announced number of frames are 0 where not stated.
    """

    labels: tuple[str, ...]
    starts: tuple[int, ...]
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
    lines, table = _read_table(path, rows, header, ended=raw.endswith((b'\n', b'\r')))
    stamps = _stamps(path, lines, table, header.rate)
    positions = table[:, 2:].reshape(len(table), -1, 3) / header.units_per_metre
    visible = np.isfinite(positions).all(axis=-1)
    positions[~visible] = np.nan  # a marker with one coordinate missing has no position
    return MarkerSequence(stamps, header.labels, positions, np.asarray(visible))


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
        encoding = 'cp1252'  # take and marker names in the code page of a Western Windows
    # Decoded as it goes, because a long recording held as one str of many rows costs gigabytes.
    with io.TextIOWrapper(io.BytesIO(raw), encoding, errors='replace', newline='') as stream:
        reader = csv.reader(stream)
        try:
            yield from ((reader.line_num, row) for row in reader if any(row))
        except csv.Error as error:
            raise FormatError(f'{path}:{reader.line_num}: {error}') from error


def _read_header(path: Path, rows: Rows) -> _Header:
    """Consume the rows down to the axes."""
    first = [cell.strip() for cell in next(rows, (0, ['']))[1]]
    if first[0] != 'Format Version':
        raise FormatError(
            f'{path}: not a Motive CSV export with its header: '
            f'it begins with {first[0][:40]!r}, not with "Format Version"'
        )
    titles = [first]
    while titles[-1][0] != 'Frame':
        row = next(rows, (0, []))[1]
        if not row:
            raise FormatError(f'{path}: no row that begins with "Frame" below the header')
        titles.append([cell.strip() for cell in row])
    width = max(map(len, titles[1:]))
    unit = _setting(first, 'Length Units') or 'Meters'
    if unit.lower() not in UNITS_PER_METRE:
        raise FormatError(f'{path}: unknown Length Units "{unit}"')
    labels, starts = _find_markers(path, [row + [''] * (width - len(row)) for row in titles[1:]])
    rate, announced = (
        float(text) if text.replace('.', '', 1).isdecimal() else 0.0
        for text in (_setting(first, 'Export Frame Rate'), _setting(first, 'Total Exported Frames'))
    )
    return _Header(labels, starts, width, UNITS_PER_METRE[unit.lower()], rate, announced)


def _setting(first: list[str], key: str) -> str:
    """Return the cell after the key, or '' where there is none."""
    # Not by pairs: a comma in the take's name or notes would shift them, and lose the unit.
    return first[first.index(key) + 1] if key in first[:-1] else ''


def _find_markers(
    path: Path, titles: list[list[str]]
) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return labels and first columns of the markers in equally long header rows, axes last."""
    if not ''.join(titles[-1][1:2]).startswith('Time'):
        raise FormatError(f'{path}: no "Time" column beside "Frame"')
    blank = [''] * len(titles[-1])
    *named, properties, axes = [blank] * (4 - len(titles)) + titles
    # Format 1.21 leaves out the row labels in the second cell; the order has always been this.
    by_label = {row[1]: row for row in named}
    kinds, names = by_label.get('Type', named[0]), by_label.get('Name', named[1])
    owners = list(zip(kinds, names, properties, strict=True))
    columns = [i for i, (kind, _, what) in enumerate(owners) if (kind[-6:], what) == POSITION]
    starts = tuple(columns[::3])
    if not starts:
        raise FormatError(f'{path}: no marker columns; export the take with its markers')
    for i in starts:
        if axes[i : i + 3] != ['X', 'Y', 'Z'] or len(set(owners[i : i + 3])) > 1:
            raise FormatError(f'{path}: marker "{names[i]}" does not have the columns X, Y, Z')
    return _unique_labels([kinds[i] for i in starts], [names[i] for i in starts]), starts


def _unique_labels(kinds: list[str], names: list[str]) -> tuple[str, ...]:
    """Return one label per marker; a solved marker yields its name to the measured one."""
    markers = list(zip(kinds, names, strict=True))
    measured = {name for kind, name in markers if kind == 'Marker'}
    wanted = [
        f'{name} ({kind})' if kind != 'Marker' and name in measured else name
        for kind, name in markers
    ]
    labels: dict[str, None] = {}
    for label in wanted:
        copies = (f'{label} #{n}' for n in itertools.count(2))
        free = (copy for copy in copies if copy not in labels and copy not in wanted)
        labels[next(free) if label in labels else label] = None
    return tuple(labels)


def _read_table(
    path: Path, rows: Rows, header: _Header, ended: bool
) -> tuple[IntArray, FloatArray]:
    """Return line numbers and, one row per frame, frame number, time [s] and coordinates.

    Shapes (frames,) and (frames, 2 + 3 markers), in the units of the file, NaN for empty cells;
    `ended` tells whether the last line has its end-of-line.
    """
    pick = itemgetter(0, 1, *(start + axis for start in header.starts for axis in range(3)))
    lines, values, row = array('q'), array('d'), ['']
    for line, row in rows:
        cells = pick(row if len(row) == header.width else _padded(path, line, row, header))
        try:
            values.extend(map(_number, cells))
        except ValueError:
            raise _bad_cell(path, line, cells, header) from None
        lines.append(line)
    found, width, announced = len(lines), header.width, header.announced
    if not found:
        raise FormatError(f'{path}: no frames below the header')
    if not ended and len(row) < width:
        raise FormatError(f'{path}: line {line} has {len(row)} cells of {width}: file truncated?')
    table = np.frombuffer(values).reshape(found, -1)
    report = f'{path}: {found} frames, but the header announces {announced:.0f}: file truncated?'
    if not ended and found < announced:
        raise FormatError(report)
    if max(found, table[-1, 0] + 1) < announced:  # else it is frames in between that are missing
        warnings.warn(report, stacklevel=3)
    return np.frombuffer(lines, np.int64), table


def _padded(path: Path, line: int, row: list[str], header: _Header) -> list[str]:
    """Return the row with the empty cells that an editor trimmed from its end."""
    count, width = len(row), header.width
    split = count < 2 or any(start < count < start + 3 for start in header.starts)
    if split or any(row[width:]):
        hint = 'file truncated?' if split else 'decimal commas?'
        raise FormatError(f'{path}: line {line} has {count} cells of {width}: {hint}')
    return row + [''] * (width - count)


def _number(cell: str) -> float:
    """Return the cell's number, NaN for an empty cell."""
    if not cell or cell.isspace():
        return math.nan
    value = float(cell)
    if not math.isfinite(value) or '_' in cell:  # Python reads 1_0 as 10
        raise ValueError(cell)
    return value


def _bad_cell(path: Path, line: int, cells: tuple[str, ...], header: _Header) -> FormatError:
    """Return the error that names the first cell that is not a number."""
    owners = ['frame', 'time'] + [f'marker "{label}"' for label in header.labels for _ in 'XYZ']
    for i, cell in enumerate(cells):
        try:
            _number(cell)
        except ValueError:
            break
    return FormatError(f'{path}:{line}: {owners[i]}: {cells[i][:40]!r} is not a number')


def _stamps(path: Path, lines: IntArray, table: FloatArray, rate: float) -> IntArray:
    """Return the time of each frame [ns]; rate in Hz, 0 if unknown."""
    frames, seconds = table[:, 0], table[:, 1]
    usable = (np.abs(table[:, :2]) < TIME_LIMIT).all(axis=1)
    if not usable.all():
        line = lines[~usable][0]
        raise FormatError(f'{path}:{line}: frame number or time is missing or too large')
    nanoseconds = seconds * 1e9
    # The rate is exact where the column is rounded, unless the column follows another clock.
    if rate and np.all(np.abs(seconds - frames / rate) <= TIME_TOLERANCE):
        nanoseconds = frames * 1e9 / rate
    stamps = np.rint(nanoseconds).astype(np.int64)
    late = np.flatnonzero(np.diff(stamps) <= 0) + 1
    if late.size:
        before, i = late[0] - 1, late[0]
        raise FormatError(
            f'{path}:{lines[i]}: frame {frames[i]:.0f} at {seconds[i]:.6f} s does not come after '
            f'frame {frames[before]:.0f} at {seconds[before]:.6f} s'
        )
    return stamps
