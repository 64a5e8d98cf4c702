"""Motion of bodies that are joined at points (Metaxas & Terzopoulos 1993, section III)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from cloth_predict.errors import ConfigError
from cloth_predict.models.joints import Joint, Joints, Linkage
from cloth_predict.models.linear_part import LinearPart
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.types import FloatArray, IntArray, Integrator

__all__ = ['Articulated', 'Joint', 'drift', 'stabilisation']


class Articulated:
    """Parts whose joints hold: a Dynamics of the stacked state.

    x = [q_1 .. q_n; q_1' .. q_n'], u = [u_1 .. u_n], the forces [N] on the nodes of each part.
    The joints' forces make C'' + 2 alpha C' + alpha^2 C = 0 (eq. 27, Baumgarte), so that an error
    of any origin dies out: one of C_0 at rest is C_0 (1 + alpha t) exp(-alpha t) later. They come
    from a system of 3k equations for k joints (eq. 32 to 34).
    """

    linear = False

    def __init__(
        self, parts: Sequence[Superquadric], joints: Sequence[Joint], alpha: float
    ) -> None:
        """Take the parts, their joints, and the rate alpha [1/s] at which errors die out.

        With alpha 0 nothing draws them back. Explicit steps have to be shorter than 2 / alpha
        (Euler, which then leaves an error of dt L' q' / alpha) or 2.785 / alpha (`rk4`). Raises
        ConfigError where a joint names a part or a node that is missing.
        """
        self.parts, self.joints = tuple(parts), Joints(parts, joints)
        self.alpha = stabilisation(alpha)
        self.inverse_mass = np.concatenate([part.inverse_mass for part in self.parts])
        """Diagonal of M^-1, 0 of what does not move, shape (dim_q,)."""
        self.moving = np.concatenate([part.moving for part in self.parts])
        """Which coordinates move, shape (dim_q,)."""

    @property
    def dim_q(self) -> int:
        """Number of coordinates of all parts."""
        return self.joints.dim_q

    @property
    def dim_x(self) -> int:
        """Number of states, two per coordinate."""
        return 2 * self.dim_q

    @property
    def dim_u(self) -> int:
        """Three forces per node."""
        return self.joints.dim_u

    @cached_property
    def rows(self) -> list[IntArray]:
        """Where the state [q_i; q_i'] of each part is in x."""
        halves = np.arange(self.dim_x).reshape(2, -1)
        return [halves[:, at].ravel() for at in self.joints.coordinates]

    def split(self, x: FloatArray) -> list[FloatArray]:
        """The states [q_i; q_i'] of the parts."""
        return [x[rows] for rows in self.rows]

    def join(self, states: Sequence[FloatArray]) -> FloatArray:
        """The stacked state of those of the parts, shape (dim_x,)."""
        result = np.empty(self.dim_x)
        result[np.concatenate(self.rows)] = np.concatenate(states)
        return result

    def admissible(self, x: FloatArray) -> FloatArray:
        """The state with that of every part made admissible."""
        states = zip(self.parts, self.split(x), strict=True)
        return self.join([part.admissible(state) for part, state in states])

    def position(self, x: FloatArray) -> FloatArray:
        """Positions [m] of the nodes of all parts, one part after the other, shape (nodes, 3)."""
        return self.joints.position(x[: self.dim_q])

    def violation(self, x: FloatArray) -> FloatArray:
        """C [m]: how far the two points of each joint are apart, shape (k, 3)."""
        return self.joints.violation(x[: self.dim_q]).reshape(-1, 3)

    def joint_forces(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Force f_c [N] of each joint on its part_a, opposite to that on its part_b, (k, 3)."""
        return self._motion(x, u).force.reshape(-1, 3)

    def joined_input(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Forces [N] on the nodes with those of the joints, shape (dim_u,).

        Under these each part by itself moves as it does here, so that a filter of its own can take
        the joints as known forces (eq. 36).
        """
        return u + self.joints.on_nodes(self._motion(x, u).force)

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (dim_x,)."""
        motion = self._motion(x, u)
        return np.concatenate([motion.rate, motion.joined])

    def augmented(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """q'', (dim_q,), and the multipliers lambda = -f_c, (3k,), by the whole system (eq. 26).

        The reference for `f`, which solves for the joints' forces alone.
        """
        motion, moving = self._motion(x, u), self.moving
        held, mass = motion.linkage.rows[:, moving], np.diag(1.0 / self.inverse_mass[moving])
        matrix = np.block([[mass, held.T], [held, np.zeros((len(held), len(held)))]])
        right = np.concatenate([mass @ motion.free[moving], -motion.steady])
        solution = linalg.solve(matrix, right, assume_a='sym')
        acceleration = np.zeros(self.dim_q)
        acceleration[moving] = solution[: len(mass)]
        return acceleration, solution[len(mass) :]

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by x, with that of the joints' forces, shape (dim_x, dim_x)."""
        motion = self._motion(x, u)
        slopes = self._stacked([part.jac(*at) for part, *at in self._each(x, u)])
        turned = self.joints.pulled_back_slope(x[: self.dim_q], motion.force)
        turned.resize((self.dim_q, self.dim_x))
        free = slopes[self.dim_q :] + sparse.csr_array(sparse.diags(self.inverse_mass)) @ turned
        held = motion.linkage.held(free, self._steady_slope(x, motion))
        return sparse.vstack([slopes[: self.dim_q], held], format='csr')

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f by the forces on the nodes, shape (dim_x, dim_u)."""
        by_part = [part.jac_input(*at)[part.dim_q :] for part, *at in self._each(x, u)]
        linkage = self.joints.at(x[: self.dim_q], self.inverse_mass)
        still = sparse.csr_array((self.dim_q, self.dim_u))
        return sparse.vstack([still, linkage.held(sparse.block_diag(by_part))], format='csr')

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Forces are held."""
        return u

    @cached_property
    def linear_part(self) -> LinearPart:
        """That of the parts: all of the motion but what gravity, the input and the joints do."""
        parts = [part.linear_part for part in self.parts]
        modes = tuple(
            replace(mode, rows=rows[mode.rows])
            for part, rows in zip(parts, self.rows, strict=True)
            for mode in part.modes
        )
        return LinearPart(self._stacked([part.matrix for part in parts]), modes)

    def _each(
        self, x: FloatArray, u: FloatArray
    ) -> Iterator[tuple[Superquadric, FloatArray, FloatArray]]:
        """Each part with its state and input."""
        inputs = [u[at] for at in self.joints.inputs]
        return zip(self.parts, self.split(x), inputs, strict=True)

    def _motion(self, x: FloatArray, u: FloatArray) -> _Motion:
        q, parts = x[: self.dim_q], list(self._each(x, u))
        rates, accelerations = zip(*[np.split(part.f(*at), 2) for part, *at in parts], strict=True)
        rate, linkage = np.concatenate(rates), self.joints.at(q, self.inverse_mass)
        steady = (
            self.joints.transport(q, rate)
            + 2.0 * self.alpha * (linkage.rows @ rate)
            + self.alpha**2 * self.joints.violation(q)
        )
        return _Motion(linkage, rate, np.concatenate(accelerations), steady)

    def _steady_slope(self, x: FloatArray, motion: _Motion) -> FloatArray:
        """Derivative of C_q q'' + `steady` by x with q'' held, shape (3k, dim_x)."""
        q, decay = x[: self.dim_q], 2.0 * self.alpha
        by_q, by_rate = self.joints.transport_slopes(q, motion.rate)
        by_q += self.joints.velocity_slope(q, motion.joined + decay * motion.rate)
        by_q += self.alpha**2 * motion.linkage.rows
        by_rate += decay * motion.linkage.rows
        return np.concatenate([by_q, np.where(self.moving, by_rate, 0.0)], axis=1)

    def _stacked(self, matrices: Sequence[sparse.csr_array]) -> sparse.csr_array:
        """The matrix, (dim_x, dim_x), of those of the parts."""
        order = np.argsort(np.concatenate(self.rows))
        return sparse.block_diag(matrices, format='csr')[order][:, order]


@dataclass(frozen=True)
class _Motion:
    """Parts at one state: their motion without joints, and what the joints make of it."""

    linkage: Linkage
    rate: FloatArray
    free: FloatArray
    """q'' without joints, shape (dim_q,)."""
    steady: FloatArray
    """L' q' + 2 alpha C' + alpha^2 C: what of r (eq. 34) does not depend on q'', shape (3k,)."""

    @cached_property
    def force(self) -> FloatArray:
        """f_c [N] of eq. 32, shape (3k,)."""
        return -self.linkage.solve(self.linkage.rows @ self.free + self.steady)

    @property
    def joined(self) -> FloatArray:
        """Second derivative q'' with the joints (eq. 28 to 30), shape (dim_q,)."""
        return self.free + self.linkage.moved(self.force)


def stabilisation(alpha: float) -> float:
    """The rate alpha [1/s] of eq. 27; ConfigError where it is negative or no number."""
    if not (np.isfinite(alpha) and alpha >= 0.0):
        raise ConfigError(f'alpha of the joints is {alpha:g}, expected a number from 0 on')
    return alpha


def drift(
    model: Articulated,
    x: FloatArray,
    forces: Callable[[float], FloatArray],
    dt: float,
    steps: int,
    integrator: Integrator,
) -> FloatArray:
    """Largest |C| [m] of the joints at the start and after each step of dt [s], (steps + 1,).

    forces: the input at a time [s]. From where |C| exceeds the extent of the bodies, which no
    longer are joined then, it is infinite.
    """
    extent = float(np.max(np.ptp(model.position(x), axis=0)))
    result = np.full(steps + 1, np.inf)
    for step in range(steps + 1):
        apart = float(np.max(np.linalg.norm(model.violation(x), axis=1), initial=0.0))
        if not apart < extent:
            break
        result[step] = apart
        x = integrator.step(model, x, forces(step * dt), dt)
    return result
