"""Motion without inertia, for shapes that stand still (Metaxas & Terzopoulos 1993, eq. 18)."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from cloth_predict.models.superquadric import LOCAL, Superquadric
from cloth_predict.types import FloatArray


class FirstOrder:
    """D q' + K q = f_q of a deformable superquadric, the state being q.

    D is diagonal; the paper's is the identity. What does not move in the body stays here too. The
    input holds the forces on the nodes, as that of the body does.
    """

    def __init__(self, body: Superquadric, damping: FloatArray | float = 1.0) -> None:
        """Take the body, of which mass, damping and gravity do not count, and D, (dim_q,)."""
        self.body = body
        self.mobility = body.moving / damping
        """Diagonal of D^-1, 0 of what does not move, shape (dim_q,)."""

    @property
    def dim_x(self) -> int:
        """Number of coordinates."""
        return self.body.dim_q

    @property
    def dim_u(self) -> int:
        """Three forces per node."""
        return self.body.dim_u

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Rate of the coordinates, shape (dim_q,)."""
        force = self.body.kinematics.pulled_back(x, u.reshape(-1, 3))
        force[LOCAL:] -= self.body.membrane.apply(self.body.kinematics.local(x)).ravel()
        return np.asarray(self.mobility * force)

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the coordinates."""
        slope = self.body.kinematics.pulled_back_slope(x, u.reshape(-1, 3)) - self.body.stiffness
        return (sparse.csr_array(sparse.diags(self.mobility)) @ slope).tocsr()

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the forces, D^-1 L'."""
        return (
            sparse.csr_array(sparse.diags(self.mobility)) @ self.body.kinematics.jacobian(x).T
        ).tocsr()

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Forces are held."""
        return u
