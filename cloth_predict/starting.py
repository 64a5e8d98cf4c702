"""The start: from the first frames to a model, its filter and a first belief."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cloth_predict.assembly import (
    build_mass_spring,
    complete,
    disturbed,
    first_belief,
    process_noise,
)
from cloth_predict.config import Config
from cloth_predict.driven import DrivenNodes
from cloth_predict.filters.family import build_filter
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import Belief, BoolArray, Filter, FloatArray

FEWEST_TO_START = 3
"""Visible nodes without which the first surface would be a guess."""


@dataclass(frozen=True)
class Start:
    """All that following a surface needs; noise, shape (dim_x,): spectral densities."""

    mesh: MassSpring
    model: MassSpring | Disturbed
    noise: FloatArray
    filter: Filter[Any]
    driven: DrivenNodes
    belief: Belief


class Starter:
    """Takes frames until there is enough to start from."""

    def __init__(self, config: Config) -> None:
        self._config = config

    def offer(
        self, stamp: int, positions: FloatArray, visible: BoolArray, points: FloatArray
    ) -> Start | None:
        """Start at rest at this frame, or None where it takes more.

        stamp [ns]; positions [m], shape (nodes, 3), and visible, shape (nodes,), of the labelled
        markers; points [m], shape (m, 3), of those without a label.
        """
        config, driven = self._config, list(self._config.anchors.nodes)
        if visible.sum() < min(FEWEST_TO_START, len(visible)) or not visible[driven].all():
            return None
        surface, spread = complete(config.model, positions, visible)
        mesh = build_mass_spring(config, surface)
        model, noise = disturbed(config, mesh), process_noise(config, mesh)
        nodes = DrivenNodes(config, mesh.driven, surface)
        chosen = build_filter(config, mesh)
        prior, held = first_belief(config, mesh, surface, spread), nodes.extrapolate(0.0)
        belief = chosen.start(prior, model, mesh.input(held[0], held[1]), noise)
        return Start(mesh, model, noise, chosen, nodes, belief)
