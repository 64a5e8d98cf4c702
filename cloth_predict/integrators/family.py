"""The kinds of integrators."""

from __future__ import annotations

from cloth_predict.integrators.exponential import Exponential
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.integrators.implicit_midpoint import ImplicitMidpoint
from cloth_predict.integrators.runge_kutta import EULER, RK4, RungeKutta
from cloth_predict.types import Integrator

INTEGRATORS: dict[str, Integrator] = {
    'euler': RungeKutta(EULER),
    'rk4': RungeKutta(RK4),
    'implicit_euler': ImplicitEuler(),
    'implicit_midpoint': ImplicitMidpoint(),
    'exponential': Exponential(),
}
"""The choices of `filter.integrator`; a new method is one entry."""
