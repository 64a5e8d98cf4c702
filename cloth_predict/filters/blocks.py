"""A Gaussian belief of a body without most correlations, and which of them are left."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from cloth_predict.models.superquadric import GLOBAL, LOCAL, ROTATION, TRANSLATION, Superquadric
from cloth_predict.types import BoolArray, FloatArray, IntArray, read_only

Coupling = Literal['parts', 'pose']
NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Which states are correlated with which.

    shared, shape (g,): states that belong to no single node; coupled, shape (g, g): which of them
    with which; own, shape (nodes, m): the states of each node, correlated among themselves.
    """

    dim_x: int
    shared: IntArray
    coupled: BoolArray
    own: IntArray

    @classmethod
    def of_body(cls, body: Superquadric, coupling: Coupling, pushed: IntArray = NONE) -> Blocks:
        """Blocks for x = [q; q'; a], a being accelerations (and their rates) of coordinates.

        `pushed` says of which coordinate each of them is. `parts`: translation, rotation and
        global deformation, each by itself (Metaxas & Terzopoulos 1993, V.C); `pose`: these
        together. Displacements that stay are in no block.
        """
        part = _parts() if coupling == 'parts' else np.zeros(LOCAL, np.int64)
        groups = np.arange(LOCAL), body.dim_q + np.arange(LOCAL)
        shared = np.concatenate([*groups, body.dim_x + np.arange(len(pushed))])
        part = np.concatenate([part, part, part[pushed]])
        coupled = part[:, None] == part
        displacement = _displacements(body)
        own = np.hstack([displacement, body.dim_q + displacement])
        return cls(body.dim_x + len(pushed), shared, coupled, own)

    @classmethod
    def of_coordinates(cls, body: Superquadric) -> Blocks:
        """Blocks for x = q, of a motion without inertia, as `parts` has them."""
        part = _parts()
        coupled = part[:, None] == part
        return cls(body.dim_q, np.arange(LOCAL), coupled, _displacements(body))

    @classmethod
    def whole(cls, dim_x: int) -> Blocks:
        """One block of all states."""
        return cls(
            dim_x, np.arange(dim_x), np.ones((dim_x, dim_x), bool), np.zeros((0, 6), np.int64)
        )

    def of(self, mean: FloatArray, cov: FloatArray) -> BlockGaussian:
        """Belief nearest to a Gaussian: its blocks, of a covariance of shape (dim_x, dim_x)."""
        shared = cov[self.shared[:, None], self.shared]
        return self.belief(mean, shared, cov[self.own[:, :, None], self.own[:, None]])

    def belief(self, mean: FloatArray, shared: FloatArray, own: FloatArray) -> BlockGaussian:
        """Belief of these covariances, (g, g) and (nodes, m, m), without what is not coupled."""
        return BlockGaussian(mean, np.where(self.coupled, shared, 0.0), own, self)

    def diagonal(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values of the states, (dim_x,), as diagonals of the blocks, (g, g) and (nodes, m, m)."""
        own = values[self.own]
        return np.diag(values[self.shared]), own[:, :, None] * np.eye(own.shape[1])

    @cached_property
    def places(self) -> tuple[IntArray, IntArray, IntArray]:
        """Of each state: its block, the start of its row among all blocks' entries, its column.

        A state in no block is one by itself, whose entry is the last, after those of all blocks.
        """
        block, place = -1 - np.arange(self.dim_x), np.zeros(self.dim_x, np.int64)
        size, width = len(self.shared), self.own.shape[1]
        start = np.full(self.dim_x, size**2 + width * self.own.size)
        block[self.shared], place[self.shared] = 0, np.arange(size)
        start[self.shared] = size * np.arange(size)
        block[self.own] = 1 + np.arange(len(self.own))[:, None]
        place[self.own] = np.arange(width)
        start[self.own] = size**2 + width * np.arange(self.own.size).reshape(self.own.shape)
        return block, start, place


def _parts() -> IntArray:
    """To which of translation, rotation and global deformation a coordinate belongs, (18,)."""
    part = np.empty(LOCAL, np.int64)
    for k, rows in enumerate((TRANSLATION, ROTATION, GLOBAL)):
        part[rows] = k
    return part


def _displacements(body: Superquadric) -> IntArray:
    """Where each node's displacement is in q, shape (nodes, 3); none where they stay."""
    nodes = body.nodes if body.moving[LOCAL:].any() else 0
    return LOCAL + np.arange(3 * nodes).reshape(-1, 3)


@dataclass(frozen=True)
class BlockGaussian:
    """Mean, shape (dim_x,), and covariances of the blocks, (g, g) and (nodes, m, m)."""

    mean: FloatArray
    shared: FloatArray
    own: FloatArray
    blocks: Blocks

    def __post_init__(self) -> None:
        for name in ('mean', 'shared', 'own'):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def marginals(self, rows: IntArray) -> FloatArray:
        """Covariances of k groups of m states each, rows of shape (k, m), shape (k, m, m)."""
        block, start, place = self.blocks.places
        left, right = rows[:, :, None], rows[:, None]
        values = np.concatenate([self.shared.ravel(), self.own.ravel(), [0.0]])
        at = np.where(block[left] == block[right], start[left] + place[right], len(values) - 1)
        return np.asarray(values[at])

    def moved_to(self, mean: FloatArray) -> BlockGaussian:
        """The same with another mean."""
        return replace(self, mean=mean)
