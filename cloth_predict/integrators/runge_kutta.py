"""Explicit Runge-Kutta methods as data, with the exact Jacobian of the step that they take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.integrators.dense_tangent import DenseTangent
from cloth_predict.types import Dynamics, FloatArray


@dataclass(frozen=True)
class Tableau:
    """Butcher tableau of an explicit method: a, strictly lower triangular (s, s), and b, (s,)."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    order: int

    def __post_init__(self) -> None:
        if any(len(row) != i for i, row in enumerate(self.a)) or len(self.a) != len(self.b):
            raise ValueError('a must be strictly lower triangular with one row for each b')
        if abs(sum(self.b) - 1.0) > 1e-14:  # rounding of a sum of four fractions
            raise ValueError('the weights b must add up to one')


EULER = Tableau(a=((),), b=(1.0,), order=1)
RK4 = Tableau(  # Gomes 2016, eq. 3.27
    a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), b=(1 / 6, 1 / 3, 1 / 3, 1 / 6), order=4
)


@dataclass(frozen=True)
class RungeKutta:
    """Explicit Runge-Kutta step of a tableau."""

    tableau: Tableau = RK4

    @property
    def order(self) -> int:
        """Order of convergence."""
        return self.tableau.order

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (dim_x,)."""
        slopes: list[FloatArray] = []
        for row in self.tableau.a:
            stage_u = model.input_after(u, dt * sum(row))
            slopes.append(model.f(x + dt * _combine(row, slopes), stage_u))
        return np.asarray(x + dt * _combine(self.tableau.b, slopes))

    def step_jac(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """State after dt [s] and its derivative, by the chain rule through the stages."""
        after, tangent = self.step_tangent(model, x, u, dt)
        return after, tangent.step_jac

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, DenseTangent]:
        """State after dt [s] and its derivative as a map."""
        identity = np.eye(model.dim_x)
        stages: list[tuple[FloatArray, FloatArray]] = []
        slopes: list[FloatArray] = []
        slope_jacs: list[FloatArray] = []
        for row in self.tableau.a:
            stage = x + dt * _combine(row, slopes)
            stage_u = model.input_after(u, dt * sum(row))
            stages.append((stage, stage_u))
            slopes.append(model.f(stage, stage_u))
            stage_jac = identity + dt * _combine(row, slope_jacs)
            slope_jacs.append(np.asarray(model.jac(stage, stage_u) @ stage_jac))
        after = np.asarray(x + dt * _combine(self.tableau.b, slopes))
        step_jac = np.asarray(identity + dt * _combine(self.tableau.b, slope_jacs))
        return after, DenseTangent(step_jac, lambda: self._input_jac(model, u, dt, stages))

    def _input_jac(
        self,
        model: Dynamics,
        u: FloatArray,
        dt: float,
        stages: list[tuple[FloatArray, FloatArray]],
    ) -> FloatArray:
        """Derivative of the step by the input, by the chain rule through the stages."""
        rate = _input_rate(model, u)
        slope_jacs: list[FloatArray] = []
        for row, (stage, stage_u) in zip(self.tableau.a, stages, strict=True):
            later = np.eye(model.dim_u) + dt * sum(row) * rate
            own = model.jac_input(stage, stage_u) @ later
            if slope_jacs:
                own = own + model.jac(stage, stage_u) @ (dt * _combine(row, slope_jacs))
            slope_jacs.append(np.asarray(own))
        return np.asarray(dt * _combine(self.tableau.b, slope_jacs))


def _input_rate(model: Dynamics, u: FloatArray) -> FloatArray:
    """Rate of change of the input by the input itself, (dim_u, dim_u): it is linear in time."""
    columns = [model.input_after(unit, 1.0) - unit for unit in np.eye(model.dim_u)]
    return np.array(columns).reshape(model.dim_u, model.dim_u).T


def _combine(weights: tuple[float, ...], terms: list[FloatArray]) -> FloatArray | float:
    total: FloatArray | float = 0.0
    for weight, term in zip(weights, terms, strict=True):
        if weight:
            total = total + weight * term
    return total
