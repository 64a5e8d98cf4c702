"""When a prediction is no longer worth having, and what to tell a user about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.config import LimitsConfig
from cloth_predict.errors import UncertainError
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
            f'{limits.sigma_error:g} m, too few markers were seen for too long'
        )


def judge(sigma: float, visible: int, nodes: int, limits: LimitsConfig) -> Health:
    """Health of a surface whose prediction has this sigma [m], with so many markers in view."""
    seen = f'{visible} of {nodes} markers'
    if not sigma <= limits.sigma_error:
        return Health('ERROR', f'sigma of {sigma:.3g} m is above limits.sigma_error, {seen}')
    if sigma > limits.sigma_warn:
        return Health('WARN', f'sigma of {sigma:.3g} m is above limits.sigma_warn, {seen}')
    if visible < min(limits.min_visible, nodes):
        return Health('WARN', f'{seen}, fewer than limits.min_visible, sigma {sigma:.3g} m')
    return Health('OK', f'{seen}, sigma {sigma:.3g} m')
