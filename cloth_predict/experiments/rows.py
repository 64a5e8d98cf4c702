"""What an experiment is asked for, and what it gives: a row of the table and its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

Progress = Callable[[float], None]
"""Called with the share of an experiment that was done since the last call."""


@dataclass(frozen=True)
class Scope:
    """How far an experiment goes, and where its pictures go.

    quick: shorter runs and fewer iterations; data: folder of real recordings, or None.
    """

    output: Path
    quick: bool = False
    data: Path | None = None
    progress: Progress = lambda share: None

    def save(self, figure: Figure, name: str) -> str:
        """Write a picture beside the table; returns its name."""
        figure.savefig(self.output / name, dpi=110)
        return name


@dataclass(frozen=True)
class Row:
    """Figures of the thesis, what it says of them, what became of its recipe and of ours, and why.

    numbers: what the words rest on, in SI units; pictures: names of files beside the table.
    """

    figure: str
    paper: str
    recipe: str
    ours: str
    why: str
    numbers: dict[str, float] = field(default_factory=dict)
    pictures: tuple[str, ...] = ()
    skipped: bool = False

    @classmethod
    def left_out(cls, figure: str, paper: str, why: str) -> Row:
        """Say why an experiment was not run."""
        return cls(figure, paper, '-', '-', f'skipped: {why}', skipped=True)

    def summary(self) -> dict[str, Any]:
        """Return what JSON can hold: a number that is not finite becomes None."""
        found = asdict(self)
        found['pictures'] = list(self.pictures)
        found['numbers'] = {
            name: float(value) if isfinite(value) else None for name, value in self.numbers.items()
        }
        return found


@dataclass(frozen=True)
class Experiment:
    """Figures of the thesis by their numbers, its claim, and the function that makes the row."""

    figures: tuple[str, ...]
    paper: str
    run: Callable[[Scope], Row]
    label: str = ''
    """Tells experiments on the same figures apart."""

    @property
    def name(self) -> str:
        """Figures in short, such as `6.1-6.3`."""
        ends = dict.fromkeys((self.figures[0], self.figures[-1]))
        return ' '.join(filter(None, ('-'.join(ends), self.label)))

    def is_asked_for(self, only: str) -> bool:
        """Whether `only`, a figure such as `6.6`, a chapter or a name, means this one."""
        return only in self.figures or only == self.name or only == self.figures[0].split('.')[0]


def figures(chapter: int, first: int, last: int) -> tuple[str, ...]:
    """Numbers of the figures of a chapter from the first to the last."""
    return tuple(f'{chapter}.{number}' for number in range(first, last + 1))


def short(value: float, unit: str = '') -> str:
    """Return a number as it stands in a sentence: three digits, or a power of ten."""
    if not isfinite(value):
        return 'nothing finite'
    words = f'{value:.2g}' if value == 0 or 1e-3 <= abs(value) < 1e4 else f'{value:.1e}'
    return f'{words} {unit}'.rstrip()
