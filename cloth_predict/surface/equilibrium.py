"""The shape in which a surface of springs is at rest."""

from __future__ import annotations

import numpy as np

from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import FloatArray


def settled(
    cloth: MassSpring, hung: FloatArray, start: FloatArray, step: float = 0.1
) -> FloatArray:
    """Positions [m], shape (nodes, 3), at which the cloth hangs at rest.

    hung: its input; start [m], shape (nodes, 3). Implicit steps of `step` [s], so long that their
    own damping takes the motion out, until one moves no node. Raises FloatingPointError.
    """
    x = np.concatenate([start[cloth.free].ravel(), np.zeros(cloth.dim_x // 2)])
    for _ in range(1000):
        before, x = x, ImplicitEuler().step(cloth, x, hung, step)
        if np.abs(x - before).max() < 1e-10:  # m and m/s: far below a float32's last digit
            return cloth.surface(x, hung)[0]
    raise FloatingPointError('the cloth does not come to rest')
