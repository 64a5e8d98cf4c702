"""The linearised implicit midpoint step: second order, and no damping of its own."""

from __future__ import annotations

from dataclasses import dataclass

from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.types import Dynamics, FloatArray, Integrator, Tangent

HALF = ImplicitEuler()


@dataclass(frozen=True)
class ImplicitMidpoint(Integrator):
    """Twice as far as half an implicit step: x + 2 (x_mid - x), x_mid = x + dt/2 f(x_mid).

    A-stable, and energy changes by what the model dissipates alone: backward Euler makes an
    oscillation of frequency w die away by w^2 dt / 2 on top. (The one-stage Gauss method; Hairer &
    Wanner 1996, IV.5.) What is stiff is not damped out either, so that a coarse step is for
    motions that are smooth by then. First order where springs are under compression, whose
    stiffness the solve leaves out.
    """

    order: int = 2

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (dim_x,)."""
        return 2.0 * HALF.step(model, x, u, 0.5 * dt) - x

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, Tangent]:
        """State after dt [s] and its derivative as a map."""
        middle, tangent = HALF.step_tangent(model, x, u, 0.5 * dt)
        return 2.0 * middle - x, _Doubled(tangent)


@dataclass(frozen=True)
class _Doubled(Tangent):
    """F = 2 H - I of half a step with derivative H; see `types.Tangent`."""

    half: Tangent

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        return 2.0 * self.half.push(columns) - columns

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        return 2.0 * self.half.pull(rows) - rows

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs."""
        return 2.0 * self.half.drive(inputs)
