"""Which nodes springs join, and how: grids and chains of any size, and meshes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cloth_predict.types import FloatArray, IntArray


@dataclass(frozen=True)
class Springs:
    """Springs with dampers; arrays of shape (springs,), `pairs` (springs, 2) node indices.

    stiffness k [N/m], damping d [N s/m], rest_length r [m]; one value may stand for all springs.
    compression: the share of k that a spring shorter than r has, from 1 (a spring) to 0 (a
    string); cloth between two nodes buckles rather than resist. Raises ValueError for values
    that are negative or not finite, and for no share.
    """

    pairs: IntArray
    stiffness: FloatArray
    damping: FloatArray
    rest_length: FloatArray
    compression: FloatArray | float = 1.0

    def __post_init__(self) -> None:
        for name in ('stiffness', 'damping', 'rest_length', 'compression'):
            values = np.broadcast_to(np.asarray(getattr(self, name), float), (len(self.pairs),))
            if not np.all(np.isfinite(values)) or np.any(values < 0):
                raise ValueError(f'{name} must be finite and not negative')
            object.__setattr__(self, name, values)
        if np.any(np.asarray(self.compression) > 1):
            raise ValueError('compression must lie between 0 and 1')

    def stiffness_at(self, length: FloatArray) -> FloatArray:
        """Stiffness [N/m] of springs of these lengths [m], both of shape (springs,)."""
        return np.where(length < self.rest_length, self.compression, 1.0) * self.stiffness


def grid_pairs(rows: int, cols: int) -> dict[str, IntArray]:
    """Node pairs of a rows x cols grid by spring family, each of shape (springs, 2).

    Structural: 4 neighbours; shear: 4 diagonals; flexion: 2 away along rows and columns
    (Gomes 2016, figure 3.1). A chain is a 1 x n grid.
    """
    return {
        'structural': _pairs(rows, cols, ((0, 1), (1, 0))),
        'shear': _pairs(rows, cols, ((1, 1), (1, -1))),
        'flexion': _pairs(rows, cols, ((0, 2), (2, 0))),
    }


def grid_springs(
    rows: int,
    cols: int,
    shape: FloatArray,
    stiffness: Mapping[str, float],
    damping: float,
    compression: float = 1.0,
) -> Springs:
    """Springs of a grid at rest in `shape` [m], shape (rows * cols, 3).

    stiffness [N/m] by spring family; damping [N s/m] of every spring that there is.
    """
    families = grid_pairs(rows, cols)
    pairs = np.concatenate(list(families.values()))
    rest_length = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)
    return mesh_springs(families, rest_length, stiffness, damping, compression)


def mesh_springs(
    families: Mapping[str, IntArray],
    rest_length: FloatArray,
    stiffness: Mapping[str, float],
    damping: float,
    compression: Mapping[str, float] | float = 1.0,
) -> Springs:
    """Springs of any mesh: node pairs by family, each of shape (springs, 2).

    A family without stiffness has no damper either, but for the structural one: neighbours may
    share their velocity alone, as the parts of a viscous body do.

    rest_length [m], shape (all springs,), of the families in turn; the others as in
    `grid_springs`, `compression` also by family.
    """
    pairs = np.concatenate(list(families.values()))
    share = (
        compression if isinstance(compression, Mapping) else dict.fromkeys(families, compression)
    )
    k, less = (
        np.concatenate([np.full(len(p), values[name]) for name, p in families.items()])
        for values in (stiffness, share)
    )
    damped = np.repeat(
        [stiffness[name] > 0 or name == 'structural' for name in families],
        [len(p) for p in families.values()],
    )
    return Springs(pairs, k, damping * damped, rest_length, less)


def _pairs(rows: int, cols: int, offsets: tuple[tuple[int, int], ...]) -> IntArray:
    """Pairs of each node with those `offsets` (down, right) away."""
    node = np.arange(rows * cols).reshape(rows, cols)
    found = []
    for down, right in offsets:
        start = node[: max(rows - down, 0), max(-right, 0) : max(cols - max(right, 0), 0)]
        end = node[down:, max(right, 0) : max(cols + min(right, 0), 0)]
        found.append(np.column_stack([start.ravel(), end.ravel()]))
    return np.concatenate(found).astype(np.int64)
