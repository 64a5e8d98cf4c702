"""The constant linear part of a motion, x' = A x + n(x, u), and functions of A.

Where A falls into normal modes they cost next to nothing, for any time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy import sparse
from scipy.linalg import eigh, expm

from cloth_predict.types import Dynamics, FloatArray, IntArray, read_only

Which = Literal['exp', 'once', 'twice']


class Functions(NamedTuple):
    """exp(tA), t phi1(tA) and t^2 phi2(tA), each of shape (n, m, m) for n matrices A.

    phi1(z) = (e^z - 1) / z and phi2(z) = (phi1(z) - 1) / z: what a constant rate, and one that
    grows by 1 per second, add within t.
    """

    exp: FloatArray
    once: FloatArray
    twice: FloatArray


@dataclass(frozen=True, eq=False)
class NormalModes:
    """Coordinates, `axes` times n, that act on each other by n modes alone, of m states each.

    rows, shape (axes, m, n): where the states are in x; matrices A, shape (n, m, m), of the modes;
    shapes, shape (n, n): the modes as columns, and their inverse; without them each coordinate is
    a mode.
    """

    rows: IntArray
    matrices: FloatArray
    shapes: FloatArray | None = None
    inverse: FloatArray | None = None

    @classmethod
    def oscillators(
        cls, rows: IntArray, stiffness: FloatArray, damping: FloatArray | float
    ) -> NormalModes:
        """Coordinates by themselves: y'' = -stiffness y - damping y'.

        rows, shape (2, n), of the coordinates and their rates; stiffness [1/s^2], shape (n,);
        damping [1/s] of all or of each.
        """
        return cls(rows[None], _oscillators(stiffness, damping))

    @classmethod
    def vibrations(
        cls, rows: IntArray, stiffness: FloatArray, mass: FloatArray, alpha: float, beta: float
    ) -> NormalModes:
        """Modes of M y'' + D y' + K y = 0, of K [N/m], (n, n), M [kg], (n,), D = alpha M + beta K.

        rows, shape (axes, 2, n), of the coordinates and their rates.
        """
        squared, shapes = eigh(stiffness, np.diag(mass))
        matrices = _oscillators(squared, alpha + beta * squared)
        return cls(rows, matrices, shapes, shapes.T * mass)

    def over(self, time: float) -> Functions:
        """Functions of the modes' matrices over a time [s]."""
        return _functions(self, time)

    def matrix(self, which: Which, time: float) -> FloatArray:
        """Function of A for the coordinates of one axis, shape (m, n, m, n)."""
        return _matrix(self, which, time)

    def apply(self, which: Which, time: float, own: FloatArray, back: bool) -> FloatArray:
        """Function of A, or its transpose, times columns of these rows, (axes, m, n, c)."""
        modal, forth, into = getattr(self.over(time), which), self.inverse, self.shapes
        if back:
            modal = modal.transpose(0, 2, 1)
            forth, into = (None if m is None else m.T for m in (self.shapes, self.inverse))
        if forth is not None:
            own = forth @ own
        moved = np.einsum('nij,ajnc->ainc', modal, own)
        return np.asarray(moved if into is None else into @ moved)


@lru_cache(maxsize=32)  # of a few bodies: the interval between frames, and the horizons
def _matrix(modes: NormalModes, which: Which, time: float) -> FloatArray:
    modal = getattr(modes.over(time), which).transpose(1, 2, 0)
    if modes.shapes is None or modes.inverse is None:
        return np.asarray(
            read_only((modal[..., None] * np.eye(modal.shape[2])).transpose(0, 2, 1, 3))
        )
    full = (modes.shapes * modal[:, :, None, :]) @ modes.inverse
    return np.asarray(read_only(full.transpose(0, 2, 1, 3)))


@dataclass(frozen=True, eq=False)
class LinearPart:
    """The matrix A, (dim_x, dim_x), and its modes; states that are in no mode stay as they are."""

    matrix: sparse.csr_array
    modes: tuple[NormalModes, ...]

    @classmethod
    def of_matrix(cls, matrix: FloatArray) -> LinearPart:
        """The part of any matrix A: one mode of all states."""
        whole = NormalModes(np.arange(len(matrix))[None, :, None], matrix[None])
        return cls(sparse.csr_array(matrix), (whole,))

    def apply(
        self, which: Which, time: float, columns: FloatArray, back: bool = False
    ) -> FloatArray:
        """Function of A, or its transpose, times columns, shape (dim_x,) or (dim_x, c)."""
        result = _still(which, time) * columns
        for modes in self.modes:
            own = columns[modes.rows].reshape(*modes.rows.shape, -1)
            moved = modes.apply(which, time, own, back)
            result[modes.rows] = moved.reshape(*modes.rows.shape, *columns.shape[1:])
        return np.asarray(result)

    def submatrix(self, which: Which, time: float, rows: IntArray) -> FloatArray:
        """Function of A for states that no others act on, rows of shape (g,), shape (g, g)."""
        place = np.full(self.matrix.shape[0], -1)
        place[rows] = np.arange(len(rows))
        result = _still(which, time) * np.eye(len(rows))
        for modes in self.modes:
            own = place[modes.rows].reshape(len(modes.rows), -1)
            if (own >= 0).all():
                result[own[:, :, None], own[:, None]] = modes.matrix(which, time).reshape(
                    own.shape[1], -1
                )
        return result


class Semilinear(Dynamics, Protocol):
    """Motion that offers its constant linear part."""

    @property
    def linear_part(self) -> LinearPart:
        """A of x' = A x + n(x, u), the same object each time."""


def of_axes(first: int, nodes: int, groups: Sequence[int]) -> IntArray:
    """Rows of node-major vectors, by axis, shape (3, len(groups), nodes).

    first: where the vectors begin within each group of states; groups: where those begin.
    """
    vectors = first + np.arange(3 * nodes).reshape(nodes, 3).T
    return np.asarray(np.asarray(groups)[None, :, None] + vectors[:, None, :])


def _still(which: Which, time: float) -> float:
    """Function of a state that does not move by itself, A = 0."""
    return {'exp': 1.0, 'once': time, 'twice': 0.5 * time**2}[which]


def _oscillators(stiffness: FloatArray, damping: FloatArray | float) -> FloatArray:
    matrices = np.zeros((len(stiffness), 2, 2))
    matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = 1.0, -stiffness, -damping
    return matrices


@lru_cache(maxsize=64)
def _functions(modes: NormalModes, time: float) -> Functions:
    """All three from one exponential of [[A, 1, 0], [0, 0, 1], [0, 0, 0]]."""
    number, size, _ = modes.matrices.shape
    chained = np.zeros((number, 3 * size, 3 * size))
    chained[:, :size, :size] = modes.matrices
    chained[:, :-size, size:] += np.eye(2 * size)
    found = expm(time * chained)[:, :size].reshape(number, size, 3, size)
    # the blocks are of the matrices times `time` already: t phi1, t^2 phi2
    return Functions(*(np.asarray(read_only(found[:, :, k])) for k in range(3)))
