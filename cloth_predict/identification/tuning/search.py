"""Tunes Q, R, and sigma and tau of the unknown forces, on recordings (Gomes 2016, section 6.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

from cloth_predict.config import Config
from cloth_predict.errors import ClothPredictError
from cloth_predict.evaluation.cases import Case
from cloth_predict.identification.provenance import content_hash, kept
from cloth_predict.identification.tuning.costs import (
    horizon_error,
    normalised_error,
    total_fitness,
)
from cloth_predict.identification.tuning.likelihood import measurements
from cloth_predict.identification.tuning.noise import MEASUREMENT, Noise, scaled
from cloth_predict.identification.tuning.optuna_study import OptunaProposals
from cloth_predict.identification.tuning.proposals import Proposals, Sweep, Values
from cloth_predict.identification.workers import workers

METHODS = ('grid', 'likelihood', 'horizon')
TRIALS = 60
"""Of the two methods that could go on for ever."""
WORSE = 1.01
"""Factor of the error up to which a common scale of the noise is taken: where limits and gates cut
in, the scale does change predictions."""
Progress = Callable[[int, int, float], None]
"""Called after each trial with how many there were, how many there may be, and the best cost."""


def _silent(done: int, total: int, best: float) -> None:
    pass


@dataclass(frozen=True)
class Task:
    """What is tuned: a configuration on recordings, by a method; `horizon` [s].

    Costs are RMS errors [mm] of the free markers `horizon` ahead or, by likelihood, minus the log
    likelihood of a coordinate [nats]. cases: as `prepared` gives them.
    """

    config: Config
    cases: tuple[Case, ...]
    method: str
    horizon: float

    @property
    def noise(self) -> Noise:
        """What is searched. Errors ahead depend on ratios only, so that R stands for the scale."""
        return Noise.of(self.config, (MEASUREMENT,) if self.method == 'horizon' else ())

    @property
    def unit(self) -> str:
        """Unit of the cost."""
        return 'nats' if self.method == 'likelihood' else 'mm'

    def __call__(self, values: Values) -> float:
        """Cost of values of the noise; NaN where the filter fails with them."""
        return self.cost(self.cases, self.noise.apply(values))

    def cost(self, cases: Sequence[Case], config: Config) -> float:
        """Cost of a configuration on these recordings."""
        if self.method == 'likelihood':
            return total_fitness(cases, config).cost
        return horizon_error(cases, config, self.horizon)

    @property
    def facts(self) -> dict[str, str]:
        """What a study's results depend on, but for the values that are searched."""
        horizon = '' if self.method == 'likelihood' else f' {self.horizon:g} s ahead'
        recordings = sorted(content_hash(case.markers) for case in self.cases)
        return {
            'objective': f'{self.method}{horizon}',
            'recordings': ', '.join(recordings),
            'searched': ', '.join(self.noise.ranges),
            **kept(self.config, self.noise.ranges),
        }


def prepared(config: Config, cases: Sequence[Case], method: str, horizon: float) -> Task:
    """Return what is tuned; for the likelihood, with the same measurements for all values."""
    if method == 'likelihood':
        cases = [replace(case, markers=measurements(case, config)) for case in cases]
    return Task(config, tuple(cases), method, horizon)


@dataclass(frozen=True)
class Search:
    """What a search found: values of the noise and their cost, and how it went.

    trace: best cost after each trial that made it better, with the number of trials; trials:
    how many there were; refused: those without a valid cost; ends: parameters whose value is at
    an end of the range that was searched, `low` or `high`.
    """

    values: Values
    cost: float
    trace: tuple[tuple[int, float], ...]
    trials: int
    refused: int
    interrupted: bool
    ends: dict[str, str]


def search(
    task: Task, proposals: Proposals, trials: int, jobs: int = 1, progress: Progress = _silent
) -> Search:
    """Try what is proposed; Ctrl-C keeps the best so far.

    Raises ClothPredictError where nothing valid was found, and KeyboardInterrupt where it was cut
    off before that.
    """
    done, refused, best, trace, interrupted = 0, 0, inf, [], False
    with workers(task, jobs) as evaluate:
        while not interrupted and (asked := proposals.ask(min(jobs, trials - done))):
            costs: list[float] = []
            try:
                for cost in evaluate(asked):
                    costs.append(cost)
                    done, refused = done + 1, refused + (not isfinite(cost))
                    if cost < best:
                        best = cost
                        trace.append((done, cost))
                    progress(done, trials, best)
            except KeyboardInterrupt:
                interrupted = True
            finally:
                proposals.tell(costs)
    found = proposals.best
    if found is None:
        if interrupted:
            raise KeyboardInterrupt
        raise ClothPredictError(
            f'none of {done} trials gave a valid score: the filter fails, or predicts too little, '
            f'with every noise that was tried; see `cloth-predict evaluate`'
        )
    ends = {name: around.at_end(found.values[name]) for name, around in task.noise.ranges.items()}
    ends = {name: end for name, end in ends.items() if end}
    return Search(found.values, found.cost, tuple(trace), done, refused, interrupted, ends)


def proposals_for(
    task: Task, seed: int = 0, storage: str | None = None, study: str = 'tune'
) -> Proposals:
    """Return what proposes noise for a method: a sweep over decades, or Optuna."""
    if task.method == 'grid':
        return Sweep(task.noise.ranges)
    return OptunaProposals(task.noise.ranges, task.facts, seed, storage, study)


def with_scale(task: Task, values: Values, cost: float) -> Config:
    """Return the tuned configuration; where only ratios were searched, with their common scale.

    It is that at which errors ahead are as large as predicted. It is left alone where predictions
    get worse by it, as where limits and gates cut in.
    """
    config = task.noise.apply(values)
    if task.method != 'horizon':
        return config
    variance = normalised_error(task.cases, config, task.horizon)
    if not 0 < variance < inf:
        return config
    found = scaled(config, variance)
    return found if task.cost(task.cases, found) <= WORSE * cost else config
