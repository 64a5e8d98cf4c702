"""Adds the force that a model does not know as states: an Ornstein-Uhlenbeck process per input."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import sparse

from cloth_predict.types import FloatArray, Solver, StiffDynamics


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
        self._gain = model.jac_force()
        self._forces = self._gain.shape[1]
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
        return np.concatenate([self.model.f(inner, u) + self._gain @ force, -force / self.tau])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, shape (dim_x, dim_x)."""
        return self._join(self.model.jac(x[: self.model.dim_x], u), 1.0)

    def factorise(self, x: FloatArray, u: FloatArray, dt: float) -> Solver:
        """Solver of the implicit step: forces first, then the model with the forces known."""
        size = self.model.dim_x
        inner = self.model.factorise(x[:size], u, dt)

        def solve(b: FloatArray) -> FloatArray:
            force = b[size:] / (1.0 + dt / self.tau)
            return np.concatenate([inner(b[:size] + dt * (self._gain @ force)), force])

        return solve

    def solve_jac_derivative(
        self, x: FloatArray, u: FloatArray, w: FloatArray
    ) -> sparse.csr_array:
        """Derivative of J~(x) w for a fixed w: the forces enter linearly and add nothing."""
        size = self.model.dim_x
        return self._join(self.model.solve_jac_derivative(x[:size], u, w[:size]), 0.0)

    def _join(self, inner: sparse.csr_array, scale: float) -> sparse.csr_array:
        """Return [[inner, scale G], [0, -scale / tau I]]."""
        if self._joined is None or self._joined.inner_size != inner.nnz:
            self._joined = _Joined(inner, self._gain, self.tau)
        return self._joined.matrix(inner, scale)


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

    def matrix(self, inner: sparse.csr_array, scale: float) -> sparse.csr_array:
        values = np.concatenate([inner.data, scale * self._outer])[self._take]
        return sparse.csr_array((values, self._indices, self._indptr), shape=self._shape)
