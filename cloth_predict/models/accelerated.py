"""A body pushed by what is not known: accelerations of some coordinates, as states."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse

from cloth_predict.models.disturbed import ForceProcess
from cloth_predict.models.linear_part import LinearPart, NormalModes
from cloth_predict.models.superquadric import LOCAL, Superquadric
from cloth_predict.types import FloatArray, IntArray


class Accelerated:
    """x = [q; q'; a; ...]: q'' of the body plus a, a process of its own, followed by its rates.

    coordinates, shape (k,): which of the 18 that all nodes share are pushed.
    """

    def __init__(self, body: Superquadric, coordinates: IntArray, process: ForceProcess) -> None:
        """Raises ValueError where a coordinate cannot be pushed."""
        if not body.moving[coordinates].all() or (np.asarray(coordinates) >= LOCAL).any():
            raise ValueError('only coordinates that move, and that all nodes share, are pushed')
        self.body, self.process = body, process
        self.coordinates = np.unique(coordinates)

    @property
    def order(self) -> int:
        """States of each push: itself, and its rates."""
        return len(self.process.drift)

    @property
    def pushed(self) -> IntArray:
        """Coordinate of each state after those of the body: of the pushes, then of their rates."""
        return np.tile(self.coordinates, self.order)

    @property
    def dim_x(self) -> int:
        """States of the body, and those of the pushes."""
        return self.body.dim_x + len(self.pushed)

    @property
    def dim_u(self) -> int:
        """Inputs of the body."""
        return self.body.dim_u

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        own, push = x[: self.body.dim_x], x[self.body.dim_x :].reshape(self.order, -1)
        rate = self.body.f(own, u)
        rate[self.body.dim_q + self.coordinates] += push[0]
        return np.concatenate([rate, (self.process.drift @ push).ravel()])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by x; the same object each time where the motion is linear."""
        inner = self.body.jac(x[: self.body.dim_x], u)
        linear = inner is self.body.linear_part.matrix
        return self.linear_part.matrix if linear else self._pushed(inner)

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the input, on which no push depends."""
        inner = self.body.jac_input(x[: self.body.dim_x], u)
        still = sparse.csr_array((len(self.pushed), self.dim_u))
        return sparse.vstack([inner, still], format='csr')

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input of the body dt [s] later."""
        return self.body.input_after(u, dt)

    def admissible(self, x: FloatArray) -> FloatArray:
        """The state with that of the body made admissible."""
        return np.append(self.body.admissible(x[: self.body.dim_x]), x[self.body.dim_x :])

    @cached_property
    def linear_part(self) -> LinearPart:
        """That of the body, with modes of more states for what is pushed."""
        inner, first = self.body.linear_part, self.body.dim_x
        rates, size = len(self.coordinates) * np.arange(self.order), 2 + self.order
        modes: list[NormalModes] = []
        for group in inner.modes:
            pushed = np.isin(group.rows[0, 0], self.coordinates)
            if not pushed.any():
                modes.append(group)
                continue
            modes.append(NormalModes(group.rows[:, :, ~pushed], group.matrices[~pushed]))
            which = np.searchsorted(self.coordinates, group.rows[0, 0, pushed])
            rows = np.vstack([group.rows[0][:, pushed], first + rates[:, None] + which])
            matrices = np.zeros((len(which), size, size))
            matrices[:, :2, :2] = group.matrices[pushed]
            matrices[:, 1, 2], matrices[:, 2:, 2:] = 1.0, self.process.drift
            modes.append(NormalModes(rows[None], matrices))
        return LinearPart(self._pushed(inner.matrix), tuple(modes))

    def _pushed(self, jac: sparse.csr_array) -> sparse.csr_array:
        """Jacobian with the pushes, from that of the body."""
        number = len(self.coordinates)
        places = self.body.dim_q + self.coordinates, np.arange(number)
        shape = self.body.dim_x, len(self.pushed)
        gain = sparse.csr_array((np.ones(number), places), shape=shape)
        drift = sparse.kron(self.process.drift, sparse.csr_array(sparse.eye(number)))
        return sparse.csr_array(sparse.bmat([[jac, gain], [None, drift]]))
