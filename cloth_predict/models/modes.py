"""Shapes to hold a surface to: the modes of its small vibrations, and those of its motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import FloatArray


@dataclass(frozen=True)
class Modes:
    """Shapes V, shape (3 free, modes), with V'MV = I.

    weight, shape (modes,): angular frequencies [rad/s], rising, of small vibrations; of a
    decomposition of motions the singular values, falling.
    """

    basis: FloatArray
    weight: FloatArray


def linear_modes(model: MassSpring, x: FloatArray, u: FloatArray, count: int) -> Modes:
    """Return the `count` slowest undamped vibrations about a state x at rest.

    K V = M V W^2 with K the stiffness there. A shape in which the surface is unstable or that
    nothing drives back has the frequency 0.
    """
    n = 3 * len(model.free)
    root = np.sqrt(model.mass3)
    # M^1/2 (M^-1 K) M^-1/2, symmetric but for rounding
    matrix = -(root[:, None] * model.jac(x, u)[n:, :n].toarray() / root)
    squares, vectors = linalg.eigh(0.5 * (matrix + matrix.T), subset_by_index=(0, count - 1))
    return Modes(vectors / root[:, None], np.sqrt(np.maximum(squares, 0.0)))


def motion_modes(model: MassSpring, rest: FloatArray, positions: FloatArray, count: int) -> Modes:
    """Return the `count` shapes that hold most of motions about a rest state [m], (3 free,).

    positions [m], shape (frames, 3 free). Proper orthogonal decomposition, nodes weighed by their
    masses: of all bases of that size it leaves the least of these frames out.
    """
    root = np.sqrt(model.mass3)
    _, values, shapes = linalg.svd((positions - rest) * root, full_matrices=False)
    return Modes(shapes[:count].T / root[:, None], values[:count])
