"""Mass-spring-damper surface: grid, chain or any mesh (Provot's cloth; Gomes 2016, chapter 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from cloth_predict.types import FloatArray, IntArray, Solver

GRAVITY = (0.0, -9.81, 0.0)
"""Default gravity [m/s^2], Y up (Gomes 2016, below eq. 3.5)."""

SHORTEST = 1e-9
"""Length [m] under which a spring is taken to have this length, so that its direction exists."""


@dataclass(frozen=True)
class Springs:
    """Springs with dampers; arrays of shape (springs,), `pairs` (springs, 2) node indices.

    stiffness k [N/m], damping d [N s/m], rest_length r [m].
    """

    pairs: IntArray
    stiffness: FloatArray
    damping: FloatArray
    rest_length: FloatArray

    def __post_init__(self) -> None:
        count = len(self.pairs)
        for name in ('stiffness', 'damping', 'rest_length'):
            values = np.broadcast_to(np.asarray(getattr(self, name), float), (count,))
            if not np.all(np.isfinite(values)) or np.any(values < 0):
                raise ValueError(f'{name} must be finite and not negative')
            object.__setattr__(self, name, values)


def grid_pairs(rows: int, cols: int) -> dict[str, IntArray]:
    """Node pairs of a rows x cols grid by spring family, each of shape (springs, 2).

    Structural: 4 neighbours; shear: 4 diagonals; flexion: 2 away along rows and columns
    (Gomes 2016, figure 3.1). A chain is a 1 x n grid.
    """
    node = np.arange(rows * cols).reshape(rows, cols)

    def pairs(*offsets: tuple[int, int]) -> IntArray:
        found = []
        for down, right in offsets:
            start = node[: max(rows - down, 0), max(-right, 0) : max(cols - max(right, 0), 0)]
            end = node[down:, max(right, 0) : max(cols + min(right, 0), 0)]
            found.append(np.column_stack([start.ravel(), end.ravel()]))
        return np.concatenate(found).astype(np.int64)

    return {
        'structural': pairs((0, 1), (1, 0)),
        'shear': pairs((1, 1), (1, -1)),
        'flexion': pairs((0, 2), (2, 0)),
    }


class MassSpring:
    """Point masses joined by springs and dampers; some nodes may be driven.

    State `x = [p; v]` of the free nodes, shape (6 free,). Input `u`: positions and velocities of the
    driven nodes, then an external force [N] on each free node, shape (6 driven + 3 free,); `input`
    packs it. The sparsity is built once; each call computes values only.
    """

    def __init__(
        self,
        springs: Springs,
        mass: FloatArray,
        driven: IntArray | list[int] = (),  # type: ignore[assignment]
        gravity: FloatArray | tuple[float, float, float] = GRAVITY,
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
        if np.any(self.mass <= 0) or not np.all(np.isfinite(self.mass)):
            raise ValueError('mass must be finite and positive')
        if self.driven.size and not 0 <= self.driven[0] <= self.driven[-1] < self.nodes:
            raise ValueError(f'driven nodes must lie between 0 and {self.nodes - 1}')
        if springs.pairs.size and not 0 <= springs.pairs.min() <= springs.pairs.max() < self.nodes:
            raise ValueError(f'springs must join nodes between 0 and {self.nodes - 1}')
        self.free = np.setdiff1d(np.arange(self.nodes), self.driven)
        self._build()

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
        n, size = len(self.free), 3 * len(self.driven)
        u = np.zeros(self.dim_u)
        if position is not None:
            u[:size] = np.reshape(position, -1)
        if velocity is not None:
            u[size : 2 * size] = np.reshape(velocity, -1)
        if force is not None:
            u[2 * size :] = np.reshape(force, 3 * n)
        return u

    def surface(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions [m] and velocities [m/s] of all nodes, each of shape (nodes, 3)."""
        n, size = 3 * len(self.free), 3 * len(self.driven)
        if not size:
            return x[:n].reshape(-1, 3), x[n : 2 * n].reshape(-1, 3)
        position, velocity = np.empty((self.nodes, 3)), np.empty((self.nodes, 3))
        position[self.free], velocity[self.free] = x[: 2 * n].reshape(2, -1, 3)
        position[self.driven], velocity[self.driven] = u[: 2 * size].reshape(2, -1, 3)
        return position, velocity

    def acceleration(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Accelerations of the free nodes [m/s^2], shape (free, 3) (Gomes 2016, eq. 3.5, 3.7)."""
        position, velocity = self.surface(x, u)
        s = self.springs
        offset = position[self._i] - position[self._j]
        length = self._length(offset)
        force = (-s.stiffness * (1.0 - s.rest_length / length))[:, None] * offset
        force -= s.damping[:, None] * (velocity[self._i] - velocity[self._j])
        total = self._incidence @ force + u[6 * len(self.driven) :].reshape(-1, 3)
        return total * self._inverse_mass[:, None] + self.gravity

    def f(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Time derivative of the state, shape (6 free,) (Gomes 2016, eq. 3.4)."""
        n = 3 * len(self.free)
        return np.concatenate([x[n:], self.acceleration(x, u).ravel()])

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Derivative of f with respect to x (Gomes 2016, eq. 3.23), with M^-1 in both halves."""
        stiffness = self._stiffness(x, u, clamp=False)
        return self._state_matrix(1.0, self._weighted(stiffness), self._jav)

    def jac_force(self) -> sparse.csr_array:
        """Derivative of f with respect to a force on each free node, shape (6 free, 3 free)."""
        n = 3 * len(self.free)
        gain = sparse.diags_array(np.repeat(self._inverse_mass, 3))
        return sparse.csr_array(sparse.vstack([sparse.csr_array((n, n)), gain]))

    def factorise(self, x: FloatArray, u: FloatArray, dt: float) -> Solver:
        """Solver of an implicit step: (3.32) multiplied by the masses, by banded Cholesky.

        The geometric stiffness of a compressed spring is negative and can make the matrix
        indefinite: there it is left out (1 - r/l clamped at 0), which keeps the matrix positive
        definite for every state.
        """
        n = 3 * len(self.free)
        stiffness = self._stiffness(x, u, clamp=True)
        blocks = self._mass_blocks - dt**2 * stiffness - dt * self._damping_blocks
        band = np.zeros((self._bandwidth + 1, n))
        band[self._band_row, self._band_col] = blocks.ravel()[self._band_take]
        factor, failed = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        if failed:
            raise FloatingPointError('the implicit step has no positive definite matrix')
        force_jac = self._block_matrix(stiffness)
        mass = np.repeat(self.mass[self.free], 3)

        def solve(b: FloatArray) -> FloatArray:
            columns = b.reshape(2 * n, -1)
            momentum = mass[:, None] * columns[n:] + dt * (force_jac @ columns[:n])
            permuted, _ = lapack.dpbtrs(factor, momentum[self._order], lower=1, overwrite_b=1)
            y = np.empty_like(columns)
            y[n + self._order] = permuted
            y[:n] = columns[:n] + dt * y[n:]
            return y.reshape(b.shape)

        return solve

    def solve_jac_derivative(
        self, x: FloatArray, u: FloatArray, w: FloatArray
    ) -> sparse.csr_array:
        """Derivative of J~(x) w for a fixed w: the second derivative of the spring forces along w."""
        position, _ = self.surface(x, u)
        change = np.zeros((self.nodes, 3))
        change[self.free] = w[: 3 * len(self.free)].reshape(-1, 3)
        s = self.springs
        offset = position[self._i] - position[self._j]
        length = self._length(offset)
        n = offset / length[:, None]
        d = change[self._i] - change[self._j]
        along = np.einsum('si,si->s', n, d)
        across = d - along[:, None] * n
        projector = np.eye(3) - n[:, :, None] * n[:, None, :]
        turn = along[:, None, None] * projector + n[:, :, None] * across[:, None, :]
        stretched = turn + across[:, :, None] * n[:, None, :]
        slack = (length <= s.rest_length)[:, None, None]
        gain = np.where(length <= s.rest_length, 1.0, s.rest_length / length) / length
        blocks = (s.stiffness * gain)[:, None, None] * np.where(slack, turn, stretched)
        scattered = self._scatter @ blocks.reshape(-1, 9)
        return self._state_matrix(0.0, self._weighted(scattered), np.zeros_like(self._jav))

    def _build(self) -> None:
        """Index arrays that turn one 3x3 block per spring into every matrix of this class."""
        s, nodes = self.springs, self.nodes
        self._i, self._j = s.pairs[:, 0], s.pairs[:, 1]
        free = len(self.free)
        number = np.full(nodes, -1)
        number[self.free] = np.arange(free)
        i, j = number[self._i], number[self._j]
        self._inverse_mass = 1.0 / self.mass[self.free]
        each = np.arange(len(s.pairs))
        rows = np.concatenate([i[i >= 0], j[j >= 0]])
        cols = np.concatenate([each[i >= 0], each[j >= 0]])
        sign = np.concatenate([np.ones((i >= 0).sum()), -np.ones((j >= 0).sum())])
        self._incidence = sparse.csr_array((sign, (rows, cols)), shape=(free, len(s.pairs)))
        # Blocks (a, b): the force on a changes by -B for its own motion and +B for its neighbour's.
        both = (i >= 0) & (j >= 0)
        a = np.concatenate([np.arange(free), i[i >= 0], j[j >= 0], i[both], j[both]])
        b = np.concatenate([np.arange(free), i[i >= 0], j[j >= 0], j[both], i[both]])
        source = np.concatenate(
            [np.full(free, -1), each[i >= 0], each[j >= 0], each[both], each[both]]
        )
        weight = np.concatenate([np.zeros(free), -np.ones(len(rows)), np.ones(2 * both.sum())])
        keys, block = np.unique(a * free + b, return_inverse=True)
        used = source >= 0
        self._scatter = sparse.csr_array(
            (weight[used], (block[used], source[used])), shape=(len(keys), len(s.pairs))
        )
        self._a, self._b = keys // free, keys % free
        self._indptr = np.searchsorted(self._a, np.arange(free + 1))
        identity = np.eye(3).ravel()
        self._mass_blocks = np.where(self._a == self._b, self.mass[self.free][self._a], 0.0)[
            :, None
        ] * identity
        self._damping_blocks = (self._scatter @ s.damping)[:, None] * identity
        self._jav = self._weighted(self._damping_blocks)
        self._build_band(free)
        self._build_state_matrix(3 * free)

    def _build_band(self, free: int) -> None:
        graph = sparse.csr_array((np.ones(len(self._a)), (self._a, self._b)), shape=(free, free))
        order = np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)
        rank = np.empty(free, np.int64)
        rank[order] = np.arange(free)
        self._order = (3 * order[:, None] + np.arange(3)).ravel()
        axis = np.arange(3)
        row = np.broadcast_to(3 * rank[self._a][:, None, None] + axis[:, None], (len(self._a), 3, 3))
        col = np.broadcast_to(3 * rank[self._b][:, None, None] + axis, (len(self._a), 3, 3))
        lower = (row >= col).ravel()
        self._band_take = np.flatnonzero(lower)
        self._band_col = col.ravel()[lower]
        self._band_row = row.ravel()[lower] - self._band_col
        self._bandwidth = int(self._band_row.max(initial=0))

    def _build_state_matrix(self, size: int) -> None:
        """CSR structure of [[0, I], [Jap, Jav]] and the order of its values."""
        axis = np.arange(3)
        shape = (len(self._a), 3, 3)
        row = np.broadcast_to(3 * self._a[:, None, None] + axis[:, None], shape).ravel() + size
        col = np.broadcast_to(3 * self._b[:, None, None] + axis, shape).ravel()
        rows = np.concatenate([np.arange(size), row, row])
        cols = np.concatenate([np.arange(size) + size, col, col + size])
        self._csr_take = np.lexsort((cols, rows))
        self._csr_indices = cols[self._csr_take]
        self._csr_indptr = np.searchsorted(rows[self._csr_take], np.arange(2 * size + 1))

    def _stiffness(self, x: FloatArray, u: FloatArray, clamp: bool) -> FloatArray:
        """Blocks of dF/dp, shape (blocks, 9), from one block per spring (Gomes 2016, eq. 3.20)."""
        position, _ = self.surface(x, u)
        s = self.springs
        offset = position[self._i] - position[self._j]
        length = self._length(offset)
        geometric = 1.0 - s.rest_length / length
        if clamp:
            geometric = np.maximum(geometric, 0.0)
        n = offset / length[:, None]
        blocks = (s.stiffness * (1.0 - geometric))[:, None, None] * (n[:, :, None] * n[:, None, :])
        blocks[:, (0, 1, 2), (0, 1, 2)] += (s.stiffness * geometric)[:, None]
        return np.asarray(self._scatter @ blocks.reshape(-1, 9))

    def _weighted(self, blocks: FloatArray) -> FloatArray:
        return blocks * self._inverse_mass[self._a][:, None]

    def _block_matrix(self, blocks: FloatArray) -> sparse.bsr_array:
        size = 3 * len(self.free)
        data = blocks.reshape(-1, 3, 3)
        return sparse.bsr_array((data, self._b, self._indptr), shape=(size, size))

    def _state_matrix(self, kinematic: float, jap: FloatArray, jav: FloatArray) -> sparse.csr_array:
        """Return [[0, kinematic I], [Jap, Jav]] (Gomes 2016, eq. 3.23) from blocks."""
        size = 3 * len(self.free)
        values = np.concatenate([np.full(size, kinematic), jap.ravel(), jav.ravel()])
        return sparse.csr_array(
            (values[self._csr_take], self._csr_indices, self._csr_indptr),
            shape=(2 * size, 2 * size),
        )

    @staticmethod
    def _length(offset: FloatArray) -> FloatArray:
        return np.maximum(np.sqrt(np.einsum('si,si->s', offset, offset)), SHORTEST)
