"""Adds the forces that a model does not know as states: a Gauss-Markov process per input."""

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


@dataclass(frozen=True)
class ForceProcess:
    """How one unknown force [N] changes: y' = drift y + noise on the last entry, y[0] the force.

    drift, shape (order, order); density, of the noise; variance, shape (order,), at rest.
    """

    drift: FloatArray
    density: float
    variance: FloatArray

    @classmethod
    def ornstein_uhlenbeck(cls, sigma: float, tau: float) -> ForceProcess:
        """F' = -F / tau + noise: standard deviation sigma [N], forgotten over tau [s]; rough."""
        return cls(np.array([[-1 / tau]]), 2 * sigma**2 / tau, np.array([sigma**2]))

    @classmethod
    def matern(cls, sigma: float, tau: float) -> ForceProcess:
        """F'' = -F / tau^2 - 2 F' / tau + noise: smooth, with a rate that carries it on.

        The Matern process of smoothness 3/2, its scale tau [s] (Rasmussen & Williams 2006,
        appendix B.2).
        """
        drift = np.array([[0.0, 1.0], [-1 / tau**2, -2 / tau]])
        return cls(drift, 4 * sigma**2 / tau**3, np.array([sigma**2, (sigma / tau) ** 2]))


class Disturbed:
    """Any model with its unknown forces as states: x = [x_model; forces; their rates, if any]."""

    def __init__(self, model: Forced, process: ForceProcess | float) -> None:
        """Wrap a model; a number stands for an Ornstein-Uhlenbeck process with that tau [s]."""
        if isinstance(process, (int, float)):
            if process <= 0:
                raise ValueError('tau must be positive')
            process = ForceProcess.ornstein_uhlenbeck(1.0, process)
        self.model, self.process = model, process
        self.gain = model.jac_force()
        self.forces = int(self.gain.shape[1])
        self._joined: _Joined | None = None

    @property
    def dim_x(self) -> int:
        """States of the model, and of the force process for each force."""
        return self.model.dim_x + len(self.process.drift) * self.forces

    @property
    def dim_u(self) -> int:
        """Inputs of the model."""
        return self.model.dim_u

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        inner, process = np.split(x, [self.model.dim_x])
        pushed = self.model.f(inner, u) + self.gain @ process[: self.forces]
        return np.concatenate([pushed, self.drift(process)])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, shape (dim_x, dim_x)."""
        return self.join(self.model.jac(x[: self.model.dim_x], u))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the model dt [s] later."""
        return self.model.input_after(u, dt)

    def linearise(self, x: FloatArray, u: FloatArray) -> _Linearised:
        """Return the model and its forces at (x, u)."""
        inner, process = np.split(x, [self.model.dim_x])
        return _Linearised(self, self.model.linearise(inner, u), process)

    def drift(self, process: FloatArray) -> FloatArray:
        """Time derivative of the forces and their rates, shape (order * forces,)."""
        return np.asarray(self.process.drift @ process.reshape(-1, self.forces)).ravel()

    def join(self, inner: sparse.csr_array) -> sparse.csr_array:
        """Return [[inner, G, 0], [0, drift]]."""
        if self._joined is None or self._joined.inner_size != inner.nnz:
            order = len(self.process.drift)
            rates = sparse.csr_array((self.gain.shape[0], (order - 1) * self.forces))
            gain = sparse.csr_array(sparse.hstack([self.gain, rates]))
            drift = sparse.kron(self.process.drift, sparse.eye(self.forces))
            self._joined = _Joined(inner, gain, sparse.csr_array(drift))
        return self._joined.matrix(inner)


@dataclass(frozen=True)
class _Linearised:
    """A disturbed model at one state; see `types.Linearised`."""

    model: Disturbed
    inner: Linearised
    process: FloatArray

    def increment(self, dt: float) -> FloatArray:
        """Increment of the model under the forces, and of the forces."""
        force = self.process[: self.model.forces]
        pushed = self.inner.increment(dt) + dt * (self.model.gain @ force)
        return np.concatenate([pushed, dt * self.model.drift(self.process)])

    def solver(self, dt: float) -> _StepSolver:
        """Solver of the implicit step."""
        drift = self.model.process.drift
        decay: FloatArray = np.linalg.inv(np.eye(len(drift)) - dt * drift).astype(float)
        return _StepSolver(self.inner.solver(dt), dt * self.model.gain, decay)

    def step_slope(self, w: FloatArray, dt: float) -> sparse.csr_array:
        """The forces enter linearly: only the model's part depends on w."""
        return self.model.join(self.inner.step_slope(w[: self.model.model.dim_x], dt))


@dataclass(frozen=True)
class _StepSolver:
    """Solves with N = [[N_model, -dt G, 0], [0, I - dt drift]].

    gain = dt G; decay = (I - dt drift)^-1 of one force, shape (order, order).
    """

    inner: StepSolver
    gain: sparse.csr_array
    decay: FloatArray

    def __call__(self, b: FloatArray) -> FloatArray:
        size, forces = self.gain.shape
        process = self._each(self.decay, b[size:])
        return np.concatenate([self.inner(b[:size] + self.gain @ process[:forces]), process])

    def transposed(self, b: FloatArray) -> FloatArray:
        """Return y of N' y = b, shape (dim_x, m)."""
        size, forces = self.gain.shape
        state = self.inner.transposed(b[:size])
        process = b[size:].copy()
        process[:forces] += self.gain.T @ state
        return np.concatenate([state, self._each(self.decay.T, process)])

    @staticmethod
    def _each(matrix: FloatArray, process: FloatArray) -> FloatArray:
        """Apply a matrix of shape (order, order) to each force and its rates."""
        return np.asarray(matrix @ process.reshape(len(matrix), -1)).reshape(process.shape)


class _Joined:
    """The structure of the joined Jacobian, learnt once by numbering the entries of its parts."""

    def __init__(
        self, inner: sparse.csr_array, gain: sparse.csr_array, drift: sparse.csr_array
    ) -> None:
        self.inner_size = inner.nnz
        self._outer = np.concatenate([gain.data, drift.data])
        parts = []
        count = 1
        for part in (inner, gain, drift):
            numbered = np.arange(count, count + part.nnz)
            parts.append(sparse.csr_array((numbered, part.indices, part.indptr), part.shape))
            count += part.nnz
        joined = sparse.csr_array(sparse.bmat([[parts[0], parts[1]], [None, parts[2]]]))
        self._take = joined.data - 1
        self._indices, self._indptr, self._shape = joined.indices, joined.indptr, joined.shape

    def matrix(self, inner: sparse.csr_array) -> sparse.csr_array:
        values = np.concatenate([inner.data, self._outer])[self._take]
        return sparse.csr_array((values, self._indices, self._indptr), shape=self._shape)
