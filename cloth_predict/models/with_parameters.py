"""Parameters of any model as states: constant but for their noise, and kept within bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cloth_predict.errors import ConfigError
from cloth_predict.models.differences import central
from cloth_predict.types import Dynamics, FloatArray, Gaussian, Integrator, Tangent

Make = Callable[..., Dynamics]
"""Gives a model for parameters by name."""


class WithParameters:
    """A model with some of its parameters as states (Goeller et al. 2015, 3.3).

    x = [x_model; parameters], or with the parameters at the entries `at`. They do not move by
    themselves: process noise makes random walks of them. The model only ever sees values within
    the bounds, onto which each state, and so each sigma point, is projected; `kept` does the same
    for a belief. States may come many at once, (..., dim_x), where the model takes that.

    A filter steps it by `Parametrised`.
    """

    def __init__(
        self,
        make: Make,
        names: Sequence[str],
        first: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        at: Sequence[int] | None = None,
    ) -> None:
        """Wrap the models that make(**parameters) gives.

        first, low, high, shape (n,): first values and bounds. Raises ConfigError that names a
        parameter whose first value is out of its bounds.
        """
        self.names, self._make = tuple(names), make
        self.first, self.low, self.high = (
            np.array(values, float) for values in (first, low, high)
        )
        bounded = zip(names, self.first, self.low, self.high, strict=True)
        for name, value, least, most in bounded:
            if not least <= value <= most:
                raise ConfigError(
                    f'{name}: {value:g} is not within its bounds {least:g} to {most:g}'
                )
        self.model = make(**dict(zip(names, self.first, strict=True)))
        """The model with the first values."""
        self.dim_x = self.model.dim_x + len(self.names)
        self.dim_u = self.model.dim_u
        self.at = np.arange(self.model.dim_x, self.dim_x) if at is None else np.array(at)
        """Entries of the parameters, shape (n,)."""
        self.own = np.setdiff1d(np.arange(self.dim_x), self.at)
        """Entries of the state of the model, shape (its dim_x,)."""

    def joint(self, own: FloatArray, parameters: FloatArray) -> FloatArray:
        """State, shape (..., dim_x), from that of the model and the parameters, (..., n)."""
        x = np.empty((*own.shape[:-1], self.dim_x))
        x[..., self.own], x[..., self.at] = own, parameters
        return x

    def model_at(self, x: FloatArray) -> Dynamics:
        """Return the model with the parameters of a state, (..., dim_x)."""
        values = np.clip(x[..., self.at], self.low, self.high)
        return self._make(**{name: values[..., i] for i, name in enumerate(self.names)})

    def kept(self, belief: Gaussian) -> Gaussian:
        """Belief whose mean is within the bounds.

        Parameters outside are set to their bounds, and what is correlated with them moves along
        (Simon & Chia 2002, eq. 15, with W = P^-1); the covariance stays, as a bound tells little.
        """
        excess = belief.mean[self.at] - np.clip(belief.mean[self.at], self.low, self.high)
        beyond = excess != 0.0
        if not beyond.any():
            return belief
        rows = belief.cov[self.at[beyond]]
        mean = belief.mean - excess[beyond] @ np.linalg.solve(rows[:, self.at[beyond]], rows)
        mean[self.at] = np.clip(mean[self.at], self.low, self.high)
        return Gaussian(mean, belief.cov)

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (..., dim_x): the parameters stay."""
        after = np.zeros_like(x)
        after[..., self.own] = self.model_at(x).f(x[..., self.own], u)
        return after

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x; that by the parameters by central differences."""
        own, full = x[self.own], np.zeros((self.dim_x, self.dim_x))
        full[np.ix_(self.own, self.own)] = self.model_at(x).jac(own, u).toarray()
        full[np.ix_(self.own, self.at)] = self.by_parameters(lambda model: model.f(own, u), x)
        return sparse.csr_array(full)

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (dim_x, dim_u)."""
        full = np.zeros((self.dim_x, self.dim_u))
        full[self.own] = self.model_at(x).jac_input(x[self.own], u).toarray()
        return sparse.csr_array(full)

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input dt [s] later."""
        return self.model.input_after(u, dt)

    def by_parameters(
        self, function: Callable[[Dynamics], FloatArray], x: FloatArray
    ) -> FloatArray:
        """Derivative of a function of the model, shape (m,), by the parameters at x, (m, n).

        By central differences, for which the bounds are no bar.
        """
        names = self.names
        return central(
            lambda values: function(self._make(**dict(zip(names, values, strict=True)))),
            np.clip(x[self.at], self.low, self.high),
        )


@dataclass(frozen=True)
class Parametrised(Integrator):
    """Steps a `WithParameters` by the steps of its model, which keeps its parameters meanwhile.

    So any model goes with its own integrator. The derivative by the state is that of the inner
    step, by the parameters it is that of the step by central differences.
    """

    inner: Integrator

    def step(self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float) -> FloatArray:
        """State after dt [s], shape (..., dim_x)."""
        joint, after = cast('WithParameters', model), x.copy()
        after[..., joint.own] = self.inner.step(joint.model_at(x), x[..., joint.own], u, dt)
        return after

    def step_tangent(
        self, model: Dynamics, x: FloatArray, u: FloatArray, dt: float
    ) -> tuple[FloatArray, JointTangent]:
        """State after dt [s] and its derivative as a map."""
        joint, own = cast('WithParameters', model), x[cast('WithParameters', model).own]
        after = x.copy()
        after[joint.own], tangent = self.inner.step_tangent(joint.model_at(x), own, u, dt)
        gain = joint.by_parameters(lambda varied: self.inner.step(varied, own, u, dt), x)
        return after, JointTangent(joint, tangent, gain)


@dataclass(frozen=True)
class JointTangent(Tangent):
    """Derivative of a step: that of the model's own, and gain, (dim_x of it, n), by parameters."""

    model: WithParameters
    inner: Tangent
    gain: FloatArray

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        after = columns.copy()
        after[self.model.own] = self.inner.push(columns[self.model.own])
        after[self.model.own] += self.gain @ columns[self.model.at]
        return after

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        own, before = rows[:, self.model.own], rows.copy()
        before[:, self.model.own] = self.inner.pull(own)
        before[:, self.model.at] += own @ self.gain
        return before

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs; the parameters have none."""
        after = np.zeros((self.model.dim_x, inputs.shape[1]))
        after[self.model.own] = self.inner.drive(inputs)
        return after
