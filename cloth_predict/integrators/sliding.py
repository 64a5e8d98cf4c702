"""Steps of what slides on dry friction: Runge-Kutta, and a closed form where something stops."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil
from typing import Protocol, cast

import numpy as np

from cloth_predict.integrators.dense_tangent import DenseTangent
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.models.differences import central
from cloth_predict.types import BoolArray, Dynamics, FloatArray


class Arrestable(Dynamics, Protocol):
    """Motion that friction can stop."""

    def arrested(self, x: FloatArray, dt: float) -> tuple[FloatArray, BoolArray]:
        """State after dt [s] where friction stops a contact in that time, and where it does."""


@dataclass(frozen=True)
class Sliding:
    """Steps of at most `longest` [s]: RK4 while all contacts slide, else what the model says.

    Friction changes at once where a contact stops, which no Runge-Kutta step can know. The model
    says where that happens (`Arrestable`) and what comes of it, with an error of order longest^2.
    What is at rest stays there exactly. States may come many at once, of shape (..., dim_x). The
    derivative is that of the step by central differences.
    """

    longest: float
    order: int = 4

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (..., dim_x)."""
        parts = max(ceil(dt / self.longest - 1e-9), 1)  # rounding of a whole number of steps
        method = RungeKutta()
        for _ in range(parts):
            after, held = cast('Arrestable', model).arrested(x, dt / parts)
            if held.all():
                x = after
            else:
                slid = method.step(model, x, u, dt / parts)
                x = np.where(held[..., None], after, slid) if held.any() else slid
        return x

    def step_jac(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """State after dt [s] and its derivative."""
        jac = central(lambda varied: self.step(model, varied, u, dt), x)
        return self.step(model, x, u, dt), jac

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, DenseTangent]:
        """State after dt [s] and its derivative as a map."""
        after, jac = self.step_jac(model, x, u, dt)
        return after, DenseTangent(jac)
