"""A surface held to a few shapes: p = rest + V q, by Galerkin's projection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from cloth_predict.models.implicit import LinearisedSurface, MechanicalTangent
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import FloatArray, IntArray, Solver


class Reduced:
    """A surface whose free nodes move along the columns of a basis V only.

    State `x = [q; q']` of the shares of the shapes, shape (2 modes,). The equations of motion
    M p'' = F hold along the basis: (V'MV) q'' = V'F(rest + V q, V q', u). The input is that of the
    surface. Driven nodes that move carry nothing along by themselves: the basis has to hold what
    follows them. Forces are still those of every spring, so that what gets cheaper is the
    matrices, above all a filter's.
    """

    def __init__(self, model: MassSpring, rest: FloatArray, basis: FloatArray) -> None:
        """Take the rest state [m] of the free nodes, (3 free,), and V, shape (3 free, modes).

        Raises ValueError where the columns of V depend on each other.
        """
        self.model = model
        self.rest, self.basis = np.asarray(rest, float), np.asarray(basis, float)
        size = 3 * len(model.free)
        if self.rest.shape != (size,) or self.basis.shape[:1] != (size,):
            raise ValueError(
                f'rest and basis have shapes {self.rest.shape} and {self.basis.shape}, expected '
                f'({size},) and ({size}, modes)'
            )
        weighted = model.mass3[:, None] * self.basis
        self.mass = self.basis.T @ weighted
        """V'MV, shape (modes, modes)."""
        if np.linalg.matrix_rank(self.basis) < self.modes:
            raise ValueError(f'the {self.modes} shapes of the basis depend on each other')
        self.shares = np.linalg.solve(self.mass, weighted.T)
        """(V'MV)^-1 V'M: the shares of the shapes in a displacement, shape (modes, 3 free)."""

    @property
    def modes(self) -> int:
        """Number of shapes."""
        return int(self.basis.shape[1])

    @property
    def dim_x(self) -> int:
        """Number of states, two per shape."""
        return 2 * self.modes

    @property
    def dim_u(self) -> int:
        """Inputs of the surface."""
        return self.model.dim_u

    @property
    def dim_load(self) -> int:
        """Loads of the surface."""
        return self.model.dim_load

    def lift(self, x: FloatArray) -> FloatArray:
        """State of the surface, shape (6 free,)."""
        return np.concatenate([self.rest, np.zeros(len(self.rest))]) + self.lifted(x)

    def lifted(self, columns: FloatArray) -> FloatArray:
        """Changes of the state of the surface, (6 free, ...), with those of x, (dim_x, ...)."""
        r = self.modes
        return np.concatenate([self.basis @ columns[:r], self.basis @ columns[r:]])

    def project(self, state: FloatArray) -> FloatArray:
        """The x nearest to a state of the surface, shape (6 free,), by masses, shape (dim_x,)."""
        n = len(self.rest)
        return np.concatenate([self.shares @ (state[:n] - self.rest), self.shares @ state[n:]])

    def seen(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Matrix C, (m, dim_x), and c, (m,), of these rows of the positions: c + C x."""
        still = np.zeros((len(rows), self.modes))
        return np.concatenate([self.basis[rows], still], axis=1), self.rest[rows]

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        faster = self.model.f(self.lift(x), u)[len(self.rest) :]
        return np.concatenate([x[self.modes :], self.shares @ faster])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x, shape (dim_x, dim_x)."""
        n, r = len(self.rest), self.modes
        whole = self.model.jac(self.lift(x), u)[n:]
        by_state = [self.shares @ (half @ self.basis) for half in (whole[:, :n], whole[:, n:])]
        upper = np.concatenate([np.zeros((r, r)), np.eye(r)], axis=1)
        return sparse.csr_array(np.concatenate([upper, np.concatenate(by_state, axis=1)]))

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (dim_x, dim_u)."""
        lower = self.shares @ self.model.jac_input(self.lift(x), u)[len(self.rest) :].toarray()
        return sparse.csr_array(np.concatenate([np.zeros((self.modes, self.dim_u)), lower]))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the surface dt [s] later."""
        return self.model.input_after(u, dt)

    def linearise(self, x: FloatArray, u: FloatArray) -> LinearisedReduced:
        """Return the surface at (x, u)."""
        return LinearisedReduced(self, self.model.linearise(self.lift(x), u), x)


@dataclass(frozen=True)
class LinearisedReduced:
    """A reduced surface at one state; see `types.Linearised`.

    Its step is that of the surface with (V'AV)^-1 in place of A^-1.
    """

    reduced: Reduced
    inner: LinearisedSurface
    x: FloatArray

    def solver(self, dt: float) -> Solver:
        """Solver of V'AV, positive definite as A is, shape (modes, modes)."""
        matrix = self.inner.model.blocks.matrix(self.inner.matrix(dt))
        v = self.reduced.basis
        factor = linalg.cho_factor(v.T @ (matrix @ v), lower=True, check_finite=False)
        return lambda b: np.asarray(linalg.cho_solve(factor, b, check_finite=False))

    def change(self, dt: float, solver: Solver, load: FloatArray | float = 0.0) -> FloatArray:
        """Change of the state in a step (Gomes 2016, eq. 3.32, along the basis)."""
        r = self.reduced.modes
        moved = self.inner.change(dt, self._whole(solver), load)
        faster = self.reduced.shares @ moved[len(self.reduced.rest) :]
        return np.concatenate([dt * (self.x[r:] + faster), faster])

    def tangent(
        self, dt: float, solver: Solver, change: FloatArray, load: FloatArray | float = 0.0
    ) -> ReducedTangent:
        """Derivative of the step, through the change of the matrix with the state too."""
        whole = self.reduced.lifted(change)
        inner = self.inner.tangent(dt, self._whole(solver), whole, load)
        return ReducedTangent(self.reduced, self.inner, inner, dt, solver)

    def _whole(self, solver: Solver) -> Solver:
        """V (V'AV)^-1 V', which takes the place of A^-1."""
        v = self.reduced.basis
        return lambda force: np.asarray(v @ solver(v.T @ force))


@dataclass(frozen=True)
class ReducedTangent:
    """Derivative of the step, through V'AV y = V'MV q' + dt V'SV q; see `types.Tangent`.

    inner: that of the surface when (V'AV)^-1 stands in place of A^-1.
    """

    reduced: Reduced
    at: LinearisedSurface
    inner: MechanicalTangent
    dt: float
    solver: Solver

    @cached_property
    def slope(self) -> FloatArray:
        """V'SV, shape (modes, modes)."""
        v = self.reduced.basis
        return np.asarray(v.T @ (self.inner.slope @ v))

    def push(self, columns: FloatArray, load: FloatArray | None = None) -> FloatArray:
        """Return F C, shape (dim_x, m), for changes of the load, (dim_load, m), as well."""
        r, dt = self.reduced.modes, self.dt
        pulled = self.slope @ columns[:r]
        if load is not None:
            pulled += self.reduced.basis.T @ self.reduced.model.force_of(self.at.shape, load)
        after = self.solver(self.reduced.mass @ columns[r:] + dt * pulled)
        return np.concatenate([columns[:r] + dt * after, after])

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F, shape (m, dim_x)."""
        r, dt = self.reduced.modes, self.dt
        both = self.solver((rows[:, r:] + dt * rows[:, :r]).T)
        position = rows[:, :r] + dt * (self.slope.T @ both).T
        return np.concatenate([position, (self.reduced.mass @ both).T], axis=1)

    def pull_load(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return W F and the derivative of W x by the load, shapes (m, dim_x), (m, dim_load)."""
        r = self.reduced.modes
        shares = self.reduced.shares
        whole = np.concatenate([rows[:, :r] @ shares, rows[:, r:] @ shares], axis=1)
        return self.pull(rows), self.inner.pull_load(whole)[1]

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F' of a symmetric P."""
        return self.sandwiched(self.push(cov), self.push)

    def sandwiched(
        self, pushed: FloatArray, push: Callable[[FloatArray], FloatArray]
    ) -> FloatArray:
        """Columns of the model's states of F P F', from F P, which may have more rows."""
        r = self.reduced.modes
        velocity = push(pushed[r : 2 * r].T)
        return np.concatenate([pushed[:, :r] + self.dt * velocity, velocity], axis=1)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with the driven nodes and the load."""
        after = self.solver(self.dt * (self.reduced.basis.T @ self.inner.pushed(inputs)))
        return np.concatenate([self.dt * after, after])
