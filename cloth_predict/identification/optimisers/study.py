"""A search that is kept in a file as it goes, so that it can be continued."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cloth_predict.errors import FormatError
from cloth_predict.formats.files import writing
from cloth_predict.identification.optimisers.result import Costs
from cloth_predict.types import FloatArray

FORMAT = 'cloth_predict identify 1'


class Study:
    """Costs that remember what was evaluated, in a file of JSON lines.

    The first line says of what the study is; each further one holds a check of the vector, its
    cost, and maybe its gradient. A search is the same for the same seed, so that one that is
    continued asks for the same vectors again and gets the old costs from the file, until it comes
    to where it ended: no state of any optimiser needs to be kept.
    """

    def __init__(self, costs: Costs, path: Path, facts: Mapping[str, str], resume: bool) -> None:
        """Begin a file, or go on with one.

        facts: what the costs depend on, by name. Raises FormatError where the file is of something
        else, and names the first fact that differs.
        """
        self._costs, self._path = costs, path
        self._old: list[list[Any]] = _read(path, facts) if resume else []
        self._next = 0
        if not resume:
            self._write({'format': FORMAT, **facts}, 'w')

    @property
    def gradient_price(self) -> int:
        """See `Costs`."""
        return self._costs.gradient_price

    @property
    def known(self) -> int:
        """How many evaluations come from the file."""
        return len(self._old)

    def values(self, vectors: Sequence[FloatArray]) -> list[float]:
        """Costs, those that are known from the file."""
        old = self._remembered(vectors)
        found = [_float(entry[1]) for entry in old]
        for vector, cost in zip(
            vectors[len(old) :], self._costs.values(vectors[len(old) :]), strict=True
        ):
            self._write([_check(vector), _plain(cost)])
            found.append(cost)
        return found

    def gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Cost and derivative, from the file if known."""
        if old := self._remembered([vector]):
            _, cost, slope = old[0]
            return _float(cost), np.array(slope, float)
        cost, slope = self._costs.gradient(vector)
        self._write([_check(vector), _plain(cost), [_plain(s) for s in slope.tolist()]])
        return cost, slope

    def _remembered(self, vectors: Sequence[FloatArray]) -> list[list[Any]]:
        """Entries of the file for the first of the vectors."""
        entries = self._old[self._next : self._next + len(vectors)]
        for entry, vector in zip(entries, vectors, strict=False):
            if entry[0] != _check(vector):
                raise FormatError(
                    f'{self._path}: line {self._next + 2} is of another search than this: the '
                    f'optimiser, its version or the settings of the search differ'
                )
            self._next += 1
        return entries

    def _write(self, line: object, mode: str = 'a') -> None:
        with writing(self._path), self._path.open(mode, encoding='utf-8') as file:
            file.write(json.dumps(line) + '\n')


def _read(path: Path, facts: Mapping[str, str]) -> list[list[Any]]:
    """Evaluations of a study; a last line that was cut off is dropped, from the file too."""
    try:
        lines = path.read_text(encoding='utf-8').splitlines(keepends=True)
        head = json.loads(lines[0]) if lines else None
    except OSError as error:
        raise FormatError(f'{path}: {error.strerror}') from None
    except ValueError:
        head = None
    if not isinstance(head, dict) or head.get('format') != FORMAT:
        raise FormatError(f'{path}: is no study of identify')
    for name in dict.fromkeys([*facts, *head]):
        if name != 'format' and head.get(name) != facts.get(name):
            raise FormatError(
                f'{path}: is a study of something else: {name} is {head.get(name)} there, and '
                f'{facts.get(name)} here'
            )
    entries = []
    for number, line in enumerate(lines[1:], 2):
        try:
            entry = json.loads(line)
            if not line.endswith('\n') or not isinstance(entry, list) or len(entry) not in (2, 3):
                raise ValueError
        except ValueError:
            if number < len(lines):
                raise FormatError(f'{path}: line {number} is no evaluation') from None
            path.write_text(''.join(lines[:-1]), encoding='utf-8')
            break
        entries.append(entry)
    return entries


def _check(vector: FloatArray) -> str:
    """Twelve digits that tell vectors apart."""
    return hashlib.sha256(np.ascontiguousarray(vector, float).tobytes()).hexdigest()[:12]


def _plain(number: float) -> float | None:
    """Return a number as JSON has it: none for one that is not finite."""
    return float(number) if np.isfinite(number) else None


def _float(number: float | None) -> float:
    return float('nan') if number is None else number
