"""Adds the forces that a model does not know as states: a Gauss-Markov process per input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse

from cloth_predict.types import (
    FloatArray,
    Linearised,
    Solver,
    StiffDynamics,
    Tangent,
)


class ForcedTangent(Tangent, Protocol):
    """Derivative of a step on which forces [N], held over the step, act as well."""

    def push(self, columns: FloatArray, force: FloatArray | float = 0.0) -> FloatArray:
        """Return F C, for changes of the forces, shape (forces, m), as well."""

    def pull_force(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return W F and the derivative of W x by the forces, shape (m, forces)."""


class ForcedLinearised(Linearised, Protocol):
    """A model at one state under forces [N], shape (forces,), besides its input."""

    def change(self, dt: float, solver: Solver, force: FloatArray | float = 0.0) -> FloatArray:
        """Change of the state in a step of dt [s], shape (dim_x,)."""

    def tangent(self, dt: float, solver: Solver, change: FloatArray) -> ForcedTangent:
        """Derivative of the step that makes this change."""


class Forced(StiffDynamics, Protocol):
    """Motion on which forces act linearly."""

    def jac_force(self) -> sparse.csr_array:
        """Derivative of f with respect to the forces, shape (dim_x, forces); constant."""

    def linearise(self, x: FloatArray, u: FloatArray) -> ForcedLinearised:
        """Return the model at (x, u)."""


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
        order = len(self.process.drift)
        rates = sparse.csr_array((self.gain.shape[0], (order - 1) * self.forces))
        gain = sparse.hstack([self.gain, rates])
        drift = sparse.kron(self.process.drift, sparse.eye(self.forces))
        inner = self.model.jac(x[: self.model.dim_x], u)
        return sparse.csr_array(sparse.bmat([[inner, gain], [None, drift]]))

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (dim_x, dim_u): that of the model."""
        inner = self.model.jac_input(x[: self.model.dim_x], u)
        still = sparse.csr_array((len(self.process.drift) * self.forces, self.dim_u))
        return sparse.csr_array(sparse.vstack([inner, still]))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the model dt [s] later."""
        return self.model.input_after(u, dt)

    def linearise(self, x: FloatArray, u: FloatArray) -> _Linearised:
        """Return the model and its forces at (x, u)."""
        inner, process = np.split(x, [self.model.dim_x])
        return _Linearised(self, self.model.linearise(inner, u), process)

    def drift(self, process: FloatArray) -> FloatArray:
        """Time derivative of the forces and their rates, shape (order * forces,)."""
        return each(self.process.drift, process)

    def decay(self, dt: float) -> FloatArray:
        """Implicit step (I - dt drift)^-1 of one force and its rates, shape (order, order)."""
        drift = self.process.drift
        return np.asarray(np.linalg.inv(np.eye(len(drift)) - dt * drift))


@dataclass(frozen=True)
class _Linearised:
    """A disturbed model at one state: a force decays within a step and then acts on the model.

    That is the implicit step of both together, as no force depends on the model. See
    `types.Linearised`.
    """

    model: Disturbed
    inner: ForcedLinearised
    process: FloatArray

    def solver(self, dt: float) -> Solver:
        """Solver of the model's own step."""
        return self.inner.solver(dt)

    def change(self, dt: float, solver: Solver) -> FloatArray:
        """Change of the model under the forces, and of the forces."""
        after = each(self.model.decay(dt), self.process)
        moved = self.inner.change(dt, solver, after[: self.model.forces])
        return np.concatenate([moved, after - self.process])

    def tangent(self, dt: float, solver: Solver, change: FloatArray) -> _Tangent:
        """Derivative of the step."""
        model = self.model
        inner = self.inner.tangent(dt, solver, change[: model.model.dim_x])
        return _Tangent(inner, model.decay(dt), model.model.dim_x, model.forces)


@dataclass(frozen=True)
class _Tangent:
    """Derivative of the step of a disturbed model; see `types.Tangent`."""

    inner: ForcedTangent
    decay: FloatArray
    size: int
    forces: int

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        process = each(self.decay, columns[self.size :])
        inner = self.inner.push(columns[: self.size], process[: self.forces])
        return np.concatenate([inner, process])

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        inner, force = self.inner.pull_force(rows[:, : self.size])
        process = rows[:, self.size :].T.copy()
        process[: self.forces] += force.T
        return np.concatenate([inner, each(self.decay.T, process).T], axis=1)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs, on which no force depends."""
        inner = self.inner.drive(inputs)
        still = np.zeros((len(self.decay) * self.forces, inputs.shape[1]))
        return np.concatenate([inner, still])


def each(matrix: FloatArray, process: FloatArray) -> FloatArray:
    """Apply a matrix of shape (order, order) to each force and its rates, (order forces, ...)."""
    return np.asarray(matrix @ process.reshape(len(matrix), -1)).reshape(process.shape)
