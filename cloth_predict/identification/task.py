"""What is identified: which parameters of a configuration, on which recordings, by which cost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cloth_predict.config import Config
from cloth_predict.evaluation.cases import Case
from cloth_predict.identification.objectives.horizon import Horizon
from cloth_predict.identification.objectives.parallel import Objective, Summed
from cloth_predict.identification.objectives.parameters import OF_MODEL, Space
from cloth_predict.identification.objectives.stretches import trajectories
from cloth_predict.identification.provenance import content_hash, kept

USUAL = {'trajectory': 'gradient', 'horizon': 'cma'}
"""Optimiser of each objective, where none is chosen."""
BETWEEN = 0.05
"""Seconds from one prediction to the next in the cost of the horizon objective."""
WINDOW = 4.0
"""Seconds that the model is left to itself in the trajectory objective. A start in fast motion is
known worse than one at rest, and its error takes a while to fade."""
ALPHA = 0.001
"""Weight of later times [1/s] (Gomes 2016, below eq. 6.21)."""


@dataclass(frozen=True)
class Task:
    """A configuration and how its parameters are identified.

    objective: `trajectory` (Gomes 2016, eq. 5.13) or `horizon`; names: parameters, the usual ones
    where there are none; per_spring: a value for each spring in place of one for each family;
    alpha [1/s] and window [s] of the trajectories; horizon [s] of predictions.
    """

    config: Config
    objective: str
    names: tuple[str, ...] = ()
    per_spring: bool = False
    alpha: float = ALPHA
    window: float = WINDOW
    horizon: float = 0.1

    @property
    def space(self) -> Space:
        """The parameters. Raises ConfigError for one that cannot be searched."""
        return Space.of(self.config, self.names or usual(self))

    def objective_on(self, cases: Sequence[Case], every: bool = True) -> Objective:
        """Return the objective on recordings; every: whether after each frame is predicted."""
        space = self.space
        if self.objective == 'trajectory':
            return Summed(
                tuple(trajectories(case, space, self.window, self.alpha) for case in cases)
            )
        return Summed(
            tuple(
                Horizon(space, case, self.horizon, 1 if every else _stride(case)) for case in cases
            )
        )

    def facts(self, cases: Iterable[Case]) -> dict[str, str]:
        """What the costs depend on, but for the values that are searched."""
        space = self.space
        searched = {f'{p.group}.{p.field}' for p in space.parameters}
        return {
            'objective': self.meaning,
            'searched': ', '.join(sorted(searched)),
            'start': ', '.join(f'{p.first:.6g}' for p in space.parameters),
            'recordings': ', '.join(content_hash(case.markers) for case in cases),
            **kept(self.config, searched),
        }

    @property
    def meaning(self) -> str:
        """The objective in words."""
        if self.objective == 'horizon':
            return f'error of the free markers {self.horizon:g} s ahead'
        return f'trajectories of {self.window:g} s, weight exp({self.alpha:g} t)'


def usual(task: Task) -> tuple[str, ...]:
    """Parameters that are searched where none are named; what is switched off stays off."""
    config, names = task.config, list(OF_MODEL)
    if task.per_spring:
        names = ['model.springs', 'model.dampers', *OF_MODEL[-2:]]
    if task.objective == 'horizon':
        names.append('filter.process_noise')
        if config.force.kind != 'none':
            names += ['force.sigma', 'force.tau']
        if config.wind.kind != 'none':
            names += ['wind.sigma', 'wind.tau', 'wind.drag', 'wind.common_sigma']
        if config.anchors.nodes and config.anchors.motion != 'fixed':
            names.append('anchors.process_noise')
        if config.anchors.nodes and config.anchors.motion == 'swing':
            names += ['anchors.decay', 'anchors.restoring']
    return tuple(name for name in names if _on(config, name))


def _on(config: Config, name: str) -> bool:
    group, field = name.split('.')
    value = getattr(getattr(config, group), field)
    return isinstance(value, tuple) or 0 < value < (1.0 if 'compression' in name else float('inf'))


def _stride(case: Case) -> int:
    """Frames from one prediction to the next."""
    stamps = case.markers.stamps
    interval = float(stamps[-1] - stamps[0]) / 1e9 / max(len(stamps) - 1, 1)
    return max(round(BETWEEN / interval), 1) if interval > 0 else 1
