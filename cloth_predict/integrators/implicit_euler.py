"""The linearised implicit Euler step, with the exact Jacobian of the step that it takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from cloth_predict.types import Dynamics, FloatArray, Integrator, StiffDynamics, Tangent


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
