"""Which nodes are joined: grids, edges, triangulations in a plane and round a tube; springs."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from cloth_predict.config import build
from cloth_predict.errors import FrameError
from cloth_predict.evaluation import figures
from cloth_predict.models.springs import grid_pairs
from cloth_predict.surface import topology
from cloth_predict.surface.assembly import build_mass_spring, complete, lengths_of, topology_of


def settings(kind, nodes, **model):
    values = {'topology': kind, 'nodes': nodes, 'rest_length': 'measured', **model}
    return build({'model': values}, 'test')


def pairs_of(array):
    """Pairs or triangles as a set, whatever their order."""
    found = {tuple(sorted(row)) for row in array.tolist()}
    assert len(found) == len(array)  # none is there twice
    return found


def sheet(nodes, seed=0, bend=0.0):
    """Random nodes [m] on a square of 1 m, bent, turned and moved, and their places on it."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(0, 1, (nodes, 2))
    points = np.column_stack([flat, bend * np.sin(2 * flat[:, 0])])
    return Rotation.from_rotvec([0.4, -0.9, 0.3]).apply(points) + np.arange(3.0), flat


def tube(rings, around, seed=0):
    """Nodes [m] on rings of 0.3 m, 0.1 m apart, each turned by half a node against the next."""
    ring, k = np.divmod(np.arange(rings * around), around)
    angle = 2 * np.pi * (k + 0.5 * (ring % 2)) / around
    points = np.column_stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.1 * ring])
    order = np.random.default_rng(seed).permutation(len(points))
    return Rotation.from_rotvec([0.7, 0.1, -1.1]).apply(points)[order], ring[order], k[order]


# --- grids and edges -------------------------------------------------------------------------


@pytest.mark.parametrize('size', [(5, 4), (1, 13), (2, 2), (1, 1)])
def test_a_grid(size):
    found = topology.grid(*size)
    assert list(found.families) == ['structural', 'shear', 'flexion']
    for name, pairs in grid_pairs(*size).items():
        np.testing.assert_array_equal(found.families[name], pairs)
    assert found.triangles.shape == (2 * (size[0] - 1) * (size[1] - 1), 3)
    joined = pairs_of(found.edges) | pairs_of(found.families['shear'])
    sides = {tuple(sorted(two)) for t in found.triangles.tolist() for two in combinations(t, 2)}
    assert sides <= joined


def test_what_is_two_edges_apart_resists_bending():
    edges = [(0, 1), (1, 2), (2, 0), (2, 3), (4, 3), (5, 4), (3, 6)]
    found = topology.of_edges(7, np.array(edges))
    distance = np.full((7, 7), np.inf)  # by Floyd and Warshall
    np.fill_diagonal(distance, 0)
    for i, j in edges:
        distance[i, j] = distance[j, i] = 1
    for k in range(7):
        distance = np.minimum(distance, distance[:, k, None] + distance[k])
    expected = {(i, j) for i, j in combinations(range(7), 2) if distance[i, j] == 2}
    assert pairs_of(found.families['flexion']) == expected
    assert found.edges.tolist() == [list(edge) for edge in edges]
    assert found.families['shear'].shape == found.triangles[:, :2].shape == (0, 2)


def test_a_chain_of_edges_is_the_chain_of_a_grid():
    shape = np.random.default_rng(0).normal(size=(6, 3))
    flat = [n for k in range(5) for n in (k, k + 1)]
    values = {'rest_length': 'measured', 'stiffness_flexion': 7.0}
    mesh, grid = (
        build_mass_spring(build({'model': model | values}, 'test'), shape).springs
        for model in ({'topology': 'edges', 'nodes': 6, 'edges': flat}, {'rows': 1, 'cols': 6})
    )
    for name in ('pairs', 'stiffness', 'damping', 'rest_length'):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(grid, name))


# --- triangulations --------------------------------------------------------------------------


@pytest.mark.parametrize('seed', range(5))
def test_circles_round_triangles_hold_no_other_node(seed):
    points, flat = sheet(40, seed)
    found = topology.delaunay(points)
    lengths = lengths_of(found.edges, points)
    for triangle in found.triangles:  # the definition of Delaunay, in the plane of the sheet
        a, b, c = flat[triangle]
        centre = a + np.linalg.solve(
            2 * np.array([b - a, c - a]), [(b - a) @ (b - a), (c - a) @ (c - a)]
        )
        distance = np.linalg.norm(flat - centre, axis=1)
        assert distance.min() > (1 - 1e-6) * distance[triangle[0]]  # the corners; rounding
    hull = ConvexHull(flat).simplices
    assert len(pairs_of(found.triangles)) <= 2 * 40 - 2 - len(hull)  # Euler, of all of them
    assert lengths.max() < 3.2 * np.median(lengths)  # the median of all of them is longer


def brute_force_flexion(triangles):
    """Opposite corners of triangles that share two nodes, where no edge joins them."""
    found = set()
    for one, other in combinations(map(set, triangles.tolist()), 2):
        if len(one & other) == 2:
            found.add(tuple(sorted(one ^ other)))
    return found


@pytest.mark.parametrize('points', [sheet(40, 7)[0], sheet(9, 2)[0], tube(5, 10)[0]])
def test_opposite_corners_resist_bending(points):
    found = topology.delaunay(points)
    expected = brute_force_flexion(found.triangles) - pairs_of(found.edges)
    assert pairs_of(found.families['flexion']) == expected
    sides = {tuple(sorted(two)) for t in found.triangles.tolist() for two in combinations(t, 2)}
    assert sides <= pairs_of(found.edges)


def test_slivers_of_the_hull_are_left_out_and_no_node_is_alone():
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), -1).reshape(-1, 2)
    grid[:, 0] += 0.01 * (grid[:, 1] - 2.5) ** 2  # the first column is hollow: slivers along it
    points = np.column_stack([grid, np.zeros(36)]) * 0.1
    points = np.vstack([points, [1.5, 0.25, 0.0]])  # far away: 10 cells from the others
    found = topology.delaunay(points)
    lengths = lengths_of(found.edges, points)
    to_far = found.edges[(found.edges == 36).any(axis=1)]
    assert len(to_far) == 1  # by its nearest neighbour alone
    nearest = np.linalg.norm(points[:36] - points[36], axis=1).argmin()
    assert to_far.tolist() == [[nearest, 36]]
    assert (np.sort(lengths)[-2]) <= 3 * 0.15
    assert (found.triangles != 36).all()
    assert pairs_of(found.triangles).isdisjoint({(0, 6, 30), (0, 12, 30), (0, 18, 30)})


def test_a_tube_is_closed_and_front_and_back_stay_apart():
    rings, around = 7, 12
    points, ring, k = tube(rings, around)
    found = topology.delaunay(points)
    node = {(r, n): i for i, (r, n) in enumerate(zip(ring.tolist(), k.tolist(), strict=True))}
    expected = set()
    for (r, n), i in node.items():
        expected.add(tuple(sorted((i, node[r, (n + 1) % around]))))
        for beside in (0, 1) if r % 2 else (-1, 0):
            if r + 1 < rings:
                expected.add(tuple(sorted((i, node[r + 1, (n + beside) % around]))))
    extra = pairs_of(found.edges) - expected
    assert pairs_of(found.edges) >= expected
    assert extra == set()
    # 2 triangles per node of a ring between two rings
    assert len(found.triangles) == 2 * around * (rings - 1)


def test_a_bent_sheet_stays_open():
    found = topology.delaunay(sheet(60, 3, bend=0.3)[0])
    used = np.unique(found.triangles)
    sides = {tuple(sorted(two)) for t in found.triangles.tolist() for two in combinations(t, 2)}
    assert len(used) - len(sides) + len(found.triangles) == 1  # Euler: a disc


@pytest.mark.parametrize(
    ('points', 'message'),
    [
        (np.outer(np.arange(5.0), [1, 2, 3]), '5 markers cannot be triangulated: .* on a line'),
        (np.zeros((4, 3)), '4 markers cannot be triangulated: .* on a line'),
        (np.vstack([sheet(9)[0], sheet(9)[0][:1]]), '10 markers .* some are at one place'),
    ],
)
def test_markers_that_are_no_surface(points, message):
    with pytest.raises(FrameError, match=message):
        topology.delaunay(points)


def test_a_surface_of_a_triangulation():
    config = settings('delaunay', 30, mass=0.6, stiffness_flexion=7.0, gravity=[0, 0, 0])
    points, _ = sheet(30, 1)
    mesh, joined = build_mass_spring(config, points), topology.delaunay(points)
    np.testing.assert_array_equal(mesh.springs.pairs, joined.pairs)
    np.testing.assert_array_equal(mesh.mass, 0.6 / 30)
    count = [len(pairs) for pairs in joined.families.values()]
    assert mesh.springs.stiffness.tolist() == [60.0] * count[0] + [7.0] * count[2]
    rest = np.append(points.ravel(), np.zeros(90))
    # at rest where it was measured: no force but rounding of lengths, 1e-16 m * 60 N/m / 0.02 kg
    np.testing.assert_allclose(mesh.f(rest, mesh.input()), 0.0, atol=1e-11)


# --- filling in ------------------------------------------------------------------------------


def mesh_of_grid(rows, cols):
    """A configuration that lists the edges of a grid."""
    edges = grid_pairs(rows, cols)['structural'].ravel().tolist()
    return settings('edges', rows * cols, edges=edges).model


@pytest.mark.parametrize('hidden', [[0], [12], [4, 5], [7, 8, 12]])
def test_hidden_nodes_of_a_mesh_lie_on_the_smoothest_surface(hidden):
    model, rng = mesh_of_grid(3, 5), np.random.default_rng(5)
    positions, visible = rng.normal(size=(15, 3)), ~np.isin(np.arange(15), hidden)
    filled, spread = complete(model, np.where(visible[:, None], positions, np.nan), visible)
    beside = [[] for _ in range(15)]
    for i, j in grid_pairs(3, 5)['structural'].tolist():
        beside[i].append(j)
        beside[j].append(i)

    def bending(points):
        return sum(
            np.sum((points[i] - points[near].mean(axis=0)) ** 2) for i, near in enumerate(beside)
        )

    least = bending(filled)
    for node in hidden:  # the minimum of a quadratic: every way out costs step^2 or more
        for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
            moved = filled.copy()
            moved[node] += step
            assert bending(moved) >= least + 0.9e-6
    np.testing.assert_array_equal(filled[visible], positions[visible])
    edges = lengths_of(grid_pairs(3, 5)['structural'], filled)
    np.testing.assert_array_equal(spread, np.where(visible, 0.0, np.median(edges)))


def test_the_hidden_end_of_a_chain_goes_on_straight():
    model = mesh_of_grid(1, 6)
    positions = np.outer(np.arange(6.0), [0.1, 0.2, -0.1])
    for hidden in ([5], [0], [0, 5], [4, 5], [2]):
        visible = ~np.isin(np.arange(6), hidden)
        filled, _ = complete(model, np.where(visible[:, None], positions, np.nan), visible)
        # the loose end counts 1e-6 of an edge of 0.24 m, up to ten times over two nodes
        np.testing.assert_allclose(filled, positions, atol=3e-6)


# --- drawing ---------------------------------------------------------------------------------


def test_the_edges_of_a_mesh_are_drawn():
    points, _ = sheet(20, 4)
    axes = Figure().add_subplot(projection='3d')
    edges = topology.delaunay(points).edges
    figures._draw_mesh(axes, points, edges, 'k', 'x')
    _, line = axes.get_lines()
    x, z, y = np.array(line.get_data_3d()).reshape(3, len(edges), 3)
    assert np.isnan(x[:, 2]).all()
    drawn = np.stack([x, y, z], axis=-1)[:, :2]
    np.testing.assert_array_equal(drawn, points[edges])


def test_what_is_drawn_of_a_triangulation_is_that_of_the_median_frame():
    points, _ = sheet(20, 4)
    frames = np.stack([points] * 3)
    frames[0, :15] = frames[1, 10:] = np.nan
    model = settings('delaunay', 20).model
    found = figures.edges_of(model, frames)
    np.testing.assert_array_equal(found, topology_of(model, points).edges)
    frames[:, 3] = np.nan
    assert figures.edges_of(model, frames).shape == (0, 2)
    grid = build({'model': {'rows': 4, 'cols': 5}}, 'test').model
    np.testing.assert_array_equal(figures.edges_of(grid, frames), grid_pairs(4, 5)['structural'])
