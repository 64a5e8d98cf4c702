"""The choices of `filter.kind`; a new filter is one file and one entry here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cloth_predict.config import Config
from cloth_predict.filters.blocks import Blocks
from cloth_predict.filters.decoupled import Decoupled
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.fixed_gain import FixedGain
from cloth_predict.filters.gomes2016 import Gomes2016
from cloth_predict.filters.held import HeldCovariance
from cloth_predict.filters.least_squares import LeastSquares
from cloth_predict.filters.recursive_least_squares import RecursiveLeastSquares
from cloth_predict.filters.reduced_rank import Modes, ReducedRank
from cloth_predict.filters.sigma_points import SigmaPointFilter
from cloth_predict.integrators.exponential import Exponential
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import Filter, Integrator

EXPONENTIAL = Exponential()
FILTERS: dict[str, Callable[[Config, MassSpring], Filter[Any]]] = {
    'ekf': lambda config, mesh: _ekf(config),
    'ukf': lambda config, mesh: _ukf(config, INTEGRATORS[config.filter.integrator]),
    'ckf': lambda config, mesh: _ckf(INTEGRATORS[config.filter.integrator]),
    'least_squares': lambda config, mesh: LeastSquares(
        INTEGRATORS[config.filter.integrator], config.filter.window
    ),
    'recursive_least_squares': lambda config, mesh: RecursiveLeastSquares(
        INTEGRATORS[config.filter.integrator], config.filter.forgetting
    ),
    'gomes2016': lambda config, mesh: Gomes2016(),
    'fixed_gain': lambda config, mesh: FixedGain(
        INTEGRATORS[config.filter.integrator], len(mesh.free)
    ),
    'reduced_rank': lambda config, mesh: ReducedRank(
        INTEGRATORS[config.filter.integrator], Modes.smoothest(mesh, config.filter.rank)
    ),
}
"""Those of a surface of springs."""
BODY_FILTERS: dict[str, Callable[[Config, Blocks], Filter[Any]]] = {
    'decoupled': lambda config, blocks: Decoupled(EXPONENTIAL, blocks),
    'ekf': lambda config, blocks: ExtendedKalmanFilter(EXPONENTIAL),
    'ukf': lambda config, blocks: _ukf(config, EXPONENTIAL),
    'ckf': lambda config, blocks: _ckf(EXPONENTIAL),
}
"""Those of a closed body, whose linear motion is stepped exactly."""
KINDS = list(dict.fromkeys([*FILTERS, *BODY_FILTERS]))


def kinds_of(config: Config) -> list[str]:
    """The kinds of filters of a surface like the configured one."""
    return list(BODY_FILTERS if config.model.is_body else FILTERS)


def _ekf(config: Config) -> Filter[Any]:
    exact = ExtendedKalmanFilter(INTEGRATORS[config.filter.integrator])
    hold = config.filter.hold
    return exact if hold == 1 else HeldCovariance(exact, hold)


def _ukf(config: Config, integrator: Integrator) -> Filter[Any]:
    return SigmaPointFilter(integrator, config.filter.ukf_alpha, beta=2.0)


def _ckf(integrator: Integrator) -> Filter[Any]:
    return SigmaPointFilter(integrator, alpha=1.0, beta=0.0)


def build_filter(config: Config, mesh: MassSpring) -> Filter[Any]:
    """Build the configured filter for this surface."""
    return FILTERS[config.filter.kind](config, mesh)
