"""An exponential Runge-Kutta step: exact on linear models, of second order on others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import sparse

from cloth_predict.models.linear_part import LinearPart, Semilinear, Which
from cloth_predict.types import Dynamics, FloatArray, Integrator, Tangent


@dataclass(frozen=True)
class Exponential(Integrator):
    """ETD2RK of x' = A x + n(x, u) (Cox & Matthews 2002, eq. 20 and 22).

    With z = dt A: a = e^z x + dt phi1(z) n(x), and x becomes a + dt phi2(z) (n(a) - n(x)). Needs a
    model that offers A (`Semilinear`). Stiffness that is in A limits no step.
    """

    order: int = 2

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (dim_x,)."""
        return self._stages(model, x, u, dt)[1]

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, ExponentialTangent]:
        """State after dt [s] and its derivative as a map, by the chain rule."""
        first, after = self._stages(model, x, u, dt)
        return after, ExponentialTangent(cast('Semilinear', model), dt, (x, first), u)

    def _stages(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, FloatArray]:
        part = cast('Semilinear', model).linear_part
        rest = model.f(x, u) - part.matrix @ x
        first = part.apply('exp', dt, x) + part.apply('once', dt, rest)
        later = model.f(first, model.input_after(u, dt)) - part.matrix @ first
        return first, first + part.apply('twice', dt, (later - rest) / dt)


class ExponentialTangent(Tangent):
    """Derivative of the step between these stages; see `types.Tangent`."""

    def __init__(
        self,
        model: Semilinear,
        dt: float,
        stages: tuple[FloatArray, FloatArray],
        u: FloatArray,
    ) -> None:
        self.part: LinearPart = model.linear_part
        self.dt = dt
        self._model, self._stages, self._inputs = model, stages, (u, model.input_after(u, dt))
        self._slopes = [
            self._slope(stage, held) for stage, held in zip(stages, self._inputs, strict=True)
        ]
        self.linear = not any(slope.data.any() for slope in self._slopes)
        """Whether the derivative is e^(dt A) alone."""

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        first = self._of('exp', columns)
        return first if self.linear else self._pushed(first, self._slopes[0] @ columns)

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        weights = rows.T
        if self.linear:
            return self._of('exp', weights, back=True).T
        later = self._of('twice', weights, back=True) / self.dt
        first = weights + self._slopes[1].T @ later
        begin = self._slopes[0].T @ (self._of('once', first, back=True) - later)
        return np.asarray((self._of('exp', first, back=True) + begin).T)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs, which are linear in time."""
        held = [
            self._model.jac_input(stage, u)
            for stage, u in zip(self._stages, self._inputs, strict=True)
        ]
        later = np.array([self._model.input_after(column, self.dt) for column in inputs.T]).T
        still = np.zeros((len(self._stages[0]), inputs.shape[1]))
        return self._pushed(still, held[0] @ inputs, held[1] @ later)

    def _pushed(
        self, first: FloatArray, begin: FloatArray, added: FloatArray | float = 0.0
    ) -> FloatArray:
        """End of the step, from e^z of its start, n at its start, and what the input adds to n."""
        first = first + self._of('once', begin)
        end = self._slopes[1] @ first + added
        return np.asarray(first + self._of('twice', (end - begin) / self.dt))

    def _slope(self, stage: FloatArray, held: FloatArray) -> sparse.csr_array:
        """Derivative of n."""
        jac, matrix = self._model.jac(stage, held), self.part.matrix
        return sparse.csr_array(jac.shape) if jac is matrix else sparse.csr_array(jac - matrix)

    def _of(self, which: Which, columns: FloatArray, back: bool = False) -> FloatArray:
        return self.part.apply(which, self.dt, columns, back)
