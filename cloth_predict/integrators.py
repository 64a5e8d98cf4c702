"""Steps in time: explicit Runge-Kutta methods as data, and the linearised implicit Euler step.

Each gives the step and the exact Jacobian of the step that it takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from cloth_predict.types import Dynamics, FloatArray, Integrator, Pull, StiffDynamics


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
        identity = np.eye(model.dim_x)
        slopes: list[FloatArray] = []
        slope_jacs: list[FloatArray] = []
        for row in self.tableau.a:
            stage = x + dt * _combine(row, slopes)
            stage_u = model.input_after(u, dt * sum(row))
            slopes.append(model.f(stage, stage_u))
            stage_jac = identity + dt * _combine(row, slope_jacs)
            slope_jacs.append(np.asarray(model.jac(stage, stage_u) @ stage_jac))
        return (
            np.asarray(x + dt * _combine(self.tableau.b, slopes)),
            np.asarray(identity + dt * _combine(self.tableau.b, slope_jacs)),
        )

    def step_pull(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, Pull]:
        """State after dt [s] and the map of rows W to W F."""
        after, step_jac = self.step_jac(model, x, u, dt)
        return after, lambda rows: rows @ step_jac


def _combine(weights: tuple[float, ...], terms: list[FloatArray]) -> FloatArray | float:
    total: FloatArray | float = 0.0
    for weight, term in zip(weights, terms, strict=True):
        if weight:
            total = total + weight * term
    return total


@dataclass(frozen=True)
class ImplicitEuler:
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
        return x + at.solver(dt)(at.increment(dt))

    def step_jac(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        """State after dt [s] and its derivative.

        Differentiating (I - dt J~(x)) dx = dt f(x) gives
        F = I + (I - dt J~)^-1 dt (J + d(J~ dx)/dx): the matrix depends on the state too, and its
        change along dx belongs to the Jacobian.
        """
        at = cast('StiffDynamics', model).linearise(x, u)
        solve = at.solver(dt)
        change = solve(at.increment(dt))
        step_jac = solve(dt * at.step_slope(change, dt).toarray())
        step_jac.flat[:: model.dim_x + 1] += 1.0
        return x + change, step_jac

    def step_pull(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, Pull]:
        """State after dt [s] and the map of rows W to W F: a solve, without ever making F."""
        at = cast('StiffDynamics', model).linearise(x, u)
        solve = at.solver(dt)
        change = solve(at.increment(dt))
        slope = dt * at.step_slope(change, dt).T
        return x + change, lambda rows: rows + (slope @ solve.transposed(rows.T)).T


INTEGRATORS: dict[str, Integrator] = {
    'euler': RungeKutta(EULER),
    'rk4': RungeKutta(RK4),
    'implicit_euler': ImplicitEuler(),
}
"""The choices of `filter.integrator`; a new method is one entry."""
