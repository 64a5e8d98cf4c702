"""Which nodes are joined: grids, lists of edges, and triangulations of a measured surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import Delaunay, QhullError

from cloth_predict.errors import FrameError
from cloth_predict.models.springs import grid_pairs
from cloth_predict.types import FloatArray, IntArray

LONGEST_EDGE = 3.0
"""Edge of a triangulation, by the median edge, from which on it only spans a gap of the hull."""
FLAT = 1e-6
"""Width by length from which on points lie on a line."""
NO_TRIANGLES = np.zeros((0, 3), np.int64)


@dataclass(frozen=True)
class Topology:
    """Node pairs by spring family, each of shape (springs, 2), and triangles, shape (t, 3).

    The families are `structural`, `shear` and `flexion`, in this order, as `Springs` has them.
    """

    families: Mapping[str, IntArray]
    triangles: IntArray

    @property
    def edges(self) -> IntArray:
        """Neighbours: the pairs that structural springs join, shape (edges, 2)."""
        return self.families['structural']

    @property
    def pairs(self) -> IntArray:
        """Pairs of all families in turn, shape (springs, 2)."""
        return np.concatenate(list(self.families.values()))


def grid(rows: int, cols: int) -> Topology:
    """Join a grid; a chain is one row."""
    return Topology(grid_pairs(rows, cols), grid_triangles(rows, cols))


def grid_triangles(rows: int, cols: int) -> IntArray:
    """Two triangles per cell of a grid, shape (2 cells, 3)."""
    node = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]
    return np.stack([a, c, b, b, c, d], axis=-1).reshape(-1, 3).astype(np.int64)


def of_edges(nodes: int, edges: IntArray) -> Topology:
    """Join these pairs, shape (edges, 2); what is two edges apart resists bending."""
    joined = adjacency(nodes, edges)
    two = sparse.triu(joined @ joined, k=1) > 0
    apart = sparse.coo_array(two.astype(int) - two.multiply(joined > 0).astype(int))
    apart.eliminate_zeros()
    return _mesh(edges, np.column_stack([apart.row, apart.col]), NO_TRIANGLES)


def delaunay(points: FloatArray) -> Topology:
    """Triangulate a surface [m], shape (nodes, 3).

    It is laid flat by projection onto its best plane or, where that parts neighbours, as of a
    tube, unrolled round an axis. Edges longer than three times the median are left out, as they
    only span gaps of the hull, except those without which a node would be alone. Opposite corners
    of two triangles with a common edge resist bending. Raises FrameError where the points do not
    span a surface.
    """
    triangles = _triangulated(points)
    sides = sides_of(triangles)
    edges = np.unique(sides.reshape(-1, 2), axis=0)
    length = _lengths(points, edges)
    # the shortest tree through all points keeps what is left together
    joined = adjacency(len(points), edges, length).toarray()
    tree = minimum_spanning_tree(joined).toarray()  # SciPy 1.11 takes no 64-bit indices
    needed = (tree + tree.T)[edges[:, 0], edges[:, 1]] > 0
    kept = edges[(length <= LONGEST_EDGE * np.median(length)) | needed]
    number = np.full((len(points),) * 2, -1)
    number[kept[:, 0], kept[:, 1]] = np.arange(len(kept))
    of_triangle = number[sides[..., 0], sides[..., 1]]
    whole = (of_triangle >= 0).all(axis=1)
    opposite = _opposite(triangles[whole], of_triangle[whole])
    apart = number[opposite[:, 0], opposite[:, 1]] < 0  # round a node with three neighbours
    return _mesh(kept, opposite[apart], triangles[whole])


def adjacency(nodes: int, edges: IntArray, weight: FloatArray | float = 1.0) -> sparse.csr_array:
    """Symmetric matrix with the weights of the edges, shape (nodes, nodes)."""
    values = np.broadcast_to(weight, len(edges))
    half = sparse.csr_array((values, tuple(edges.T)), shape=(nodes, nodes))
    return sparse.csr_array(half + half.T)


def _mesh(edges: IntArray, flexion: IntArray, triangles: IntArray) -> Topology:
    none = np.zeros((0, 2), np.int64)
    families = {'structural': edges, 'shear': none, 'flexion': flexion}
    return Topology({name: pairs.astype(np.int64) for name, pairs in families.items()}, triangles)


def sides_of(triangles: IntArray) -> IntArray:
    """Edges from corner k to k + 1 of triangles, the lower node first, shape (t, 3, 2)."""
    return np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)


def _lengths(points: FloatArray, edges: IntArray) -> FloatArray:
    return np.asarray(np.linalg.norm(points[edges[..., 0]] - points[edges[..., 1]], axis=-1))


def _triangulated(points: FloatArray) -> IntArray:
    """Triangles, shape (t, 3), of the points [m] laid flat in the way that parts no neighbours.

    The shortest tree through all points joins neighbours on any surface that is seen densely
    enough: the layout is taken whose triangulation lacks the fewest edges of it, the plane first.
    """
    centred = points - points.mean(axis=0)
    own = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    if len(points) < 3 or np.ptp(own[:, 1]) <= FLAT * np.ptp(own[:, 0]):
        raise FrameError(f'{len(points)} markers cannot be triangulated: they lie on a line')
    tree = minimum_spanning_tree(np.linalg.norm(points[:, None] - points, axis=2))
    neighbours = np.sort(np.column_stack(tree.nonzero()), axis=1)
    best, fewest, side = NO_TRIANGLES, np.inf, np.inf
    ways: list[Callable[[FloatArray], IntArray]] = [_in_plane]
    for lay_flat in ways + [partial(_unrolled, axis=axis) for axis in range(3)]:
        found = lay_flat(own)
        lacks = _lacking(neighbours, found)
        length = float(_lengths(points, sides_of(found)).mean()) if len(found) else np.inf
        if (lacks, length) < (fewest, side):
            best, fewest, side = found, lacks, length
        if not lacks and lay_flat is _in_plane:
            break
    if not len(best):
        raise FrameError(f'{len(points)} markers cannot be triangulated: some are at one place')
    return best


def _lacking(neighbours: IntArray, triangles: IntArray) -> float:
    """How many pairs, shape (pairs, 2), are no side of a triangle; infinite without any."""
    if not len(triangles):
        return np.inf
    sides = set(map(tuple, sides_of(triangles).reshape(-1, 2).tolist()))
    return float(sum(tuple(pair) not in sides for pair in neighbours.tolist()))


def _in_plane(points: FloatArray) -> IntArray:
    """Triangles of points [m], shape (nodes, 3), seen along the last axis; none where two meet."""
    found = Delaunay(points[:, :2])
    return NO_TRIANGLES if len(found.coplanar) else np.asarray(found.simplices, np.int64)


def _unrolled(points: FloatArray, axis: int) -> IntArray:
    """Triangles of points [m], shape (nodes, 3), on a tube round an axis through their middle.

    The unrolled tube is laid out three times, so that triangles go on across its seam; of each of
    them one copy is kept. None where the points are on no tube.
    """
    height, (a, b) = points[:, axis], np.delete(points, axis, axis=1).T
    nodes, angle = len(points), np.arctan2(b, a)
    turns = np.concatenate([angle - 2 * np.pi, angle, angle + 2 * np.pi])
    flat = np.column_stack([np.hypot(a, b).mean() * turns, np.tile(height, 3)])
    try:
        found = Delaunay(flat)
    except QhullError:  # they lie in a plane across the axis
        return NO_TRIANGLES
    if len(found.coplanar):
        return NO_TRIANGLES
    # the copy whose lowest node lies in the middle, which each triangle has once
    copies, each = np.asarray(found.simplices, np.int64), np.arange(len(found.simplices))
    lowest = copies[each, (copies % nodes).argmin(axis=1)]
    once = copies[lowest // nodes == 1] % nodes
    distinct = (np.diff(np.sort(once, axis=1), axis=1) > 0).all(axis=1)
    return np.asarray(once[distinct])


def _opposite(triangles: IntArray, sides: IntArray) -> IntArray:
    """Pairs of opposite corners of triangles with a common side, each once, shape (pairs, 2).

    sides, shape (t, 3): the number of the edge from corner k to k + 1; opposite is corner k + 2.
    """
    corner, side = np.roll(triangles, -2, axis=1).ravel(), sides.ravel()
    order = np.argsort(side, kind='stable')
    shared = np.flatnonzero(np.diff(side[order]) == 0)
    pairs = np.column_stack([corner[order[shared]], corner[order[shared + 1]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)
