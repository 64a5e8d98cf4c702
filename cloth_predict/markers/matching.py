"""Which point of an unordered cloud is which node of a grid, without a prediction: the start."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from cloth_predict.errors import FrameError
from cloth_predict.markers.association import checked, in_node_order
from cloth_predict.markers.chain_matching import find_chain
from cloth_predict.models.springs import grid_pairs
from cloth_predict.surface.assembly import aligned
from cloth_predict.types import FloatArray, IntArray

Schedule: TypeAlias = tuple[tuple[float, float], ...]

ANGLES = (0, 90, 45, 135, 22.5, 67.5, 112.5, 157.5)
"""Turns in the plane of the cloud [degrees] that are tried, from the direction of neighbours."""
SCHEDULES = (
    ((1e4, 9.0), (1e2, 3.0), (10.0, 2.0), (1.0, 1.0), (0.1, 0.7)),
    ((10.0, 9.0), (1.0, 9.0), (0.1, 2.0), (0.1, 0.7)),
)
"""Stiffness of the fitted surface against bending, and reach of a node [cells], by stage.

At first stiff, for clouds with ghosts, then soft, for those that are bent much.
"""
SLIDE: Schedule = ((1e2, 2.0), *SCHEDULES[0][2:])
MOST_STRETCH = 0.3
"""A point whose edges are longer or shorter than this [cells], in the median, is a ghost."""
MOST_RESIDUAL = 0.25
"""Root mean square of the stretch [cells] above which the points are no grid.

Scattered points reach 0.27 and more in a 5 x 4 grid; a sheet rolled to half a circle has 0.02.
"""
ITERATIONS = 6
"""Most assignments of a stage."""
GOOD = 0.1
"""Root mean square of the stretch [cells] at which no other start is tried."""


@dataclass(frozen=True)
class Grid:
    """What is known of the grid: its rest shape [m], (nodes, 3), and what follows from it.

    pairs, shape (edges, 2), and lengths [m], shape (edges,): structural and shear neighbours;
    edges_of, shape (nodes, 8): the edges at each node, filled up with -1;
    bending, shape (nodes, nodes): quadratic form of the second differences; cell [m]: the shorter
    side of a cell.
    """

    rows: int
    cols: int
    shape: FloatArray
    pairs: IntArray
    lengths: FloatArray
    edges_of: IntArray
    bending: FloatArray
    cell: float

    @classmethod
    def of(cls, rows: int, cols: int, shape: FloatArray) -> Grid:
        """Prepare a grid with this rest shape [m], shape (rows * cols, 3)."""
        families = grid_pairs(rows, cols)
        pairs = np.concatenate([families['structural'], families['shear']])
        lengths = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)
        edges_of = np.full((len(shape), 8), -1)
        for i in range(len(shape)):
            edges = np.flatnonzero((pairs == i).any(axis=1))
            edges_of[i, : len(edges)] = edges
        bending, cell = _bending(rows, cols), float(lengths.min())
        return cls(rows, cols, shape, pairs, lengths, edges_of, bending, cell)


def find_grid(
    points: FloatArray,
    rows: int,
    cols: int,
    shape: FloatArray,
    known: IntArray | None = None,
) -> IntArray:
    """Return the node of each point, shape (m,), or -1 for a ghost.

    points [m], shape (m, 3), in any order, some missing or too many; shape [m], shape
    (rows * cols, 3): the flat rest shape. Bending is allowed, stretching is not, except that a
    chain with all its points may have any distances. Of the labellings that the symmetry of the
    grid leaves open, the one is taken that agrees with most of the nodes that are `known`, shape
    (m,), -1 where not, and of these the one with the smallest turn of `shape`. Raises FrameError
    where the points do not make such a grid.
    """
    points = checked(points)
    nodes = rows * cols
    known = np.full(len(points), -1) if known is None else known
    if len(points) < max(2, nodes / 2):
        raise FrameError(f'{len(points)} points are too few for {rows} x {cols} nodes')
    if min(rows, cols) == 1:
        return _smallest_turn(find_chain(points, shape), points, rows, cols, shape, known)
    grid = Grid.of(rows, cols, shape)
    best = _slid(grid, _best_of_starts(grid, points), points)
    _require_grid(grid, best, points)
    return _smallest_turn(best, points, rows, cols, shape, known)


def _best_of_starts(grid: Grid, points: FloatArray) -> IntArray:
    """Return the nodes, (m,), with the least misfit, or the first that leave nothing to wish."""
    best, least, most = np.full(len(points), -1), np.inf, min(len(points), len(grid.shape))
    for schedule, start in product(SCHEDULES, _starts(grid.shape, points)):
        node = _settle(grid, schedule, start, points)
        misfit = _misfit(grid, node, points)
        if misfit < least:
            best, least = node, misfit
            if (best >= 0).sum() == most and _residual(grid, best, points) < GOOD:
                break
    return best


def _slid(grid: Grid, best: IntArray, points: FloatArray) -> IntArray:
    """Slide the grid by a cell while that lessens the misfit: it may have settled beside itself.

    Where no node or no point is left over there is nowhere to slide to.
    """
    index = np.full((grid.rows + 2, grid.cols + 2), -1)
    index[1:-1, 1:-1] = np.arange(len(grid.shape)).reshape(grid.rows, grid.cols)
    least, better = _misfit(grid, best, points), True
    while better and (best < 0).any() and (best >= 0).sum() < len(grid.shape):
        better = False
        for down, right in product((0, 1, -1), repeat=2):
            moved = np.roll(index, (down, right), (0, 1))[1:-1, 1:-1].ravel()
            node = np.where(best >= 0, moved[best], -1)
            surface = _bent(grid, node, points, SLIDE[0][0], grid.shape)
            node = _settle(grid, SLIDE, surface, points)
            misfit = _misfit(grid, node, points)
            if misfit < least - 1e-9:
                best, least, better = node, misfit, True
                break
    return best


def _starts(shape: FloatArray, points: FloatArray) -> Iterator[FloatArray]:
    """Poses to start from, each (nodes, 3): unturned, then turned in the plane of the cloud.

    A bent surface is narrower than the flat shape, which is therefore narrowed to the spread.
    """
    centre = points.mean(axis=0)
    flat = shape - shape.mean(axis=0)
    yield flat + centre
    axes = np.linalg.svd(points - centre, full_matrices=False)[2]
    plane = (points - centre) @ axes[:2].T
    spread = plane.std(axis=0)
    for angle in np.radians(ANGLES) + lattice_angle(plane):
        c, s = np.cos(angle), np.sin(angle)
        turned = flat[:, :2] @ np.array([[c, s], [-s, c]])
        narrow = np.clip(spread / np.maximum(turned.std(axis=0), 1e-12), 0.4, 1.0)
        yield (turned * narrow) @ axes[:2] + centre


def lattice_angle(plane: FloatArray) -> float:
    """Direction [rad], up to quarter turns, of the nearest neighbours of points [m], (m, 2)."""
    step = plane[:, None] - plane
    distance = np.linalg.norm(step, axis=2) + np.where(np.eye(len(plane)), np.inf, 0.0)
    near = step[np.arange(len(plane)), distance.argmin(axis=1)]
    fourfold = np.exp(4j * np.arctan2(near[:, 1], near[:, 0]))
    return float(np.angle(fourfold.sum()) / 4.0)


def _settle(grid: Grid, schedule: Schedule, surface: FloatArray, points: FloatArray) -> IntArray:
    """Assign and bend in turn from a first surface [m], (nodes, 3); returns the nodes, (m,).

    The surface stiffens the fit less and less, as in Chui and Rangarajan 2003 (TPS-RPM).
    """
    node = np.full(len(points), -1)
    for stiffness, reach in schedule:
        for _ in range(ITERATIONS):
            before, node = node, _nearest(surface, points, reach * grid.cell)
            if (node == before).all():
                break
            surface = _bent(grid, node, points, stiffness, surface)
    for _ in range(ITERATIONS):
        before, node = node, _plausible(grid, node, points)
        surface = _bent(grid, node, points, stiffness, surface)
        node = _plausible(grid, _nearest(surface, points, reach * grid.cell), points)
        if (node == before).all():
            break
    return node


def _plausible(grid: Grid, node: IntArray, points: FloatArray) -> IntArray:
    """Make ghosts, worst first, of the points whose distances to their neighbours do not fit."""
    node = node.copy()
    while True:
        stretch = np.append(np.abs(_stretch(grid, node, points)), np.nan)
        table = np.sort(stretch[grid.edges_of], axis=1)  # NaN comes last
        known = (~np.isnan(table)).sum(axis=1)
        median = table[np.arange(len(table)), np.maximum(known - 1, 0) // 2]
        if not (median > MOST_STRETCH).any():
            return node
        node[node == np.nanargmax(median)] = -1


def _nearest(surface: FloatArray, points: FloatArray, reach: float) -> IntArray:
    """Assign points to the nodes of a surface [m] with the least squares, none beyond `reach`."""
    cost = np.minimum(cdist(surface, points, 'sqeuclidean'), reach**2)
    i, j = linear_sum_assignment(cost)
    node = np.full(len(points), -1)
    inside = cost[i, j] < reach**2
    node[j[inside]] = i[inside]
    return node


def _bent(
    grid: Grid, node: IntArray, points: FloatArray, stiffness: float, surface: FloatArray
) -> FloatArray:
    """Surface [m], (nodes, 3), with the least squares of distances and second differences."""
    positions, seen = in_node_order(node, points, len(surface))
    weight = seen + 1e-6  # hidden nodes that nothing else holds stay where they are
    target = np.where(seen[:, None], positions, surface)
    matrix = np.diag(weight) + stiffness * grid.bending
    return np.asarray(np.linalg.solve(matrix, weight[:, None] * target))


def _bending(rows: int, cols: int) -> FloatArray:
    """Sum of squared second differences of a grid as a quadratic form, shape (nodes, nodes)."""
    node = np.arange(rows * cols).reshape(rows, cols)
    unit = np.eye(rows * cols)[node]
    twist = np.diff(np.diff(unit, axis=0), axis=1) * 2**0.5
    parts = (np.diff(unit, 2, axis=0), np.diff(unit, 2, axis=1), twist)
    return np.asarray(sum(np.tensordot(p, p, ((0, 1), (0, 1))) for p in parts))


def _stretch(grid: Grid, node: IntArray, points: FloatArray) -> FloatArray:
    """Lengths of the edges minus those at rest, in cells, (edges,); NaN where an end is hidden."""
    positions, _ = in_node_order(node, points, len(grid.shape))
    i, j = grid.pairs.T
    return np.asarray(
        (np.linalg.norm(positions[i] - positions[j], axis=1) - grid.lengths) / grid.cell
    )


def _misfit(grid: Grid, node: IntArray, points: FloatArray) -> float:
    """Squared stretch, at most and for hidden edges that of half a cell: to compare labellings."""
    stretch = np.nan_to_num(_stretch(grid, node, points), nan=np.inf)
    return float(np.minimum(stretch**2, 0.25).sum())


def _residual(grid: Grid, node: IntArray, points: FloatArray) -> float:
    """Root mean square of the stretch in cells, infinite where no edge is seen."""
    stretch = _stretch(grid, node, points)
    seen = ~np.isnan(stretch)
    return float(np.sqrt(np.mean(stretch[seen] ** 2))) if seen.any() else np.inf


def _require_grid(grid: Grid, node: IntArray, points: FloatArray) -> None:
    name, nodes = f'{grid.rows} x {grid.cols} nodes', len(grid.shape)
    seen = in_node_order(node, points, nodes)[1].reshape(grid.rows, grid.cols)
    missing, ghosts = int(nodes - seen.sum()), int((node < 0).sum())
    if missing > nodes / 2 or min(missing, ghosts) > nodes / 4:
        raise FrameError(f'only {nodes - missing} of {len(points)} points fit a grid of {name}')
    residual = _residual(grid, node, points)
    if residual > MOST_RESIDUAL:
        raise FrameError(
            f'{len(points)} points do not make a grid of {name}: neighbours are '
            f'{residual * grid.cell:.3g} m (rms) nearer or farther than at rest'
        )
    sides = {'first row': seen[0], 'last row': seen[-1]}
    sides |= {'first column': seen[:, 0], 'last column': seen[:, -1]}
    for side, there in sides.items():
        if not there.any():
            raise FrameError(f'no point of the {side} of {name}: the grid could lie elsewhere')


def _smallest_turn(
    node: IntArray,
    points: FloatArray,
    rows: int,
    cols: int,
    shape: FloatArray,
    known: IntArray,
) -> IntArray:
    """Of the labellings that are the same grid, take the one that turns `shape` least.

    Before that, the one that agrees with most of the nodes that are known.
    """
    index = np.arange(rows * cols).reshape(rows, cols)
    same = [index, index[::-1], index[:, ::-1], index[::-1, ::-1]]
    sides = np.ptp(shape, axis=0)
    if rows == cols and np.isclose(sides[0], sides[1], rtol=0.01):
        same += [other.T for other in same]
    labellings = [np.where(node >= 0, other.ravel()[node], -1) for other in same]
    return max(
        labellings,
        key=lambda found: (
            int(((found == known) & (known >= 0)).sum()),
            _turn_trace(found, points, shape),
        ),
    )


def _turn_trace(node: IntArray, points: FloatArray, shape: FloatArray) -> float:
    """Trace 1 + 2 cos(angle) of the rotation that lays `shape` onto the points."""
    positions, seen = in_node_order(node, points, len(shape) + 4)
    laid = aligned(np.vstack([shape, np.zeros(3), np.eye(3)]), positions, seen)
    return float(np.trace(laid[-3:] - laid[-4]))
