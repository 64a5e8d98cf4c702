"""The mass of a deformable superquadric, lumped (Metaxas & Terzopoulos 1993, section V.A)."""

from __future__ import annotations

import numpy as np

from cloth_predict.models import superquadric_shape
from cloth_predict.types import FloatArray

LIGHTEST = 0.1
"""A parameter whose change by 1 moves the reference shape by less than this share of its size is
given the mass of one that moves it so much: without a bend, b2 and b3 would have none."""


def lumped_mass(
    node_mass: FloatArray, reference: FloatArray, coordinates: FloatArray
) -> FloatArray:
    """Diagonal of int mu L'L (eq. 48) at a reference shape, of all coordinates q, (18 + 3N,).

    node_mass [kg], shape (N,); reference parameters, shape (11,); coordinates u, v [rad], (N, 2).
    The four masses of the rotation are one, by the mean moment of inertia: they are then those of
    any orientation.
    """
    shape = superquadric_shape.positions(reference, coordinates)
    slopes = superquadric_shape.jacobian(reference, coordinates)
    spread = node_mass @ np.sum(shape**2, axis=1)
    parameters = np.einsum('n,nak->k', node_mass, slopes**2)
    # trace(Q' I Q) = 4 trace(I) = 8 spread, over the three directions that turn
    turning = 8.0 / 3.0 * spread
    return np.concatenate(
        [
            np.full(3, np.sum(node_mass)),
            np.full(4, turning),
            np.maximum(parameters, LIGHTEST**2 * spread),
            np.repeat(node_mass, 3),
        ]
    )
