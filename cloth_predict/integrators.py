"""Steps in time: explicit Runge-Kutta methods as data, and the linearised implicit Euler step.

Each gives the step and the exact Jacobian of the step that it takes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from cloth_predict.exponential import Exponential
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Integrator,
    StiffDynamics,
    Tangent,
)


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


@dataclass(frozen=True)
class ImplicitEuler(Integrator):
    """Linearised backward Euler: (I - dt J) dx = dt f(x) (Gomes 2016, eq. 3.32 in state form).

    Where the input moves in the step, dt df/du u' joins f, so that a surface carried along with
    its driven nodes keeps its shape exactly.

    Needs a model that offers the solve (`StiffDynamics`). Stable at steps where an explicit
    method is not; first order.
    """

    order: int = 1

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (dim_x,)."""
        at = cast('StiffDynamics', model).linearise(x, u)
        return x + at.change(dt, at.solver(dt))

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, Tangent]:
        """State after dt [s] and its derivative as a map: solves, without ever making F.

        Differentiating (I - dt J~(x)) dx = dt f(x) gives
        F = I + (I - dt J~)^-1 dt (J + d(J~ dx)/dx): the matrix depends on the state too, and its
        change along dx belongs to the derivative.
        """
        at = cast('StiffDynamics', model).linearise(x, u)
        solver = at.solver(dt)
        change = at.change(dt, solver)
        return x + change, at.tangent(dt, solver, change)


@dataclass(frozen=True)
class DenseTangent:
    """A derivative given as a matrix, and a way to that by the inputs if any; see `Tangent`."""

    step_jac: FloatArray
    input_jac: Callable[[], FloatArray] | None = None

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        return self.step_jac @ columns

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        return rows @ self.step_jac

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F'."""
        return self.step_jac @ cov @ self.step_jac.T

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs."""
        if self.input_jac is None:
            raise ValueError('the derivative by the inputs was not given')
        return self.input_jac() @ inputs


INTEGRATORS: dict[str, Integrator] = {
    'euler': RungeKutta(EULER),
    'rk4': RungeKutta(RK4),
    'implicit_euler': ImplicitEuler(),
    'exponential': Exponential(),
}
"""The choices of `filter.integrator`; a new method is one entry."""
