"""A search that is kept in a file as it goes, so that it can be continued."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cloth_predict.errors import FormatError
from cloth_predict.formats.files import writing
from cloth_predict.identification.optimisers.result import Costs
from cloth_predict.types import FloatArray

FORMAT = 'cloth_predict study 1'


@dataclass(frozen=True)
class StudyFile:
    """Where a search is kept as it goes, and whether it goes on with what is there."""

    path: Path
    resume: bool = False

    @classmethod
    def beside(cls, output: Path, resume: Path | None = None) -> StudyFile:
        """Beside the file of the result, unless there is one to go on with."""
        return cls(resume or output.with_suffix('.study.jsonl'), resume is not None)


class Study:
    """Costs that remember what was evaluated, in a file of JSON lines.

    The first line says of what the study is; each further one holds a check of the vector, its
    cost, and the values of its gradient, if any. A search is the same for the same seed, so that
    one that is continued asks for the same vectors again and gets the old costs from the file,
    until it comes to where it ended: no state of any optimiser needs to be kept.
    """

    def __init__(self, costs: Costs, file: StudyFile, facts: Mapping[str, str]) -> None:
        """Begin a file, or go on with it.

        facts: what the costs depend on, by name. Raises FormatError where the file is of something
        else, and names the first fact that differs.
        """
        self._costs, self._path = costs, file.path
        self._old: list[list[Any]] = _read(file.path, facts) if file.resume else []
        self._next = 0
        if not file.resume:
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
        old = self._remembered(vectors, 2)
        found = [_float(entry[1]) for entry in old]
        for vector, cost in zip(
            vectors[len(old) :], self._costs.values(vectors[len(old) :]), strict=True
        ):
            self._write([_check(vector), _plain(cost)])
            found.append(cost)
        return found

    def gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Cost and derivative, from the file if known."""
        if old := self._remembered([vector], 2 + len(vector)):
            _, cost, *slope = old[0]
            return _float(cost), np.array(slope, float)
        found = self._costs.gradient(vector)
        self._write([_check(vector), _plain(found[0]), *map(_plain, found[1].tolist())])
        return found

    def _remembered(self, vectors: Sequence[FloatArray], size: int) -> list[list[Any]]:
        """Entries of the file, of `size` values each, for the first of the vectors."""
        entries = self._old[self._next : self._next + len(vectors)]
        for entry, vector in zip(entries, vectors, strict=False):
            if entry[0] != _check(vector) or len(entry) != size:
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
        raise FormatError(f'{path}: is no study of a search')
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
            if not line.endswith('\n') or not _is_evaluation(entry):
                raise ValueError
        except ValueError:
            if number < len(lines):
                raise FormatError(f'{path}: line {number} is no evaluation') from None
            with writing(path):
                path.write_text(''.join(lines[:-1]), encoding='utf-8')
            break
        entries.append(entry)
    return entries


def _is_evaluation(entry: Any) -> bool:
    """Whether a line holds a check, and one number or more, `null` for one that is not finite."""
    match entry:
        case [str(), _, *_]:
            return all(isinstance(value, int | float | None) for value in entry[1:])
    return False


def _check(vector: FloatArray) -> str:
    """Twelve digits that tell vectors apart."""
    return hashlib.sha256(np.ascontiguousarray(vector, float).tobytes()).hexdigest()[:12]


def _plain(number: float) -> float | None:
    """Return a number as JSON has it: none for one that is not finite."""
    return float(number) if np.isfinite(number) else None


def _float(number: float | None) -> float:
    return float('nan') if number is None else number
