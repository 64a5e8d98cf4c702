"""The sparsity of a mass-spring surface, built once: from one 3x3 block per spring to matrices."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from cloth_predict.types import FloatArray, IntArray, Solver

MOST_DENSE = 240
"""Size up to which matrices are dense: LAPACK does not notice the zeros of so few numbers, while
each call of a sparse product costs some ten microseconds before it begins."""


class BlockStructure:
    """Where the 3x3 blocks of the springs stand; blocks are arrays of shape (blocks, 9).

    A block (a, b) is the change of the force on free node a with the motion of free node b.
    """

    def __init__(self, pairs: IntArray, free: IntArray, nodes: int, triangles: IntArray) -> None:
        """Number the blocks of springs `pairs`, shape (springs, 2), between the free nodes.

        triangles, shape (t, 3): nodes that act on each other beside the springs.
        """
        number = np.full(nodes, -1)
        number[free] = np.arange(len(free))
        i, j = number[pairs[:, 0]], number[pairs[:, 1]]
        self.free, self.size = len(free), 3 * len(free)
        each = np.arange(len(pairs))
        ends = np.concatenate([i[i >= 0], j[j >= 0]])
        spring = np.concatenate([each[i >= 0], each[j >= 0]])
        sign = np.repeat([1.0, -1.0], [(i >= 0).sum(), (j >= 0).sum()])
        self.dense = self.size <= MOST_DENSE
        incidence = sparse.csr_array((sign, (ends, spring)), shape=(len(free), len(pairs)))
        self.incidence = incidence.toarray() if self.dense else incidence
        """Adds the springs' forces up at the free nodes: + at the first end, - at the second."""
        # dF/dp of a spring is -B for the node's own motion and +B for that of its neighbour
        both = (i >= 0) & (j >= 0)
        corner = number[triangles]
        inside = (corner[:, :, None] >= 0) & (corner[:, None] >= 0)
        of, by = (
            np.broadcast_to(c, inside.shape)[inside] for c in (corner[:, :, None], corner[:, None])
        )
        a = np.concatenate([np.arange(len(free)), ends, i[both], j[both], of])
        b = np.concatenate([np.arange(len(free)), ends, j[both], i[both], by])
        keys, block = np.unique(a * len(free) + b, return_inverse=True)
        source = np.concatenate([spring, each[both], each[both]])
        weight = np.repeat([-1.0, 1.0], [len(ends), 2 * both.sum()])
        block, of_triangles = np.split(block[len(free) :], [len(source)])
        self._scatter = sparse.csr_array((weight, (block, source)), shape=(len(keys), len(pairs)))
        self._of_triangles = sparse.csr_array(
            (np.ones(len(of_triangles)), (of_triangles, np.flatnonzero(inside))),
            shape=(len(keys), inside.size),
        )
        self.a, self.b = keys // len(free), keys % len(free)
        self._indptr = np.searchsorted(self.a, np.arange(len(free) + 1))
        self._row, self._col = _scalars(self.a, self.b)
        self._flat = self._row * self.size + self._col
        self._build_band()
        self._build_state_matrix()

    def gather(self, springs: FloatArray) -> FloatArray:
        """Blocks, shape (blocks, m), from values of the springs, shape (springs, m)."""
        return np.asarray(self._scatter @ springs)

    def of_triangles(self, values: FloatArray) -> FloatArray:
        """Blocks from those of corner a by corner b of each triangle, shape (t, 3, 3, 9)."""
        return np.asarray(self._of_triangles @ values.reshape(-1, 9))

    def on_diagonal(self, values: FloatArray) -> FloatArray:
        """Blocks of a block diagonal matrix, from one block per free node, shape (free, 9)."""
        blocks = np.zeros((len(self.a), 9))
        blocks[self.a == self.b] = values
        return blocks

    def diagonal(self, values: FloatArray) -> FloatArray:
        """Blocks of a diagonal matrix with one value per free node."""
        return np.where(self.a == self.b, values[self.a], 0.0)[:, None] * np.eye(3).ravel()

    def matrix(self, blocks: FloatArray) -> FloatArray | sparse.bsr_array:
        """Matrix of shape (3 free, 3 free); dense where it is small."""
        if self.dense:
            matrix = np.zeros(self.size**2)
            matrix[self._flat] = blocks.ravel()
            return matrix.reshape(self.size, self.size)
        data = blocks.reshape(-1, 3, 3)
        return sparse.bsr_array((data, self.b, self._indptr), shape=(self.size, self.size))

    def state_matrix(self, jap: FloatArray, jav: FloatArray) -> sparse.csr_array:
        """Return [[0, I], [Jap, Jav]] (Gomes 2016, eq. 3.23) from blocks."""
        values = np.concatenate([np.ones(self.size), jap.ravel(), jav.ravel()])
        return sparse.csr_array(
            (values[self._csr_take], self._csr_indices, self._csr_indptr),
            shape=(2 * self.size, 2 * self.size),
        )

    def cholesky(self, blocks: FloatArray) -> Solver:
        """Solver of a symmetric positive definite matrix; b has shape (3 free, m).

        Raises FloatingPointError where the matrix is not positive definite.
        """
        if self.dense:
            factor, failed = lapack.dpotrf(self.matrix(blocks), lower=1, overwrite_a=1)
        else:
            band = np.zeros((self._bandwidth + 1, self.size), order='F')
            band[self._band_row, self._band_col] = blocks.ravel()[self._band_take]
            factor, failed = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        if failed:
            raise FloatingPointError('the implicit step has no positive definite matrix')
        if self.dense:
            return lambda b: np.asarray(lapack.dpotrs(factor, b, lower=1)[0])
        return BandSolver(factor, self._order)

    def _build_band(self) -> None:
        """Places of the lower triangle in LAPACK's band storage, nodes in Cuthill-McKee order."""
        shape = (self.free, self.free)
        graph = sparse.csr_array((np.ones(len(self.a)), (self.a, self.b)), shape=shape)
        order = np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)
        rank = np.empty(self.free, np.int64)
        rank[order] = np.arange(self.free)
        self._order = (3 * order[:, None] + np.arange(3)).ravel()
        row, col = _scalars(rank[self.a], rank[self.b])
        lower = row >= col
        self._band_take = np.flatnonzero(lower)
        self._band_col = col[lower]
        self._band_row = row[lower] - self._band_col
        self._bandwidth = int(self._band_row.max(initial=0))

    def _build_state_matrix(self) -> None:
        """CSR structure of [[0, I], [Jap, Jav]] and the order of its values."""
        identity, row, col = np.arange(self.size), self._row + self.size, self._col
        rows = np.concatenate([identity, row, row])
        cols = np.concatenate([identity + self.size, col, col + self.size])
        self._csr_take = np.lexsort((cols, rows))
        self._csr_indices = cols[self._csr_take]
        self._csr_indptr = np.searchsorted(rows[self._csr_take], np.arange(2 * self.size + 1))


class BandSolver:
    """Solver from the Cholesky factor L of a band matrix; b has shape (size,) or (size, m).

    LAPACK's own band solve works column by column; many columns at once go through L cut into
    dense blocks, where the work is in matrix products.
    """

    MOST_COLUMNS = 8
    """Number of columns up to which LAPACK's is faster."""

    def __init__(self, band: FloatArray, order: IntArray) -> None:
        """Take L as LAPACK stores a lower band, and the order of its rows in the matrix."""
        self._band, self._order = band, order

    def __call__(self, b: FloatArray) -> FloatArray:
        """Return y of L L' y = b."""
        y, ordered = np.empty_like(b), b[self._order]
        few = b.ndim == 1 or b.shape[1] <= self.MOST_COLUMNS
        y[self._order] = (
            lapack.dpbtrs(self._band, ordered, lower=1)[0] if few else self._blockwise(ordered)
        )
        return y

    def _blockwise(self, y: FloatArray) -> FloatArray:
        """Solve block by block, forwards with L and back with L'; writes into y, C-contiguous."""
        for here, below, diagonal, lower in self._pieces:
            _solve_rows(diagonal, y[here], transposed=False)
            y[below] -= lower @ y[here]
        for here, below, diagonal, lower in reversed(self._pieces):
            y[here] -= lower.T @ y[below]
            _solve_rows(diagonal, y[here], transposed=True)
        return y

    @cached_property
    def _pieces(self) -> list[tuple[slice, slice, FloatArray, FloatArray]]:
        """Rows of each block and of what lies below it, and L in both."""
        width, size = self._band.shape[0] - 1, self._band.shape[1]
        pieces = []
        for start in range(0, size, max(width, 1)):
            end = min(start + max(width, 1), size)
            last = min(end + width, size)
            row, col = np.arange(start, last)[:, None], np.arange(start, end)
            away = row - col
            inside = (away >= 0) & (away <= width)
            block = np.where(inside, self._band[np.clip(away, 0, width), col], 0.0)
            part = slice(start, end), slice(end, last)
            pieces.append((*part, np.asfortranarray(block[: end - start]), block[end - start :]))
        return pieces


def _solve_rows(lower: FloatArray, y: FloatArray, transposed: bool) -> None:
    """Replace y by L^-1 y, or by L'^-1 y; as y' L' or y' L, since y' is Fortran-contiguous."""
    blas.dtrsm(1.0, lower, y.T, side=1, lower=1, trans_a=int(not transposed), overwrite_b=1)


def _scalars(a: IntArray, b: IntArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the scalars of 3x3 blocks (a, b), each of shape (9 blocks,)."""
    axis, shape = np.arange(3), (len(a), 3, 3)
    row = np.broadcast_to(3 * a[:, None, None] + axis[:, None], shape)
    return row.ravel(), np.broadcast_to(3 * b[:, None, None] + axis, shape).ravel()
