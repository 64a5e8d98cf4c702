"""What an identification found, and what it tells of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from cloth_predict.config import Config
from cloth_predict.identification.objectives.determined import LOOSE, Determined
from cloth_predict.identification.optimisers.family import Method
from cloth_predict.identification.optimisers.result import Result
from cloth_predict.identification.provenance import HELD_OUT, with_provenance
from cloth_predict.identification.task import Task

NEAR = 0.02
"""Distance from an end of the range, on the scale of the search, that counts as being there."""
MOST_LISTED = 24
"""Parameters that are told one by one in a text; of more, those that stand out."""
MOST_NAMED = 6
"""Parameters that a line names."""


@dataclass(frozen=True)
class Outputs:
    """Files that are written: the parameters, and the curve of the cost."""

    configuration: Path
    curve: Path

    @classmethod
    def at(cls, output: Path) -> Outputs:
        """Beside a file, or in a folder."""
        if output.suffix.lower() not in ('.yaml', '.yml'):
            output = output / 'identified.yaml'
        return cls(output, output.with_suffix('.png'))


@dataclass(frozen=True)
class Scores:
    """RMS distances [mm] of the free markers with the first parameters and those found."""

    before: float
    after: float

    @property
    def gain(self) -> str:
        """Change in per cent."""
        return f'{100.0 * (self.after / self.before - 1.0):+.1f} %' if self.before else 'exact'


@dataclass(frozen=True)
class Value:
    """A parameter before and after, with its standard deviation; NaN where that was not found out.

    loose: whether the data do not fix it; end: at which end of its range it is, if at one.
    """

    name: str
    before: float
    after: float
    sigma: float
    loose: bool
    end: str

    @property
    def words(self) -> str:
        """Values, standard deviation, and what speaks against them."""
        spread = '' if np.isnan(self.sigma) else f' +- {self.sigma:.2g}'
        loose = ', not fixed by these recordings' if self.loose else ''
        end = f', at the {self.end} end of its range' if self.end else ''
        return f'{self.before:.4g} -> {self.after:.4g}{spread}{loose}{end}'


@dataclass(frozen=True)
class Identified:
    """Identified parameters: their configuration, the search, and how far to trust them.

    determined, scores: none where the search was interrupted.
    """

    task: Task
    method: Method
    config: Config
    result: Result
    weight: float
    recordings: tuple[str, ...]
    held_out: tuple[str, ...]
    determined: Determined | None = None
    scores: dict[str, Scores] = field(default_factory=dict)

    @cached_property
    def parameters(self) -> tuple[Value, ...]:
        """What became of each parameter."""
        space, best = self.task.space, self.result.best
        sure = self.determined
        sigma = np.full(len(space), np.nan) if sure is None else sure.sigma
        columns = (space.values(space.start), space.values(best), sigma * space.slope(best), sigma)
        low, high = space.bounds
        ends = np.where(best - low < NEAR, 'low', np.where(high - best < NEAR, 'high', ''))
        rows = zip(space.names, *(column.tolist() for column in (*columns, ends)), strict=True)
        return tuple(
            Value(name, before, after, spread, bool(relative > LOOSE), end)
            for name, before, after, spread, relative, end in rows
        )

    @property
    def loose(self) -> tuple[str, ...]:
        """Parameters that the data do not fix."""
        return tuple(value.name for value in self.parameters if value.loose)

    @property
    def caution(self) -> str:
        """What speaks against the result, in one line, or nothing."""
        if not self.loose:
            return ''
        return f'these recordings do not fix {_listed(self.loose)}: do not trust the values'

    @property
    def trace(self) -> list[tuple[int, float]]:
        """Evaluations, and the best RMS distance [mm] after them."""
        return [(number, 1e3 * sqrt(cost / self.weight)) for number, cost in self.result.trace]

    def summary(self) -> dict[str, Any]:
        """Return the numbers as `identify --json` prints them."""
        found, task = self.result, self.task
        return {
            'objective': task.objective,
            'meaning': task.meaning,
            'optimiser': self.method.optimiser,
            'seed': self.method.seed,
            'recordings': list(self.recordings),
            'held_out': list(self.held_out),
            'evaluations': found.evaluations,
            'refused': found.refused,
            'stopped': found.stopped,
            'interrupted': found.interrupted,
            'study': self.method.study,
            'best_mm': self.trace[-1][1],
            'trace': [list(point) for point in self.trace],
            'parameters': {
                value.name: {
                    'before': value.before,
                    'after': value.after,
                    'sigma': value.sigma if isfinite(value.sigma) else None,
                    'determined': None if self.determined is None else not value.loose,
                    'at_end_of_range': value.end or None,
                }
                for value in self.parameters
            },
            'scores_mm': {
                where: {'before': _plain(of.before), 'after': _plain(of.after)}
                for where, of in self.scores.items()
            },
        }

    def text(self) -> str:
        """Return the result as `identify` prints it."""
        lines = [f'{name}: {note}' for name, note in self._notes().items()]
        width = max(len(value.name) for value in self.parameters)
        lines += [f'  {value.name:{width}}  {value.words}' for value in self._told]
        if left := len(self.parameters) - len(self._told):
            lines.append(f'  and {left} more, in the parameter file')
        return '\n'.join(lines)

    def file(self) -> str:
        """Return the parameter file, with its provenance as comments."""
        values = {f'found {value.name}': value.words for value in self._told}
        title = 'Parameters found by cloth-predict identify'
        return with_provenance(self.config, title, self._notes() | values)

    @property
    def _told(self) -> tuple[Value, ...]:
        if len(self.parameters) <= MOST_LISTED:
            return self.parameters
        return tuple(value for value in self.parameters if value.loose or value.end)[:MOST_LISTED]

    def _notes(self) -> dict[str, str]:
        found = self.result
        notes = {
            'objective': self.task.meaning,
            'recordings': ', '.join(self.recordings),
            'search': f'{self.method.optimiser}, seed {self.method.seed}: {found.evaluations} '
            f'evaluations ({found.refused} refused), {found.stopped}; RMS error '
            f'{self.trace[0][1]:.4g} -> {self.trace[-1][1]:.4g} mm',
        }
        for where, of in self.scores.items():
            notes[f'score, {where}'] = f'{of.before:.4g} -> {of.after:.4g} mm ({of.gain})'
        if self.held_out:
            notes['held-out recordings'] = ', '.join(self.held_out)
        judged = self.scores.get(HELD_OUT)
        if judged is not None and not judged.after < judged.before:
            notes['caution'] = 'no better than before on what was held out'
        if self.loose:
            notes['not fixed by these recordings'] = _listed(self.loose)
        if self.determined is None:
            notes['study'] = self.method.resumable
        return notes


def _listed(names: tuple[str, ...]) -> str:
    more = f' and {len(names) - MOST_NAMED} more' if len(names) > MOST_NAMED else ''
    return ', '.join(names[:MOST_NAMED]) + more


def _plain(number: float) -> float | None:
    return number if isfinite(number) else None
