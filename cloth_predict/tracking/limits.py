"""When a prediction is no longer worth having, and what to tell a user about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import LimitsConfig
from cloth_predict.errors import UncertainError
from cloth_predict.tracking.track import Step
from cloth_predict.types import IntArray, Surface


@dataclass(frozen=True)
class Health:
    """How well the surface is known: level `OK`, `WARN` or `ERROR`, and one line that says why."""

    level: str
    text: str


def spread(surface: Surface, free: IntArray) -> float:
    """Root mean square over the free nodes of the sigma of a coordinate [m]."""
    return float(np.sqrt(np.mean(np.square(surface.sigma[free]))))


def require_certain(sigma: float, limits: LimitsConfig) -> None:
    """Raise UncertainError where sigma [m] is above the limit."""
    if not sigma <= limits.sigma_error:  # nor for NaN
        raise UncertainError(
            f'no prediction: its sigma of {sigma:.3g} m is above limits.sigma_error of '
            f'{limits.sigma_error:g} m'
        )


def judge(sigma: float, step: Step, limits: LimitsConfig) -> Health:
    """Health of a surface whose prediction has this sigma [m], after this last step."""
    visible, nodes, rejected = int(step.visible.sum()), len(step.visible), step.markers['rejected']
    state = f'{visible} of {nodes} markers, sigma {1e3 * sigma:.3g} mm'
    if not sigma <= limits.sigma_error:
        return Health('ERROR', f'{state}, more than limits.sigma_error')
    if sigma > limits.sigma_warn:
        return Health('WARN', f'{state}, more than limits.sigma_warn')
    if visible < min(limits.min_visible, nodes):
        return Health('WARN', f'{state}, fewer markers than limits.min_visible')
    if rejected:
        return Health('WARN', f'{state}, {rejected} labelled markers are at no node')
    return Health('OK', state)
