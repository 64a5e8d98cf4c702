"""Bodies that are joined at points and move without inertia: shapes that are to fit points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import sparse

from cloth_predict.models.constraints import stabilisation
from cloth_predict.models.first_order import FirstOrder
from cloth_predict.models.joints import Joint, Joints, Linkage
from cloth_predict.types import FloatArray


class ArticulatedFirstOrder:
    """Parts of first order whose joints hold: a Dynamics of x = [q_1 .. q_n].

    Metaxas & Terzopoulos 1993, eq. 18 with the constraints of section III: the joints' forces make
    C' + alpha C = 0, so that an error C_0 is C_0 exp(-alpha t) later. The input u = [u_1 .. u_n]
    holds the forces on the nodes of each part.
    """

    def __init__(self, parts: Sequence[FirstOrder], joints: Sequence[Joint], alpha: float) -> None:
        """Take the parts, their joints, and the rate alpha at which errors die out.

        Raises ConfigError where a joint names a part or a node that is missing.
        """
        self.parts, self.joints = tuple(parts), Joints([part.body for part in parts], joints)
        self.alpha = stabilisation(alpha)
        self.mobility = np.concatenate([part.mobility for part in self.parts])
        """Diagonal of D^-1, 0 of what does not move, shape (dim_x,)."""

    @property
    def dim_x(self) -> int:
        """Number of coordinates of all parts."""
        return self.joints.dim_q

    @property
    def dim_u(self) -> int:
        """Three forces per node."""
        return self.joints.dim_u

    def split(self, x: FloatArray) -> list[FloatArray]:
        """The coordinates of the parts."""
        return [x[at] for at in self.joints.coordinates]

    def violation(self, x: FloatArray) -> FloatArray:
        """C: how far the two points of each joint are apart, shape (k, 3)."""
        return self.joints.violation(x).reshape(-1, 3)

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Rate of the coordinates, shape (dim_x,)."""
        free, linkage, force = self._motion(x, u)
        return free + linkage.moved(force)

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the coordinates, with that of the joints' forces."""
        free, linkage, force = self._motion(x, u)
        slopes = sparse.block_diag([part.jac(*at) for part, *at in self._each(x, u)])
        turned = sparse.csr_array(sparse.diags(self.mobility)) @ self.joints.pulled_back_slope(
            x, force
        )
        steady = self.joints.velocity_slope(x, free + linkage.moved(force))
        return linkage.held(slopes + turned, steady + self.alpha * linkage.rows)

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the forces on the nodes, shape (dim_x, dim_u)."""
        by_part = [part.jac_input(*at) for part, *at in self._each(x, u)]
        return self.joints.at(x, self.mobility).held(sparse.block_diag(by_part))

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Forces are held."""
        return u

    def _each(
        self, x: FloatArray, u: FloatArray
    ) -> Iterator[tuple[FirstOrder, FloatArray, FloatArray]]:
        """Each part with its coordinates and input."""
        inputs = [u[at] for at in self.joints.inputs]
        return zip(self.parts, self.split(x), inputs, strict=True)

    def _motion(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, Linkage, FloatArray]:
        """Rate without joints, the joints at x, and their forces, shape (3k,)."""
        free = np.concatenate([part.f(*at) for part, *at in self._each(x, u)])
        linkage = self.joints.at(x, self.mobility)
        approach = linkage.rows @ free + self.alpha * self.joints.violation(x)
        return free, linkage, -linkage.solve(approach)
