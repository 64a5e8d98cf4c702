"""Mass-spring-damper surface: grid, chain or any mesh (Provot's cloth; Gomes 2016, chapter 3)."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from scipy import sparse

from cloth_predict.models.air import Air, Normals
from cloth_predict.models.blocks import BlockStructure
from cloth_predict.models.geometry import Shape
from cloth_predict.models.implicit import LinearisedSurface, MechanicalTangent
from cloth_predict.models.springs import Springs
from cloth_predict.types import FloatArray, IntArray

GRAVITY = (0.0, -9.81, 0.0)
"""Default gravity [m/s^2], Y up (Gomes 2016, below eq. 3.5)."""

SHORTEST = 1e-9
"""Length [m] under which a spring is taken to have this length, so that its direction exists."""


class MassSpring:
    """Point masses joined by springs and dampers; some nodes may be driven.

    State `x = [p; v]` of the free nodes, shape (6 free,). Input `u`: positions and velocities of
    the driven nodes, shape (6 driven,), then the load: an external force [N] on each free node,
    shape (3 free,), and, in moving air, the gust at each free node and the common wind [N], shape
    (free + 3,); `input` packs it. The sparsity is built once; each call computes values only.
    """

    def __init__(
        self,
        springs: Springs,
        mass: FloatArray,
        driven: IntArray | Sequence[int] = (),
        gravity: FloatArray | Sequence[float] = GRAVITY,
        air: Air | None = None,
        gravity_factor: FloatArray | float = 1.0,
    ) -> None:
        """Build the structure.

        mass [kg], shape (nodes,); driven, indices of the nodes that the input moves;
        gravity [m/s^2], shape (3,); air around it, if that matters; gravity_factor at
        each node, shape (nodes,) (Gomes 2016, eq. 5.15). Raises ValueError for values outside
        their range.
        """
        self.springs = springs
        self.mass = np.asarray(mass, float)
        self.gravity = np.asarray(gravity, float)
        self.air = air
        self.nodes = len(self.mass)
        self.driven = np.unique(np.asarray(driven, np.int64))
        self._check()
        self.free = np.setdiff1d(np.arange(self.nodes), self.driven)
        self.first, self.second = springs.pairs[:, 0], springs.pairs[:, 1]
        self._inverse_mass = 1.0 / self.mass[self.free]
        self._inverse_mass3 = np.repeat(self._inverse_mass, 3)
        self.mass3 = np.repeat(self.mass[self.free], 3)
        weighed = np.broadcast_to(gravity_factor, self.nodes)[self.free] * self.mass[self.free]
        self._weight = np.outer(weighed, self.gravity).ravel()
        self.driven_ends = self._ends_of_driven()
        triangles = np.zeros((0, 3), np.int64) if air is None else air.triangles
        self.blocks = BlockStructure(springs.pairs, self.free, self.nodes, triangles)
        self.mass_blocks = self.blocks.diagonal(self.mass[self.free])
        self._set_dampers()

    def with_springs(self, springs: Springs) -> MassSpring:
        """Return this surface with other springs between the same nodes, at little cost."""
        other = copy.copy(self)
        other.springs = springs
        other._set_dampers()
        return other

    @property
    def dim_x(self) -> int:
        """Number of states, 6 per free node."""
        return 6 * len(self.free)

    @property
    def dim_u(self) -> int:
        """Number of inputs: 6 per driven node, and the load."""
        return 6 * len(self.driven) + self.dim_load

    @property
    def dim_load(self) -> int:
        """Number of inputs that act as forces; they come last."""
        return 3 * len(self.free) + (0 if self.air is None else len(self.free) + 3)

    def input(
        self,
        position: FloatArray | None = None,
        velocity: FloatArray | None = None,
        force: FloatArray | None = None,
    ) -> FloatArray:
        """Pack driven positions [m] and velocities [m/s], shape (driven, 3), and forces [N]."""
        size = 3 * len(self.driven)
        u = np.zeros(self.dim_u)
        if position is not None:
            u[:size] = np.reshape(position, size)
        if velocity is not None:
            u[size : 2 * size] = np.reshape(velocity, size)
        if force is not None:
            u[2 * size :][: 3 * len(self.free)] = np.reshape(force, -1)
        return u

    def surface(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions [m] and velocities [m/s] of all nodes, each of shape (nodes, 3)."""
        n, size = 3 * len(self.free), 3 * len(self.driven)
        both = np.empty((2, self.nodes, 3))
        both[:, self.free] = x[: 2 * n].reshape(2, -1, 3)
        both[:, self.driven] = u[: 2 * size].reshape(2, -1, 3)
        return both[0], both[1]

    def acceleration(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Accelerations of the free nodes [m/s^2], shape (free, 3) (Gomes 2016, eq. 3.5, 3.7)."""
        n = 3 * len(self.free)
        return self.f(x, u)[n:].reshape(-1, 3)

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (6 free,) (Gomes 2016, eq. 3.4)."""
        return self._f(x, u, self._shape(x, u))

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x (Gomes 2016, eq. 3.23), with M^-1 in both halves."""
        shape, jav = self._shape(x, u), self._jav
        stiffness = self.blocks.gather(shape.stiffness(self.springs, clamp=False))
        if shape.normals is not None:
            gust, common = self.wind_of(u[6 * len(self.driven) :])
            slope = shape.normals.slope(shape.velocity, gust, common)
            stiffness += self.blocks.of_triangles(slope)
            jav = jav + self._weighted(self.air_damping(shape.normals))
        return self.blocks.state_matrix(self._weighted(stiffness), jav)

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input dt [s] later: the driven nodes go on with their velocities."""
        size = 3 * len(self.driven)
        after = u.copy()
        after[:size] += dt * u[size : 2 * size]
        return after

    def jac_input(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to u, shape (dim_x, dim_u)."""
        # the change of the velocity in a step that is so short that nothing moves
        at = self.linearise(x, u)
        slope = at.shape.stiffness(self.springs, clamp=False)
        tangent = MechanicalTangent(at, 1.0, np.asarray, slope, at.air_slope(0.0, 0.0))
        pushed = tangent.pushed(np.eye(self.dim_u), held=True) * self._inverse_mass3[:, None]
        return sparse.csr_array(np.concatenate([np.zeros_like(pushed), pushed]))

    def linearise(self, x: FloatArray, u: FloatArray) -> LinearisedSurface:
        """Return what an implicit step needs at x, from one look at the geometry."""
        shape, load = self._shape(x, u), u[6 * len(self.driven) :]
        return LinearisedSurface(
            self, shape, x[3 * len(self.free) :], self._inner_force(shape), load
        )

    def _f(self, x: FloatArray, u: FloatArray, shape: Shape) -> FloatArray:
        load = self.force_of(shape, u[6 * len(self.driven) :])
        force = self._inner_force(shape) + load
        return np.concatenate([x[3 * len(self.free) :], force * self._inverse_mass3])

    def _inner_force(self, shape: Shape) -> FloatArray:
        """Force [N] of springs, weight and drag on the free nodes, shape (3 free,)."""
        s = self.springs
        pull = -s.stiffness_at(shape.length) * (1.0 - s.rest_length / shape.length)
        force = pull[:, None] * shape.offset - s.damping[:, None] * shape.offset_rate
        total = (self.blocks.incidence @ force).ravel() + self._weight
        if shape.normals is not None:
            still = np.zeros(self.nodes), np.zeros(3)
            total += shape.normals.force(shape.velocity, *still)[self.free].ravel()
        return np.asarray(total)

    def force_of(self, shape: Shape, load: FloatArray) -> FloatArray:
        """Force [N] of loads on the free nodes, (3 free,) of (dim_load,) or with m columns."""
        n = 3 * len(self.free)
        if shape.normals is None:
            return load
        gust, common = load[n:-3], load[-3:]
        pressed = shape.normals.unit[self.free] * shape.normals.air.share[self.free][:, None]
        pressure = gust + shape.normals.unit[self.free] @ common
        if load.ndim == 1:
            return load[:n] + (pressed * pressure[:, None]).ravel()
        return load[:n] + (pressed[:, :, None] * pressure[:, None]).reshape(n, -1)

    def wind_of(self, load: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gust at each node, shape (nodes,), and common wind, (3,), of a load."""
        own, common = np.split(load[3 * len(self.free) :], [len(self.free)])
        gust = np.zeros(self.nodes)
        gust[self.free] = own
        return gust, common

    def air_damping(self, normals: Normals) -> FloatArray:
        """Blocks of the derivative of the air's force by the velocities of the free nodes."""
        return self.blocks.on_diagonal(normals.damping()[self.free])

    def _shape(self, x: FloatArray, u: FloatArray) -> Shape:
        position, velocity = self.surface(x, u)
        offset = position[self.first] - position[self.second]
        length = np.maximum(np.sqrt(np.einsum('si,si->s', offset, offset)), SHORTEST)
        normals = None if self.air is None else self.air.at(position)
        rate = velocity[self.first] - velocity[self.second]
        return Shape(offset, rate, length, velocity, normals)

    def _ends_of_driven(self) -> sparse.csr_array:
        """Offsets of the springs by the positions of the driven nodes, (3 springs, 3 driven)."""
        ends = np.zeros((len(self.springs.pairs), self.nodes))
        each = np.arange(len(ends))
        ends[each, self.first] += 1.0
        ends[each, self.second] -= 1.0
        return sparse.csr_array(sparse.kron(ends[:, self.driven], np.eye(3)))

    def _set_dampers(self) -> None:
        damping = self.blocks.gather(self.springs.damping[:, None])
        self.damping_blocks = damping * np.eye(3).ravel()
        self._jav = self._weighted(self.damping_blocks)

    def _weighted(self, blocks: FloatArray) -> FloatArray:
        return np.asarray(blocks * self._inverse_mass[self.blocks.a][:, None])

    def _check(self) -> None:
        if np.any(self.mass <= 0) or not np.all(np.isfinite(self.mass)):
            raise ValueError('mass must be finite and positive')
        if self.driven.size and not 0 <= self.driven[0] <= self.driven[-1] < self.nodes:
            raise ValueError(f'driven nodes must lie between 0 and {self.nodes - 1}')
        if len(self.driven) == self.nodes:
            raise ValueError('every node is driven')
        pairs = self.springs.pairs
        if pairs.size and not 0 <= pairs.min() <= pairs.max() < self.nodes:
            raise ValueError(f'springs must join nodes between 0 and {self.nodes - 1}')
