"""The command `tune` as one call, and what it tells of its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any

from cloth_predict import config as configuration
from cloth_predict.config import Config, flatten
from cloth_predict.evaluation.cases import Case
from cloth_predict.identification.provenance import (
    HELD_OUT,
    TRAINED,
    check_output,
    with_provenance,
    write_configuration,
)
from cloth_predict.identification.recordings import read_apart
from cloth_predict.identification.tuning.costs import horizon_error
from cloth_predict.identification.tuning.search import (
    TRIALS,
    Progress,
    Search,
    Task,
    prepared,
    proposals_for,
    search,
    with_scale,
)


@dataclass(frozen=True)
class Settings:
    """How to tune: see `Task`; trials, or None for the method's own number.

    storage, study: of Optuna; seed: of its sampler.
    """

    method: str
    horizon: float | None = None
    trials: int | None = None
    jobs: int = 1
    seed: int = 0
    storage: str | None = None
    study: str = 'tune'


@dataclass(frozen=True)
class Score:
    """Cost of a configuration, and its RMS error [mm] `horizon` ahead; NaN where it has none."""

    cost: float
    error_mm: float


@dataclass(frozen=True)
class Tuned:
    """A tuned configuration, and how it came about.

    scores: of the configuration `before` and `after`, on the `recordings` and on those `held out`;
    none of what was not judged, as after Ctrl-C.
    """

    task: Task
    config: Config
    search: Search
    settings: Settings
    recordings: tuple[str, ...]
    held_out: tuple[str, ...]
    scores: dict[str, dict[str, Score]] = field(default_factory=dict)

    @property
    def changes(self) -> dict[str, tuple[float, float]]:
        """Values before and after, of what was tuned or scaled with it."""
        before, after = (flatten(asdict(c)) for c in (self.task.config, self.config))
        names = [n for n in before if before[n] != after[n] or n in self.task.noise.ranges]
        return {name: (before[name], after[name]) for name in names}

    @property
    def cautions(self) -> list[str]:
        """Return what speaks against the result, each in one line."""
        found = [
            f'{name} is at the {end} end of what was searched: the best may lie beyond'
            for name, end in self.search.ends.items()
        ]
        for where, of in self.scores.items():
            before, after = of['before'], of['after']
            if where == HELD_OUT and not after.cost < before.cost:
                found.append('the result is no better than before on what was held out')
            if self.task.unit != 'mm' and not after.error_mm <= before.error_mm:
                found.append(
                    f'{where}: the error ahead has grown from {before.error_mm:.3g} to '
                    f'{after.error_mm:.3g} mm: what the model does not know is no white noise'
                )
        return found

    def summary(self) -> dict[str, Any]:
        """Return the numbers as `tune --json` prints them."""
        found = self.search
        return {
            'method': self.task.method,
            'horizon_s': self.task.horizon,
            'unit': self.task.unit,
            'seed': self.settings.seed,
            'recordings': list(self.recordings),
            'held_out': list(self.held_out),
            'trials': found.trials,
            'refused': found.refused,
            'interrupted': found.interrupted,
            'best': found.cost,
            'trace': [list(point) for point in found.trace],
            'parameters': {
                name: {'before': before, 'after': after}
                for name, (before, after) in self.changes.items()
            },
            'cautions': self.cautions,
            'scores': {
                where: {when: _plain(score) for when, score in of.items()}
                for where, of in self.scores.items()
            },
        }

    def text(self) -> str:
        """Return the result as `tune` prints it."""
        lines = [f'{name}: {note}' for name, note in self._notes().items() if name != 'caution']
        width = max(map(len, self.changes), default=0)
        lines += [
            f'  {name:{width}}  {before:.4g} -> {after:.4g}'
            for name, (before, after) in self.changes.items()
        ]
        return '\n'.join(lines)

    def file(self) -> str:
        """Return the parameter file, with its provenance as comments."""
        return with_provenance(self.config, 'Noise found by cloth-predict tune', self._notes())

    def _notes(self) -> dict[str, str]:
        found, unit = self.search, self.task.unit
        ended = ', interrupted' if found.interrupted else ''
        notes = {
            'method': f'{self.task.method}, {self._meaning}',
            'recordings': ', '.join(self.recordings),
            'search': f'{found.trials} trials ({found.refused} refused), seed '
            f'{self.settings.seed}{ended}; best {found.cost:.6g} {unit}',
        }
        for where, of in self.scores.items():
            notes[f'score, {where}'] = '; '.join(
                f'{when} {score.cost:.6g} {unit}' + self._aside(score)
                for when, score in of.items()
            )
        if self.held_out:
            notes['held-out recordings'] = ', '.join(self.held_out)
        if self.cautions:
            notes['caution'] = '; '.join(self.cautions)
        return notes

    @property
    def _meaning(self) -> str:
        if self.task.method == 'likelihood':
            return 'minus the log likelihood of a measured coordinate in m'
        return f'RMS error of the free markers {self.task.horizon:g} s ahead'

    def _aside(self, score: Score) -> str:
        return f' ({score.error_mm:.4g} mm)' if self.task.unit != 'mm' else ''


def _plain(score: Score) -> dict[str, float | None]:
    return {name: v if isfinite(v) else None for name, v in asdict(score).items()}


def tune(
    sources: Sequence[Path],
    config_path: Path,
    output: Path,
    held_out: Sequence[Path],
    settings: Settings,
    progress: Progress,
) -> Tuned:
    """Tune the noise of a configuration on recordings and write it, with its provenance.

    Ctrl-C writes the best so far. What is held out has no say in the search.
    """
    config = configuration.load(config_path)
    check_output(output)
    horizon = config.horizon if settings.horizon is None else settings.horizon
    trained, others = read_apart(sources, held_out, config)
    task = prepared(config, trained.cases, settings.method, horizon)
    proposals = proposals_for(task, settings.seed, settings.storage, settings.study)
    trials = settings.trials or (task.noise.grid_size if settings.method == 'grid' else TRIALS)
    found = search(task, proposals, trials, settings.jobs, progress)
    chosen = (
        task.noise.apply(found.values)
        if found.interrupted
        else with_scale(task, found.values, found.cost)
    )
    tuned = Tuned(task, chosen, found, settings, trained.lines, others.lines)
    write_configuration(output, tuned.file())  # before what takes longer, and may be cut off
    if found.interrupted:
        return tuned
    tuned = replace(tuned, scores=_scores(task, chosen, trained.cases, others.cases))
    write_configuration(output, tuned.file())
    return tuned


def _scores(
    task: Task, chosen: Config, cases: Sequence[Case], others: Sequence[Case]
) -> dict[str, dict[str, Score]]:
    found: dict[str, dict[str, Score]] = {}
    for where, of in ((TRAINED, cases), (HELD_OUT, others)):
        if of:
            given = prepared(task.config, of, task.method, task.horizon)
            found[where] = {
                when: _score(given, of, config)
                for when, config in (('before', task.config), ('after', chosen))
            }
    return found


def _score(task: Task, cases: Sequence[Case], config: Config) -> Score:
    """Score of a configuration on recordings; of the likelihood, with the task's measurements."""
    cost = task.cost(task.cases, config)
    error = cost if task.unit == 'mm' else horizon_error(cases, config, task.horizon)
    return Score(cost, error)
