"""What is compressed to what: grids, the nodes they share, and the motions (Gomes 2016, 5.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cloth_predict.config import AnchorsConfig, Config, FilterConfig, ModelConfig
from cloth_predict.errors import ConfigError
from cloth_predict.identification.compression.falling import (
    DURATION,
    RELEASES,
    STEP,
    motion,
    sheet,
)
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.objectives.trajectory import Trajectory
from cloth_predict.identification.provenance import kept
from cloth_predict.surface.assembly import topology_of
from cloth_predict.types import IntArray

THESIS = Config(
    model=ModelConfig(
        width=1.5,
        height=1.5,
        mass=441 * 0.025,
        stiffness_structural=300.0,
        stiffness_shear=300.0,
        stiffness_flexion=300.0,
        damping=0.08,
    ),
    # a prediction takes the steps with which the parameters were found
    filter=FilterConfig(predict_step=STEP),
)
"""The sheet of the thesis (Gomes 2016, section 3.3), in place of a configuration of one's own."""
FARTHEST = 100.0
"""Factor to both sides of the first value beyond which none is searched."""

Grid = tuple[int, int]
"""Rows and columns."""


@dataclass(frozen=True)
class Task:
    """What is compressed to what, on which motions; the names are those of `RELEASES`.

    surface: what of the sheet does not depend on its mesh, and the settings of the filter; alpha
    [1/s], growth of the weight (5.13); loads: whether each node has a factor of gravity (5.15).
    """

    source: Grid = (21, 21)
    target: Grid = (5, 5)
    trained: tuple[str, ...] = ('falling', 'raised')
    held_out: tuple[str, ...] = ('lowered', 'pushed')
    surface: Config = THESIS
    duration: float = DURATION
    alpha: float = 0.001
    loads: bool = True

    def __post_init__(self) -> None:
        """Raise ConfigError for what cannot be compressed."""
        _check_grids(self.source, self.target)
        _check_surface(self.surface)
        if not self.trained:
            raise ConfigError('scenarios: at least one is needed to train on')
        for name in self.names:
            if name not in RELEASES:
                raise ConfigError(f'scenarios: {name} is none of {", ".join(RELEASES)}')
            if name in self.trained and name in self.held_out:
                raise ConfigError(f'scenarios: {name} is held out, and trained on')

    @property
    def names(self) -> tuple[str, ...]:
        """All motions, those that are trained on first."""
        return tuple(dict.fromkeys(self.trained + self.held_out))

    @property
    def chosen(self) -> IntArray:
        """Nodes of the source that the target has as well, shape (target nodes,): A of (5.4)."""
        (rows, cols), (fewer_rows, fewer_cols) = self.source, self.target
        every = (rows - 1) // (fewer_rows - 1), (cols - 1) // (fewer_cols - 1)
        node = np.arange(rows * cols).reshape(rows, cols)
        return node[:: every[0], :: every[1]].ravel()

    @property
    def dense(self) -> Config:
        """The sheet with the nodes of the source."""
        return self._with(*self.source)

    @property
    def equal(self) -> Config:
        """The sheet with those of the target, all springs, dampers and masses equal."""
        return self._with(*self.target)

    @property
    def notes(self) -> dict[str, str]:
        """What is searched, in words."""
        (rows, cols), (fewer_rows, fewer_cols) = self.source, self.target
        scale = 'with' if self.loads else 'without'
        return {
            'sheet': f'{rows} x {cols} -> {fewer_rows} x {fewer_cols} nodes, {scale} a factor of '
            f'gravity for each node',
            'trained on': f'{", ".join(self.trained)}, {self.duration:g} s each, weight '
            f'exp({self.alpha:g} t)',
        }

    @property
    def facts(self) -> dict[str, str]:
        """What the costs depend on, but for the values that are searched."""
        return self.notes | kept(self.dense, ())

    def _with(self, rows: int, cols: int) -> Config:
        model = replace(self.surface.model, rows=rows, cols=cols)
        anchors = AnchorsConfig(nodes=tuple(range(cols)))
        return replace(self.surface, model=model, anchors=anchors, labels=())

    def objective(self, names: tuple[str, ...], alpha: float) -> Trajectory:
        """Cost (5.16) of a coarse sheet on some motions."""
        driven = np.array(self.equal.anchors.nodes)
        scenarios = [
            motion(self.dense, name, self.duration).at_nodes(self.chosen, driven) for name in names
        ]
        joined = topology_of(self.equal.model, np.zeros((0, 3)))
        return Trajectory(self.space(), tuple(scenarios), sheet, joined, alpha)

    def space(self) -> Space:
        """All springs, dampers, masses and, if wanted, loads that act on a free node (5.6)."""
        names = ['model.springs', 'model.dampers', 'model.masses']
        whole = Space.of(self.equal, names + ['model.loads'] * self.loads, FARTHEST)
        held = np.array(self.equal.anchors.nodes)
        pairs = topology_of(self.equal.model, np.zeros((0, 3))).pairs
        idle = {'springs': np.flatnonzero(np.isin(pairs, held).all(axis=1)), 'masses': held}
        idle |= {'dampers': idle['springs'], 'loads': held}
        acting = [p for p in whole.parameters if p.entry not in idle[p.field]]
        return replace(whole, parameters=tuple(acting))


def _check_grids(source: Grid, target: Grid) -> None:
    names = ['{} x {}'.format(*grid) for grid in (source, target)]
    if min(*source, *target) < 2:
        raise ConfigError(f'{names[0]} to {names[1]}: a sheet has at least 2 rows and columns')
    if target[0] > source[0] or target[1] > source[1]:
        raise ConfigError(f'{names[1]} has more nodes than {names[0]}, of which it is to be made')
    for whole, part, what in zip(source, target, ('rows', 'columns'), strict=True):
        if (whole - 1) % (part - 1):
            raise ConfigError(
                f'{names[1]} is no sub-grid of {names[0]}: {whole - 1} steps between {whole} '
                f'{what} cannot be shared out to {part - 1}'
            )


def _check_surface(surface: Config) -> None:
    model = surface.model
    for name, value in (('topology', 'grid'), ('rest_length', 'dimensions'), ('refine', 1)):
        if getattr(model, name) != value:
            raise ConfigError(f'model.{name}: a sheet is compressed with {value} only')
    for name in ('springs', 'dampers', 'masses', 'loads'):
        if getattr(model, name):
            raise ConfigError(f'model.{name}: belongs to another mesh than that of the source')
    if surface.wind.kind != 'none':
        raise ConfigError('wind.kind: a sheet is compressed with none only')
