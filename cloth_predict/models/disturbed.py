"""Adds the forces that a model does not know as states: a Gauss-Markov process per input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy import sparse

from cloth_predict.types import (
    FloatArray,
    Linearised,
    Solver,
    StiffDynamics,
    Tangent,
    read_only,
)


class LoadedTangent(Tangent, Protocol):
    """Derivative of a step over which a load is held."""

    def push(self, columns: FloatArray, load: FloatArray | None = None) -> FloatArray:
        """Return F C, for changes of the load, shape (dim_load, m), as well."""

    def pull_load(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return W F and the derivative of W x by the load, shape (m, dim_load)."""

    def sandwiched(
        self, pushed: FloatArray, push: Callable[[FloatArray], FloatArray]
    ) -> FloatArray:
        """Columns of F P F' of the model's states, from F P, which has further rows, and F C."""


class LoadedLinearised(Linearised, Protocol):
    """A model at one state under a load, shape (dim_load,), besides that of its input."""

    def change(self, dt: float, solver: Solver, load: FloatArray | float = 0.0) -> FloatArray:
        """Change of the state in a step of dt [s], shape (dim_x,)."""

    def tangent(
        self, dt: float, solver: Solver, change: FloatArray, load: FloatArray | float = 0.0
    ) -> LoadedTangent:
        """Derivative of the step that makes this change."""


class Loaded(StiffDynamics, Protocol):
    """Motion whose last inputs are a load: forces, which act linearly."""

    @property
    def dim_load(self) -> int:
        """Number of inputs that act as forces; they come last."""

    def linearise(self, x: FloatArray, u: FloatArray) -> LoadedLinearised:
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


@dataclass(frozen=True)
class Unknown:
    """A part of the load that is not known: load[at] = mix y, each y a process of its own.

    mix, shape (len(at), count), correlates and spreads the y; without it each y is one load.
    """

    process: ForceProcess
    at: slice
    count: int
    mix: FloatArray | None = None

    @property
    def order(self) -> int:
        """Number of states for each y: itself, and its rates."""
        return len(self.process.drift)

    @property
    def size(self) -> int:
        """Number of states."""
        return self.order * self.count

    def decay(self, dt: float) -> FloatArray:
        """Implicit step (I - dt drift)^-1 of one y and its rates, shape (order, order)."""
        return _decay(self.process.drift.tobytes(), self.order, dt)


@lru_cache(maxsize=64)
def _decay(drift: bytes, order: int, dt: float) -> FloatArray:
    matrix = np.frombuffer(drift).reshape(order, order)
    return np.asarray(read_only(np.linalg.inv(np.eye(order) - dt * matrix)))


class Disturbed:
    """Any model with what is unknown of its load as states.

    x = [x_model; for each unknown part: its values y, then their rates, if any].
    """

    def __init__(self, model: Loaded, *unknown: Unknown | ForceProcess | float) -> None:
        """Wrap a model.

        A process stands for one on each load, a number for an Ornstein-Uhlenbeck process with
        that tau [s].
        """
        self.model = model
        self.unknown = tuple(self._part(part) for part in unknown)
        ends = np.cumsum([model.dim_x, *(part.size for part in self.unknown)]).tolist()
        self.states = [slice(*ends[k : k + 2]) for k in range(len(self.unknown))]
        """Where the states of each unknown part are."""
        self._dim_x = int(ends[-1])

    @property
    def dim_x(self) -> int:
        """States of the model, and of the unknown parts."""
        return self._dim_x

    @property
    def dim_u(self) -> int:
        """Inputs of the model."""
        return self.model.dim_u

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        inner = self.model.f(x[: self.model.dim_x], self._under(x, u))
        drifts = [
            each(part.process.drift, x[at])
            for part, at in zip(self.unknown, self.states, strict=True)
        ]
        return np.concatenate([inner, *drifts])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, shape (dim_x, dim_x)."""
        inner, under = x[: self.model.dim_x], self._under(x, u)
        by_load = self.model.jac_input(inner, under)[:, self.dim_u - self.model.dim_load :]
        gains, drifts = [], []
        for part in self.unknown:
            gain = by_load[:, part.at]
            gains.append(gain if part.mix is None else gain @ sparse.csr_array(part.mix))
            gains.append(sparse.csr_array((len(inner), part.size - part.count)))
            drifts.append(sparse.kron(part.process.drift, sparse.eye(part.count)))
        first = sparse.hstack([self.model.jac(inner, under), *gains])
        last = sparse.hstack(
            [sparse.csr_array((self.dim_x - len(inner), len(inner))), sparse.block_diag(drifts)]
        )
        return sparse.csr_array(sparse.vstack([first, last]))

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (dim_x, dim_u): that of the model."""
        inner = self.model.jac_input(x[: self.model.dim_x], self._under(x, u))
        still = sparse.csr_array((self.dim_x - self.model.dim_x, self.dim_u))
        return sparse.csr_array(sparse.vstack([inner, still]))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the model dt [s] later."""
        return self.model.input_after(u, dt)

    def linearise(self, x: FloatArray, u: FloatArray) -> _Linearised:
        """Return the model and its load at (x, u)."""
        inner = self.model.linearise(x[: self.model.dim_x], u)
        return _Linearised(self, inner, x)

    def load(self, x: FloatArray) -> FloatArray:
        """Unknown load, shape (dim_load,) of (dim_x,), or with m columns."""
        if self._alone:
            return x[self.states[0]][: self.model.dim_load]
        load = np.zeros((self.model.dim_load, *x.shape[1:]))
        for part, at in zip(self.unknown, self.states, strict=True):
            values = x[at][: part.count]
            load[part.at] += values if part.mix is None else part.mix @ values
        return load

    def stepped(self, x: FloatArray, dt: float, back: bool = False) -> FloatArray:
        """Unknown parts after an implicit step, or its transpose, in a state of x's shape.

        The model's own part is left for the caller to fill in.
        """
        after = np.empty_like(x)
        for part, at in zip(self.unknown, self.states, strict=True):
            decay = part.decay(dt)
            after[at] = each(decay.T if back else decay, x[at])
        return after

    def unload(self, columns: FloatArray, by_load: FloatArray) -> None:
        """Add to columns, shape (dim_x, m), what the load's values owe to by_load, (dim_load, m).

        The transpose of `load`.
        """
        for part, at in zip(self.unknown, self.states, strict=True):
            own = by_load[part.at]
            columns[at][: part.count] += own if part.mix is None else part.mix.T @ own

    @property
    def _alone(self) -> bool:
        """Whether one part, without a mix, is the whole load."""
        first = self.unknown[0]
        return len(self.unknown) == 1 and first.mix is None and first.count == self.model.dim_load

    def _under(self, x: FloatArray, u: FloatArray) -> FloatArray:
        under = u.copy()
        under[self.dim_u - self.model.dim_load :] += self.load(x)
        return under

    def _part(self, part: Unknown | ForceProcess | float) -> Unknown:
        if isinstance(part, Unknown):
            return part
        if isinstance(part, (int, float)):
            if part <= 0:
                raise ValueError('tau must be positive')
            part = ForceProcess.ornstein_uhlenbeck(1.0, part)
        return Unknown(part, slice(None), self.model.dim_load)


@dataclass(frozen=True)
class _Linearised:
    """A disturbed model at one state: the load changes within a step and then acts on the model.

    That is the implicit step of both together, as no unknown depends on the model. See
    `types.Linearised`.
    """

    model: Disturbed
    inner: LoadedLinearised
    x: FloatArray

    def solver(self, dt: float) -> Solver:
        """Solver of the model's own step."""
        return self.inner.solver(dt)

    def change(self, dt: float, solver: Solver) -> FloatArray:
        """Change of the model under the load, and of the load."""
        after, size = self.model.stepped(self.x, dt), self.model.model.dim_x
        moved = self.inner.change(dt, solver, self.model.load(after))
        return np.concatenate([moved, after[size:] - self.x[size:]])

    def tangent(self, dt: float, solver: Solver, change: FloatArray) -> _Tangent:
        """Derivative of the step."""
        load = self.model.load(self.x + change)
        inner = self.inner.tangent(dt, solver, change[: self.model.model.dim_x], load)
        return _Tangent(self.model, inner, dt)


@dataclass(frozen=True)
class _Tangent:
    """Derivative of the step of a disturbed model; see `types.Tangent`."""

    model: Disturbed
    inner: LoadedTangent
    dt: float

    def push(self, columns: FloatArray) -> FloatArray:
        """Return F C."""
        size, after = self.model.model.dim_x, self.model.stepped(columns, self.dt)
        after[:size] = self.inner.push(columns[:size], self.model.load(after))
        return after

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F."""
        size, columns = self.model.model.dim_x, rows.T.copy()
        inner, by_load = self.inner.pull_load(rows[:, :size])
        self.model.unload(columns, by_load.T)
        columns = self.model.stepped(columns, self.dt, back=True)
        columns[:size] = inner.T
        return columns.T

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F' of a symmetric P."""
        size, pushed = self.model.model.dim_x, self.push(cov)
        unknown = self.model.stepped(pushed.T, self.dt)[size:].T
        return np.concatenate([self.inner.sandwiched(pushed, self.push), unknown], axis=1)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with its inputs, on which no unknown depends."""
        inner = self.inner.drive(inputs)
        still = np.zeros((self.model.dim_x - len(inner), inputs.shape[1]))
        return np.concatenate([inner, still])


def each(matrix: FloatArray, process: FloatArray) -> FloatArray:
    """Apply a matrix of shape (order, order) to each y and its rates, (order count, ...)."""
    return np.asarray(matrix @ process.reshape(len(matrix), -1)).reshape(process.shape)
