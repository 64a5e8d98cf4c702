"""Pairs of a point in the mocap frame and the pixel that lights it, as a table (CSV)."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cloth_predict.errors import FormatError
from cloth_predict.types import FloatArray

COLUMNS = ('x', 'y', 'z', 'u', 'v')


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points [m], shape (n, 3), their pixels [px], shape (n, 2), and their lines in the file."""

    points: FloatArray
    pixels: FloatArray
    lines: tuple[int, ...]


def read_pairs(path: Path, width: int, height: int) -> Pairs:
    """Read a table whose first line names the columns x, y, z, u, v, in any order.

    Other columns are left aside; width, height: of the frame [px] in which the pixels have to be.
    Raises FormatError, which names the file, line and column.
    """
    try:
        with path.open(encoding='utf-8-sig', newline='') as stream:
            reader = csv.reader(stream)
            rows = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except OSError as error:
        raise FormatError(f'{path}: cannot be read: {error.strerror}') from None
    except (ValueError, csv.Error) as error:
        raise FormatError(f'{path}: not a table in CSV: {error}') from None
    if not rows:
        raise FormatError(f'{path}: empty file')
    line, header = rows[0]
    names = [name.strip().lower() for name in header]
    for column in COLUMNS:
        if names.count(column) != 1:
            lack = 'twice' if column in names else 'missing'
            raise FormatError(
                f'{path}:{line}: column {column} {lack}: the first line has to name x,y,z,u,v'
            )
    for line, row in rows[1:]:
        if len(row) != len(names):
            raise FormatError(f'{path}:{line}: {len(row)} cells, the first line has {len(names)}')
    places = [(names.index(column), column) for column in COLUMNS]
    table = [
        [_number(row[place], f'{path}:{line}: column {column}') for place, column in places]
        for line, row in rows[1:]
    ]
    lines = tuple(line for line, _ in rows[1:])
    for line, (*_, u, v) in zip(lines, table, strict=True):
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            raise FormatError(
                f'{path}:{line}: pixel {u:g}, {v:g} is outside the frame of {width} x {height}'
            )
    numbers = np.array(table, dtype=float).reshape(-1, 5)
    return Pairs(numbers[:, :3], numbers[:, 3:], lines)


def _number(cell: str, place: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise FormatError(f'{place}: {cell.strip()!r} is not a number') from None
    if not math.isfinite(number):
        raise FormatError(f'{place}: {cell.strip()} is not finite')
    return number
