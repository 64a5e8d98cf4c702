"""The choices of `filter.kind`; a new filter is one file and one entry here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cloth_predict.config import Config
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.integrators import INTEGRATORS
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import Filter

FILTERS: dict[str, Callable[[Config, MassSpring], Filter[Any]]] = {
    'ekf': lambda config, mesh: ExtendedKalmanFilter(INTEGRATORS[config.filter.integrator]),
}


def build_filter(config: Config, mesh: MassSpring) -> Filter[Any]:
    """Build the configured filter for this surface."""
    return FILTERS[config.filter.kind](config, mesh)
