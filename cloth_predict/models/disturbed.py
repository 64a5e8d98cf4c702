"""Adds the force that a model does not know as states: an Ornstein-Uhlenbeck process per input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse

from cloth_predict.types import FloatArray, Linearised, StepSolver, StiffDynamics


class Forced(StiffDynamics, Protocol):
    """Motion on which forces act linearly."""

    def jac_force(self) -> sparse.csr_array:
        """Derivative of f with respect to the forces, shape (dim_x, forces); constant."""


class Disturbed:
    """Any model with its unknown forces [N] as states: x = [x_model; F], F' = -F / tau + noise.

    With noise of spectral density 2 sigma^2 / tau each force has standard deviation sigma [N] and
    is forgotten over tau [s].
    """

    def __init__(self, model: Forced, tau: float) -> None:
        """Wrap a model; tau [s] must be positive."""
        if tau <= 0:
            raise ValueError('tau must be positive')
        self.model = model
        self.tau = tau
        self.gain = model.jac_force()
        self._forces = int(self.gain.shape[1])
        self._joined: _Joined | None = None

    @property
    def dim_x(self) -> int:
        """States of the model and its forces."""
        return self.model.dim_x + self._forces

    @property
    def dim_u(self) -> int:
        """Inputs of the model."""
        return self.model.dim_u

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        inner, force = np.split(x, [self.model.dim_x])
        return np.concatenate([self.model.f(inner, u) + self.gain @ force, -force / self.tau])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, shape (dim_x, dim_x)."""
        return self.join(self.model.jac(x[: self.model.dim_x], u))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the model dt [s] later."""
        return self.model.input_after(u, dt)

    def linearise(self, x: FloatArray, u: FloatArray) -> _Linearised:
        """Return the model and its forces at (x, u)."""
        inner, force = np.split(x, [self.model.dim_x])
        return _Linearised(self, self.model.linearise(inner, u), force)

    def join(self, inner: sparse.csr_array) -> sparse.csr_array:
        """Return [[inner, G], [0, -I / tau]]."""
        if self._joined is None or self._joined.inner_size != inner.nnz:
            self._joined = _Joined(inner, self.gain, self.tau)
        return self._joined.matrix(inner)


@dataclass(frozen=True)
class _Linearised:
    """A disturbed model at one state; see `types.Linearised`."""

    model: Disturbed
    inner: Linearised
    force: FloatArray

    def increment(self, dt: float) -> FloatArray:
        """Increment of the model under the forces, and of the forces."""
        pushed = self.inner.increment(dt) + dt * (self.model.gain @ self.force)
        return np.concatenate([pushed, -dt * self.force / self.model.tau])

    def solver(self, dt: float) -> _StepSolver:
        """Solver of the implicit step."""
        decay = 1.0 + dt / self.model.tau
        return _StepSolver(self.inner.solver(dt), dt * self.model.gain, decay)

    def step_slope(self, w: FloatArray, dt: float) -> sparse.csr_array:
        """The forces enter linearly: only the model's part depends on w."""
        return self.model.join(self.inner.step_slope(w[: self.model.model.dim_x], dt))


@dataclass(frozen=True)
class _StepSolver:
    """Solves with N = [[N_model, -dt G], [0, decay I]]; gain = dt G."""

    inner: StepSolver
    gain: sparse.csr_array
    decay: float

    def __call__(self, b: FloatArray) -> FloatArray:
        size = self.gain.shape[0]
        force = b[size:] / self.decay
        return np.concatenate([self.inner(b[:size] + self.gain @ force), force])

    def transposed(self, b: FloatArray) -> FloatArray:
        """Return y of N' y = b, shape (dim_x, m)."""
        size = self.gain.shape[0]
        state = self.inner.transposed(b[:size])
        return np.concatenate([state, (b[size:] + self.gain.T @ state) / self.decay])


class _Joined:
    """The structure of the joined Jacobian, learnt once by numbering the entries of its parts."""

    def __init__(self, inner: sparse.csr_array, gain: sparse.csr_array, tau: float) -> None:
        self.inner_size = inner.nnz
        forces = gain.shape[1]
        self._outer = np.concatenate([gain.data, np.full(forces, -1.0 / tau)])
        parts = []
        count = 1
        for part in (inner, gain, sparse.csr_array(sparse.eye_array(forces))):
            numbered = np.arange(count, count + part.nnz)
            parts.append(sparse.csr_array((numbered, part.indices, part.indptr), part.shape))
            count += part.nnz
        joined = sparse.csr_array(sparse.block_array([[parts[0], parts[1]], [None, parts[2]]]))
        self._take = joined.data - 1
        self._indices, self._indptr, self._shape = joined.indices, joined.indptr, joined.shape

    def matrix(self, inner: sparse.csr_array) -> sparse.csr_array:
        values = np.concatenate([inner.data, self._outer])[self._take]
        return sparse.csr_array((values, self._indices, self._indptr), shape=self._shape)
