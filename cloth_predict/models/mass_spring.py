"""Mass-spring-damper surface: grid, chain or any mesh (Provot's cloth; Gomes 2016, chapter 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

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
    the driven nodes, then an external force [N] on each free node, shape (6 driven + 3 free,);
    `input` packs it. The sparsity is built once; each call computes values only.
    """

    def __init__(
        self,
        springs: Springs,
        mass: FloatArray,
        driven: IntArray | Sequence[int] = (),
        gravity: FloatArray | Sequence[float] = GRAVITY,
    ) -> None:
        """Build the structure.

        mass [kg], shape (nodes,); driven, indices of the nodes that the input moves;
        gravity [m/s^2], shape (3,). Raises ValueError for values outside their range.
        """
        self.springs = springs
        self.mass = np.asarray(mass, float)
        self.gravity = np.asarray(gravity, float)
        self.nodes = len(self.mass)
        self.driven = np.unique(np.asarray(driven, np.int64))
        self._check()
        self.free = np.setdiff1d(np.arange(self.nodes), self.driven)
        self._i, self._j = springs.pairs[:, 0], springs.pairs[:, 1]
        self._inverse_mass = 1.0 / self.mass[self.free]
        self._blocks = BlockStructure(springs.pairs, self.free, self.nodes)
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
        """Number of inputs, 6 per driven node and 3 per free node."""
        return 6 * len(self.driven) + 3 * len(self.free)

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
            u[2 * size :] = np.reshape(force, 3 * len(self.free))
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
        stiffness = self._blocks.gather(self._shape(x, u).stiffness(self.springs, clamp=False))
        return self._blocks.state_matrix(self._weighted(stiffness), self._jav)

    def input_after(self, u: FloatArray, dt: float) -> FloatArray:
        """Input dt [s] later: the driven nodes go on with their velocities."""
        size = 3 * len(self.driven)
        after = u.copy()
        after[:size] += dt * u[size : 2 * size]
        return after

    def jac_force(self) -> sparse.csr_array:
        """Derivative of f with respect to a force on each free node, shape (6 free, 3 free)."""
        n = 3 * len(self.free)
        gain = sparse.diags(np.repeat(self._inverse_mass, 3))
        return sparse.csr_array(sparse.vstack([sparse.csr_array((n, n)), gain]))

    def linearise(self, x: FloatArray, u: FloatArray) -> _Linearised:
        """Return what an implicit step needs at x, from one look at the geometry."""
        shape = self._shape(x, u)
        size = 3 * len(self.driven)
        driven = u[size : 2 * size].reshape(-1, 3)
        return _Linearised(self, shape, self._f(x, u, shape), driven)

    def _f(self, x: FloatArray, u: FloatArray, shape: _Shape) -> FloatArray:
        s, n = self.springs, 3 * len(self.free)
        pull = -s.stiffness_at(shape.length) * (1.0 - s.rest_length / shape.length)
        force = pull[:, None] * shape.offset - s.damping[:, None] * shape.offset_rate
        total = self._blocks.incidence @ force + u[6 * len(self.driven) :].reshape(-1, 3)
        return np.concatenate(
            [x[n:], (total * self._inverse_mass[:, None] + self.gravity).ravel()]
        )

    def _shape(self, x: FloatArray, u: FloatArray) -> _Shape:
        position, velocity = self.surface(x, u)
        offset = position[self._i] - position[self._j]
        length = np.maximum(np.sqrt(np.einsum('si,si->s', offset, offset)), SHORTEST)
        return _Shape(offset, velocity[self._i] - velocity[self._j], length)

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
    """Geometry of the springs: offsets [m] and their rates [m/s], (springs, 3), lengths [m]."""

    offset: FloatArray
    offset_rate: FloatArray
    length: FloatArray

    def stiffness(self, springs: Springs, clamp: bool) -> FloatArray:
        """One block k [(1 - r/l)(I - n n') + n n'] per spring, (springs, 9) (Gomes, eq. 3.20)."""
        geometric = 1.0 - springs.rest_length / self.length
        if clamp:
            geometric = np.maximum(geometric, 0.0)
        k = springs.stiffness_at(self.length)
        across = k * geometric
        scaled = self.offset * ((k - across) / self.length**2)[:, None]
        blocks = (scaled[:, :, None] * self.offset[:, None, :]).reshape(-1, 9)
        blocks[:, ::4] += across[:, None]
        return blocks

    def resistance(self, springs: Springs, change: FloatArray) -> FloatArray:
        """Force [N] of the clamped blocks against a change of offsets [m], both (springs, 3)."""
        blocks = self.stiffness(springs, clamp=True).reshape(-1, 3, 3)
        return np.asarray(-np.einsum('sij,sj->si', blocks, change))

    def stiffness_change(self, springs: Springs, w: FloatArray) -> FloatArray:
        """Derivative of the clamped block times w, (springs, 3), by the offset, (springs, 9).

        Stretched: k r / l^2 [(n.w) T + n t' + t n'] with T = I - n n', t = T w; compressed, where
        the block is k n n': k / l [(n.w) T + n t'].
        """
        n = self.offset / self.length[:, None]
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
    """A surface at one state; see `types.Linearised`."""

    model: MassSpring
    shape: _Shape
    slope: FloatArray
    driven_velocity: FloatArray

    def increment(self, dt: float) -> FloatArray:
        """Return dt (f + dt df/du u'): the driven nodes move on within the step."""
        if not self.driven_velocity.any():
            return dt * self.slope
        m, n = self.model, 3 * len(self.model.free)
        force = self.shape.resistance(m.springs, self._spring_change(np.zeros(n), dt))
        increment = dt * self.slope
        pulled = (m._blocks.incidence @ force) * m._inverse_mass[:, None]
        increment[n:] += dt * pulled.ravel()
        return increment

    def _spring_change(self, w: FloatArray, dt: float) -> FloatArray:
        """Change of the offsets [m], (springs, 3), in a step that changes the state by w."""
        m = self.model
        change = np.zeros((m.nodes, 3))
        change[m.free] = w[: 3 * len(m.free)].reshape(-1, 3)
        change[m.driven] = dt * self.driven_velocity
        return change[m._i] - change[m._j]

    def solver(self, dt: float) -> _StepSolver:
        """Solver of an implicit step: (3.32) multiplied by the masses, by a Cholesky factor.

        The geometric stiffness of a compressed spring is negative and can make the matrix
        indefinite: there it is left out (1 - r/l clamped at 0), which keeps the matrix positive
        definite for every state.
        """
        m, blocks = self.model, self.model._blocks
        stiffness = blocks.gather(self.shape.stiffness(m.springs, clamp=True))
        matrix = m._mass_blocks - dt**2 * stiffness - dt * m._damping_blocks
        mass = np.repeat(m.mass[m.free], 3)[:, None]
        return _StepSolver(dt, mass, blocks.matrix(stiffness), blocks.cholesky(matrix))

    def step_slope(self, w: FloatArray, dt: float) -> sparse.csr_array:
        """J(x) and the derivative of J~(x) w for a fixed w, added up, shape (dim_x, dim_x)."""
        m, blocks = self.model, self.model._blocks
        springs = self.shape.stiffness(m.springs, clamp=False)
        springs += self.shape.stiffness_change(m.springs, self._spring_change(w, dt))
        return blocks.state_matrix(m._weighted(blocks.gather(springs)), m._jav)


@dataclass(frozen=True)
class _StepSolver:
    """Solves with N = [[I, -dt I], [-dt M^-1 K, I - dt M^-1 D]] through A = M - dt^2 K - dt D.

    mass [kg], shape (3 free, 1); stiffness K, the derivative of the forces by the positions;
    solve, with A.
    """

    dt: float
    mass: FloatArray
    stiffness: sparse.bsr_array
    solve: Solver

    def __call__(self, b: FloatArray) -> FloatArray:
        n = len(self.mass)
        columns = b.reshape(2 * n, -1)
        y = np.empty_like(columns)
        y[n:] = self.solve(self.mass * columns[n:] + self.dt * (self.stiffness @ columns[:n]))
        y[:n] = columns[:n] + self.dt * y[n:]
        return y.reshape(b.shape)

    def transposed(self, b: FloatArray) -> FloatArray:
        """Return y of N' y = b, shape (6 free, m); K and A are symmetric."""
        n = len(self.mass)
        both = self.solve(b[n:] + self.dt * b[:n])
        return np.concatenate([b[:n] + self.dt * (self.stiffness @ both), self.mass * both])
