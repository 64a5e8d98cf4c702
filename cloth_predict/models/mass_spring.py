"""Mass-spring-damper surface: grid, chain or any mesh (Provot's cloth; Gomes 2016, chapter 3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from cloth_predict.models.air import Air, Normals
from cloth_predict.models.blocks import BlockStructure
from cloth_predict.models.springs import Springs
from cloth_predict.types import FloatArray, IntArray, Solver

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
    ) -> None:
        """Build the structure.

        mass [kg], shape (nodes,); driven, indices of the nodes that the input moves;
        gravity [m/s^2], shape (3,); air around it, if that matters. Raises ValueError for values
        outside their range.
        """
        self.springs = springs
        self.mass = np.asarray(mass, float)
        self.gravity = np.asarray(gravity, float)
        self.air = air
        self.nodes = len(self.mass)
        self.driven = np.unique(np.asarray(driven, np.int64))
        self._check()
        self.free = np.setdiff1d(np.arange(self.nodes), self.driven)
        self._i, self._j = springs.pairs[:, 0], springs.pairs[:, 1]
        self._inverse_mass = 1.0 / self.mass[self.free]
        self._inverse_mass3 = np.repeat(self._inverse_mass, 3)
        self._mass3 = np.repeat(self.mass[self.free], 3)
        self._weight = np.outer(self.mass[self.free], self.gravity).ravel()
        self._driven_ends = self._ends_of_driven()
        triangles = np.zeros((0, 3), np.int64) if air is None else air.triangles
        self._blocks = BlockStructure(springs.pairs, self.free, self.nodes, triangles)
        self._mass_blocks = self._blocks.diagonal(self.mass[self.free])
        damping = self._blocks.gather(springs.damping[:, None]) * np.eye(3).ravel()
        self._damping_blocks = damping
        self._jav = self._weighted(damping)

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
        stiffness = self._blocks.gather(shape.stiffness(self.springs, clamp=False))
        if shape.normals is not None:
            gust, common = self._wind(u[6 * len(self.driven) :])
            slope = shape.normals.slope(shape.velocity, gust, common)
            stiffness += self._blocks.of_triangles(slope)
            jav = jav + self._weighted(self._air_damping(shape.normals))
        return self._blocks.state_matrix(self._weighted(stiffness), jav)

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

    def linearise(self, x: FloatArray, u: FloatArray) -> _Linearised:
        """Return what an implicit step needs at x, from one look at the geometry."""
        shape, load = self._shape(x, u), u[6 * len(self.driven) :]
        return _Linearised(self, shape, x[3 * len(self.free) :], self._inner_force(shape), load)

    def _f(self, x: FloatArray, u: FloatArray, shape: _Shape) -> FloatArray:
        load = self._load(shape, u[6 * len(self.driven) :])
        force = self._inner_force(shape) + load
        return np.concatenate([x[3 * len(self.free) :], force * self._inverse_mass3])

    def _inner_force(self, shape: _Shape) -> FloatArray:
        """Force [N] of springs, weight and drag on the free nodes, shape (3 free,)."""
        s = self.springs
        pull = -s.stiffness_at(shape.length) * (1.0 - s.rest_length / shape.length)
        force = pull[:, None] * shape.offset - s.damping[:, None] * shape.offset_rate
        total = (self._blocks.incidence @ force).ravel() + self._weight
        if shape.normals is not None:
            still = np.zeros(self.nodes), np.zeros(3)
            total += shape.normals.force(shape.velocity, *still)[self.free].ravel()
        return np.asarray(total)

    def _load(self, shape: _Shape, load: FloatArray) -> FloatArray:
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

    def _wind(self, load: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gust at each node, shape (nodes,), and common wind, (3,), of a load."""
        own, common = np.split(load[3 * len(self.free) :], [len(self.free)])
        gust = np.zeros(self.nodes)
        gust[self.free] = own
        return gust, common

    def _air_damping(self, normals: Normals) -> FloatArray:
        return self._blocks.on_diagonal(normals.damping()[self.free])

    def _shape(self, x: FloatArray, u: FloatArray) -> _Shape:
        position, velocity = self.surface(x, u)
        offset = position[self._i] - position[self._j]
        length = np.maximum(np.sqrt(np.einsum('si,si->s', offset, offset)), SHORTEST)
        normals = None if self.air is None else self.air.at(position)
        rate = velocity[self._i] - velocity[self._j]
        return _Shape(offset, rate, length, velocity, normals)

    def _ends_of_driven(self) -> sparse.csr_array:
        """Offsets of the springs by the positions of the driven nodes, (3 springs, 3 driven)."""
        ends = np.zeros((len(self.springs.pairs), self.nodes))
        each = np.arange(len(ends))
        ends[each, self._i] += 1.0
        ends[each, self._j] -= 1.0
        return sparse.csr_array(sparse.kron(ends[:, self.driven], np.eye(3)))

    def _weighted(self, blocks: FloatArray) -> FloatArray:
        return np.asarray(blocks * self._inverse_mass[self._blocks.a][:, None])

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


@dataclass(frozen=True)
class _Shape:
    """Geometry of the springs: offsets [m] and their rates [m/s], (springs, 3), lengths [m].

    velocity [m/s] of all nodes, shape (nodes, 3); normals, where there is air.
    """

    offset: FloatArray
    offset_rate: FloatArray
    length: FloatArray
    velocity: FloatArray
    normals: Normals | None

    @cached_property
    def _unit(self) -> FloatArray:
        return self.offset / self.length[:, None]

    @cached_property
    def _outer(self) -> FloatArray:
        return (self._unit[:, :, None] * self._unit[:, None, :]).reshape(-1, 9)

    def stiffness(self, springs: Springs, clamp: bool) -> FloatArray:
        """One block k [(1 - r/l)(I - n n') + n n'] per spring, (springs, 9) (Gomes, eq. 3.20)."""
        geometric = 1.0 - springs.rest_length / self.length
        if clamp:
            geometric = np.maximum(geometric, 0.0)
        k = springs.stiffness_at(self.length)
        across = k * geometric
        blocks = self._outer * (k - across)[:, None]
        blocks[:, ::4] += across[:, None]
        return blocks

    def stiffness_change(self, springs: Springs, w: FloatArray) -> FloatArray:
        """Derivative of the clamped block times w, (springs, 3), by the offset, (springs, 9).

        Stretched: k r / l^2 [(n.w) T + n t' + t n'] with T = I - n n', t = T w; compressed, where
        the block is k n n': k / l [(n.w) T + n t'].
        """
        n = self._unit
        along = np.einsum('si,si->s', n, w)
        t = w - along[:, None] * n
        taut = self.length > springs.rest_length
        gain = springs.stiffness_at(self.length) / self.length
        gain = np.where(taut, gain * springs.rest_length / self.length, gain)
        blocks = n[:, :, None] * (t - along[:, None] * n)[:, None, :]
        blocks += (taut[:, None] * t)[:, :, None] * n[:, None, :]
        flat = blocks.reshape(-1, 9)
        flat[:, ::4] += along[:, None]
        return np.asarray(flat * gain[:, None])


@dataclass(frozen=True)
class _Linearised:
    """A surface at one state; see `types.Linearised`.

    velocity [m/s] of the free nodes and inner force [N] on them, each of shape (3 free,); load,
    shape (dim_load,).
    """

    model: MassSpring
    shape: _Shape
    velocity: FloatArray
    force: FloatArray
    load: FloatArray

    def solver(self, dt: float) -> Solver:
        """Solver of A = M - dt^2 K - dt D, by its Cholesky factor; b has shape (3 free, m).

        The geometric stiffness of a compressed spring is negative and can make the matrix
        indefinite: there it is left out (1 - r/l clamped at 0), which keeps the matrix positive
        definite for every state.
        """
        m, blocks = self.model, self.model._blocks
        stiffness = blocks.gather(self._clamped)
        matrix = m._mass_blocks - dt**2 * stiffness - dt * m._damping_blocks
        if self.shape.normals is not None:
            matrix -= dt * m._air_damping(self.shape.normals)
        return blocks.cholesky(matrix)

    def change(self, dt: float, solver: Solver, load: FloatArray | float = 0.0) -> FloatArray:
        """Change of the state in a step (Gomes 2016, eq. 3.32); the driven nodes move on in it.

        load: what comes to that of the input, shape (dim_load,).
        """
        m = self.model
        blocks = self._clamped.reshape(-1, 3, 3)
        resistance = np.einsum('sij,sj->si', blocks, self.shape.offset_rate)
        pulled = (m._blocks.incidence @ resistance).ravel()
        force = self.force + m._load(self.shape, self.load + load)
        faster = solver(dt * force - dt**2 * pulled)
        return np.concatenate([dt * (self.velocity + faster), faster])

    def tangent(
        self, dt: float, solver: Solver, change: FloatArray, load: FloatArray | float = 0.0
    ) -> MechanicalTangent:
        """Derivative of the step, through the change of the matrix with the state too."""
        m, n = self.model, 3 * len(self.model.free)
        faster = np.zeros((m.nodes, 3))
        faster[m.free] = change[n:].reshape(-1, 3)
        moved = dt * (self.shape.offset_rate + faster[m._i] - faster[m._j])
        slope = self.shape.stiffness(m.springs, clamp=False)
        slope += self.shape.stiffness_change(m.springs, moved)
        return MechanicalTangent(self, dt, solver, slope, self.air_slope(faster, load))

    def air_slope(self, faster: FloatArray | float, load: FloatArray | float) -> FloatArray | None:
        """Derivative of the air's force by the positions, (t, 3, 3, 9); None without air.

        It acts on the velocity after the step, which is higher by `faster` [m/s], (nodes, 3).
        """
        if self.shape.normals is None:
            return None
        wind = self.model._wind(self.load + load)
        return self.shape.normals.slope(self.shape.velocity + faster, *wind)

    @cached_property
    def _clamped(self) -> FloatArray:
        return self.shape.stiffness(self.model.springs, clamp=True)


class MechanicalTangent:
    """Derivative of the implicit step of a surface, through A y = M v + dt S p + dt F.

    S, shape (3 free, 3 free), is the derivative of the forces, the clamped ones over the step
    included, by the positions; y the velocity after the step. See `types.Tangent`.
    """

    def __init__(
        self,
        at: _Linearised,
        dt: float,
        solver: Solver,
        springs: FloatArray,
        air: FloatArray | None,
    ) -> None:
        """Take S of each spring, shape (springs, 9), and of the air, shape (t, 3, 3, 9)."""
        blocks = at.model._blocks
        self._at, self._dt, self._solver = at, dt, solver
        self._springs, self._air = springs, air
        slope = blocks.gather(springs)
        self._slope = blocks.matrix(slope if air is None else slope + blocks.of_triangles(air))
        self._mass = at.model._mass3[:, None]

    def push(self, columns: FloatArray, load: FloatArray | None = None) -> FloatArray:
        """Return F C, shape (dim_x, m), for changes of the load, (dim_load, m), as well."""
        n, dt = len(self._mass), self._dt
        position, velocity = columns[:n], columns[n:]
        pulled = self._slope @ position
        if load is not None:
            pulled += self._at.model._load(self._at.shape, load)
        after = self._solver(self._mass * velocity + dt * pulled)
        return np.concatenate([position + dt * after, after])

    def pull(self, rows: FloatArray) -> FloatArray:
        """Return W F, shape (m, dim_x)."""
        return self.pull_load(rows)[0]

    def sandwich(self, cov: FloatArray) -> FloatArray:
        """Return F P F' of a symmetric P."""
        return self.sandwiched(self.push(cov), self.push)

    def sandwiched(
        self, pushed: FloatArray, push: Callable[[FloatArray], FloatArray]
    ) -> FloatArray:
        """Columns of the positions and velocities of F P F', from F P, which may have more rows.

        Those of the velocities are pushed; a position moves on by dt times its velocity after the
        step, and so do the columns.
        """
        n = len(self._mass)
        velocity = push(pushed[n : 2 * n].T)
        return np.concatenate([pushed[:, :n] + self._dt * velocity, velocity], axis=1)

    def pull_load(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return W F and the derivative of W x by the load, shapes (m, dim_x), (m, dim_load)."""
        n, dt = len(self._mass), self._dt
        both = self._solver((rows[:, n:] + dt * rows[:, :n]).T)
        position = rows[:, :n] + dt * (self._slope.T @ both).T
        pulled = np.concatenate([position, (self._mass * both).T], axis=1)
        return pulled, dt * self._by_load(both.T)

    def drive(self, inputs: FloatArray) -> FloatArray:
        """Change of the state after the step with the driven nodes and the load."""
        after = self._solver(self._dt * self.pushed(inputs))
        return np.concatenate([self._dt * after, after])

    def pushed(self, inputs: FloatArray, held: bool = False) -> FloatArray:
        """Change of the force on the free nodes, (3 free, m), with inputs, (dim_u, m).

        The driven nodes move on over the step, or are held.
        """
        m, dt = self._at.model, 0.0 if held else self._dt
        size, columns = 3 * len(m.driven), inputs.shape[1]
        force = m._load(self._at.shape, inputs[2 * size :])
        if not size:
            return force
        position = inputs[:size]
        offset, rate = (
            (m._driven_ends @ part).reshape(-1, 3, columns)
            for part in (position, inputs[size : 2 * size])
        )
        clamped = self._at._clamped.reshape(-1, 3, 3)
        pull = self._springs.reshape(-1, 3, 3) @ offset
        pull += dt * clamped @ rate + m.springs.damping[:, None, None] * rate
        force = force - (m._blocks.incidence @ pull.reshape(len(pull), -1)).reshape(-1, columns)
        return np.asarray(force if self._air is None else force + self._turned(position))

    def _turned(self, driven: FloatArray) -> FloatArray:
        """Change of the air's force with the positions [m] of the driven nodes, (3 driven, m)."""
        m, columns = self._at.model, driven.shape[1]
        assert m.air is not None and self._air is not None  # noqa: PT018
        moved, force = np.zeros((2, m.nodes, 3, columns))
        moved[m.driven] = driven.reshape(-1, 3, columns)
        corner = moved[m.air.triangles].reshape(len(m.air.triangles), 9, columns)
        by_corner = self._air.reshape(-1, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
        turned = (by_corner @ corner).reshape(-1, 3, 3, columns)
        np.add.at(force, m.air.triangles, turned)
        return np.asarray(force[m.free]).reshape(-1, columns)

    def _by_load(self, rows: FloatArray) -> FloatArray:
        """Derivative by the load, (m, dim_load), from that by the forces, (m, 3 free)."""
        normals, free = self._at.shape.normals, self._at.model.free
        if normals is None:
            return rows
        along = np.einsum('mfi,fi->mf', rows.reshape(len(rows), -1, 3), normals.unit[free])
        along *= normals.air.share[free]
        return np.concatenate([rows, along, along @ normals.unit[free]], axis=1)
