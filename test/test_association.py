"""Points and labels to nodes: gates, ghosts, swaps, and grids and chains found in a cloud."""

from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from cloth_predict.config import build, load
from cloth_predict.errors import FrameError
from cloth_predict.formats.recording import read
from cloth_predict.markers.association import in_node_order, limit_of, match
from cloth_predict.markers.identification import Expected, Identified, identify
from cloth_predict.markers.matching import find_grid, lattice_angle
from cloth_predict.surface.assembly import rest_shape

NO_POINTS = np.zeros((0, 3))
ROOT = Path(__file__).parents[1]
SIGMA = 0.003
"""Standard deviation [m] of the marker positions about the predicted ones."""
OFF = np.array([0.0, 0.0, 0.2])
"""Far from all nodes of a flat grid [m]."""


def grid(rows=5, cols=4, width=0.51, height=0.80):
    model = {'rows': rows, 'cols': cols, 'width': width, 'height': height}
    return rest_shape(build({'model': model}, 'test').model)


def covariances_of(nodes, rng):
    """Full covariances [m^2], (nodes, 3, 3), with sigmas from 2 to 8 mm in random directions."""
    turns = Rotation.random(nodes, random_state=rng).as_matrix()
    return np.einsum('nij,nj,nkj->nik', turns, rng.uniform(2e-3, 8e-3, (nodes, 3)) ** 2, turns)


def isotropic(nodes, sigma=SIGMA):
    return np.tile(sigma**2 * np.eye(3), (nodes, 1, 1))


def checked(
    predicted, cov, positions, visible, points=NO_POINTS, sure=(), doubtful=(),
    earlier=NO_POINTS, gate=0.999,
):  # fmt: skip
    flags = (np.isin(np.arange(len(visible)), list(of)) for of in (sure, doubtful))
    labelled = Identified.as_labelled(positions, visible)
    return identify(Expected(predicted, cov, *flags), labelled, points, earlier, 0.05, gate)


def outcome(found):
    return found.relabelled, found.rejected, found.matched, found.ghosts


def brute_force(predicted, covariances, points, limit):
    """Least cost over all partial assignments, and the nodes of that one, by trying them all."""
    nodes, places = len(predicted), len(predicted) + len(points)
    best, best_node = np.inf, None
    for chosen in permutations(range(places), len(points)):  # places >= nodes mean a ghost
        cost, node = limit * nodes, np.full(len(points), -1)
        for j, i in enumerate(chosen):
            if i < nodes:
                e = points[j] - predicted[i]
                d2 = e @ np.linalg.inv(covariances[i]) @ e
                cost += np.inf if d2 >= limit else d2 - limit
                node[j] = i
        if cost < best:
            best, best_node = cost, node
    return best, best_node


@pytest.mark.parametrize('seed', range(12))
@pytest.mark.parametrize(('nodes', 'points'), [(1, 3), (3, 3), (4, 2), (3, 4), (4, 4)])
def test_match_is_the_best_of_all_assignments(seed, nodes, points):
    rng = np.random.default_rng(seed)
    predicted, cov = rng.normal(0, 0.008, (nodes, 3)), covariances_of(nodes, rng)
    cloud = rng.normal(0, 0.008, (points, 3))
    found = match(predicted, cov, cloud)
    _, expected = brute_force(predicted, cov, cloud, stats.chi2.ppf(0.999, 3))
    np.testing.assert_array_equal(found.node, expected)
    assert found.ghosts == (expected < 0).sum()
    assert found.missing == nodes - (expected >= 0).sum()


@pytest.mark.parametrize('gate', [0.9, 0.99, 0.999])
def test_the_gate_leaves_out_its_share_of_true_points(gate):
    rng, nodes = np.random.default_rng(1), 20000
    predicted = np.column_stack([np.arange(nodes), np.zeros((nodes, 2))])
    cov = covariances_of(nodes, rng)
    noise = np.linalg.cholesky(cov) @ rng.normal(size=(nodes, 3, 1))
    found = match(predicted, cov, predicted + noise[..., 0], gate)
    # 99.99 % interval of the binomial distribution
    low, high = stats.binom.interval(0.9999, nodes, 1 - gate)
    assert low <= found.ghosts <= high
    assert ((found.node == np.arange(nodes)) | (found.node == -1)).all()
    labelled = checked(predicted, cov, predicted + noise[..., 0], np.ones(nodes, bool), gate=gate)
    assert outcome(labelled) == (0, found.ghosts, 0, 0)
    np.testing.assert_array_equal(labelled.visible, found.node >= 0)


def test_the_limit_is_the_quantile_of_chi_square():
    # both evaluate the same function; 1e-9 is far above rounding
    assert limit_of(0.999) == pytest.approx(16.26623619623813, rel=1e-9)
    assert limit_of(0.5) == pytest.approx(stats.chi2.ppf(0.5, 3), rel=1e-9)
    for gate in (0.0, 1.0, -0.1, 2.0, np.nan):
        with pytest.raises(ValueError, match='gate must lie between 0 and 1'):
            limit_of(gate)


@pytest.mark.parametrize(('inside', 'factor'), [(True, 0.999), (False, 1.001)])
def test_the_gate_is_an_ellipsoid(inside, factor):
    cov = np.diag([1e-4, 4e-6, 1e-6])[None]
    for axis in range(3):
        point = np.zeros((1, 3))
        point[0, axis] = factor * np.sqrt(stats.chi2.ppf(0.999, 3) * cov[0, axis, axis])
        assert (match(np.zeros((1, 3)), cov, point).node[0] == 0) == inside


@pytest.mark.parametrize('seed', range(5))
def test_ghosts_and_missing_points_are_told_from_nodes(seed):
    rng = np.random.default_rng(seed)
    shape, order = grid(), rng.permutation(20)[:16]
    points = np.vstack([shape[order] + rng.normal(0, SIGMA / 3, (16, 3)), shape[:3] + OFF])
    found = match(shape, isotropic(20), points)
    np.testing.assert_array_equal(found.node, [*order, -1, -1, -1])
    assert (found.ghosts, found.missing) == (3, 4)
    positions, visible = in_node_order(found.node, points, 20)
    np.testing.assert_array_equal(positions[order], points[:16])
    assert sorted(order) == list(np.flatnonzero(visible))
    assert np.isnan(positions[~visible]).all()


def test_the_nearer_of_two_points_at_a_node_is_taken():
    shape = grid()
    points = shape[[7, 7, 2]] + [[0.004, 0, 0], [0.001, 0, 0], [0, 0, 0]]
    assert match(shape, isotropic(20), points).node.tolist() == [-1, 7, 2]
    twice = match(shape, isotropic(20), shape[[7, 7]])
    assert sorted(twice.node) == [-1, 7]
    assert (twice.ghosts, twice.missing) == (1, 19)


def test_nodes_closer_than_the_gate_get_the_best_sum():
    predicted = np.array([[0.0, 0, 0], [0.005, 0, 0]])
    points = np.array([[0.004, 0, 0], [0.009, 0, 0]])  # the nearest node of both is node 1
    assert match(predicted, isotropic(2), points).node.tolist() == [0, 1]


def test_no_points():
    found = match(grid(), isotropic(20), np.zeros((0, 3)))
    assert (found.node.shape, found.ghosts, found.missing) == ((0,), 0, 20)


def test_no_nodes():
    found = match(np.zeros((0, 3)), np.zeros((0, 3, 3)), grid()[:2])
    assert (found.node.tolist(), found.ghosts, found.missing) == ([-1, -1], 2, 0)


@pytest.mark.parametrize('value', [np.nan, np.inf])
def test_points_that_are_not_finite_are_named(value):
    shape = grid()
    bad = shape.copy()
    bad[3, 1] = value
    with pytest.raises(FrameError, match='point 3 has a coordinate that is not finite'):
        match(shape, isotropic(20), bad)
    with pytest.raises(FrameError, match='point 3 has a coordinate that is not finite'):
        find_grid(bad, 5, 4, shape)
    with pytest.raises(FrameError, match='not finite'):
        checked(shape, isotropic(20), bad, np.ones(20, bool))
    hidden = np.arange(20) != 3
    assert outcome(checked(shape, isotropic(20), bad, hidden)) == (0, 0, 0, 0)


@pytest.mark.parametrize('points', [np.zeros((4, 2)), np.zeros(3)])
def test_points_of_another_shape(points):
    with pytest.raises(FrameError, match=r'expected \(m, 3\)'):
        match(grid(), isotropic(20), points)


@pytest.mark.parametrize(
    ('cycle', 'swapped'),
    [((), 0), ((3, 9), 2), ((3, 9, 14), 3), ((0, 1, 2, 3), 4)],
)
def test_swapped_labels_are_put_right(cycle, swapped):
    rng, shape = np.random.default_rng(2), grid()
    true = shape + rng.normal(0, SIGMA / 3, (20, 3))
    given = true.copy()
    given[list(cycle)] = true[list(np.roll(cycle, 1).astype(int))]
    before, visible = given.copy(), np.ones(20, bool)
    found = checked(shape, isotropic(20), given, visible)
    np.testing.assert_array_equal(found.positions, true)
    assert found.visible.all()
    assert outcome(found) == (swapped, 0, 0, 0)
    np.testing.assert_array_equal(given, before)  # inputs are not written to


def test_a_marker_that_is_at_no_free_node_is_hidden():
    shape, visible = grid(), np.arange(20) != 5
    given = shape.copy()
    given[5] = np.nan
    given[2] += [0, 0, 0.3]  # nowhere
    given[6] = shape[7]  # at a node whose own marker is there
    given[[10, 11]] = shape[[11, 10]]
    found = checked(shape, isotropic(20), given, visible)
    assert outcome(found) == (2, 2, 0, 0)
    assert np.flatnonzero(~found.visible).tolist() == [2, 5, 6]
    np.testing.assert_array_equal(found.positions[found.visible], shape[found.visible])
    assert np.isnan(found.positions[~found.visible]).all()
    assert visible.sum() == 19


def test_a_label_that_went_to_a_hidden_node_follows_it():
    shape, given, visible = grid(), grid(), np.arange(20) != 5
    given[12] = shape[5] + 0.001  # the marker of node 12 is hidden, that of node 5 has its label
    found = checked(shape, isotropic(20), given, visible)
    assert outcome(found) == (1, 0, 0, 0)
    assert np.flatnonzero(~found.visible).tolist() == [12]
    np.testing.assert_array_equal(found.positions[5], given[12])


def test_points_go_to_the_nodes_that_have_no_marker():
    shape, given, visible = grid(), grid(), np.arange(20) < 15
    given[2] += OFF
    points = shape[[17, 2, 4, 16]] + 0.001  # of a node without marker, and of node 4 a second one
    found = checked(shape, isotropic(20), given, visible, points)
    assert outcome(found) == (0, 1, 3, 1)
    np.testing.assert_array_equal(found.left, [given[2], points[2]])
    assert np.flatnonzero(~found.visible).tolist() == [15, 18, 19]
    np.testing.assert_array_equal(found.positions[[17, 2, 16]], points[[0, 1, 3]])
    np.testing.assert_array_equal(found.positions[4], shape[4])


def test_a_node_not_seen_for_long_takes_only_what_was_there_before():
    shape, visible = grid(), np.arange(20) < 18
    points = shape[[18, 19]] + 0.001
    earlier = shape[[19]] + [[0.0, 0.0, 0.04]]  # within reach of 0.05 m of the second
    found = checked(shape, isotropic(20), shape, visible, points, doubtful=[19], earlier=earlier)
    assert (outcome(found), found.visible.all()) == ((0, 0, 2, 0), True)
    for before, doubtful in ((NO_POINTS, [19]), (earlier + 0.02, [18, 19])):
        found = checked(
            shape, isotropic(20), shape, visible, points, doubtful=doubtful, earlier=before
        )
        assert outcome(found) == (0, 0, 2 - len(doubtful), len(doubtful))
        np.testing.assert_array_equal(found.left, points[[d - 18 for d in doubtful]])


def test_a_sure_label_is_not_doubted():
    shape, given, every = grid(), grid(), np.ones(20, bool)
    given[2] += OFF
    given[[8, 9]] = shape[[9, 8]]
    found = checked(shape, isotropic(20), given, every, sure=[2, 8])
    assert outcome(found) == (0, 1, 0, 0)
    assert np.flatnonzero(~found.visible).tolist() == [9]
    np.testing.assert_array_equal(found.positions[[2, 8]], given[[2, 8]])


def bent(shape, kind):
    """Bend a flat shape without stretching it along the bent side."""
    shape = shape - shape.mean(axis=0)
    if kind == 'flat':
        return shape
    axis, u = (0 if kind.endswith('x') else 1), np.linspace(-1, 1, 20001)
    size = np.ptp(shape[:, axis])
    if kind.startswith('cylinder'):  # 120 degrees
        along, up = np.sin(u * np.pi / 3), np.cos(u * np.pi / 3)
    else:  # one period of a sine wave
        along, up = u, 0.3 * np.sin(np.pi * u)
    arc = np.append(0.0, np.cumsum(np.hypot(np.diff(along), np.diff(up))))
    scale = size / arc[-1]
    if kind.startswith('steep'):  # two thirds of a period, with slopes up to 57 degrees
        along, up = (u + 1) / 2, 0.25 * np.sin(np.pi * u)
        arc, scale = np.append(0.0, np.cumsum(np.hypot(np.diff(along), np.diff(up)))), size
    at = (shape[:, axis] - shape[:, axis].min()) / scale
    result = shape.copy()
    result[:, axis] = scale * np.interp(at, arc, along)
    result[:, 2] = scale * np.interp(at, arc, up)
    return result


def random_cloud(size, missing, ghosts, seed):
    """Points [m] of a turned flat grid with noise, some missing, and ghosts; and their nodes."""
    rng, shape = np.random.default_rng(seed), grid(*size)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(0.7 * axis / np.linalg.norm(axis))
    points = turn.apply(shape) + rng.normal(0, 0.001, shape.shape)
    around = rng.uniform(points.min(axis=0) - 0.3, points.max(axis=0) + 0.3, (50, 3))
    distance = np.linalg.norm(around[:, None] - points, axis=2).min(axis=1)
    node = np.append(rng.permutation(len(shape))[missing:], np.full(ghosts, -1))
    cloud = np.vstack([points[node[: len(node) - ghosts]], around[distance > 0.15][:ghosts]])
    order = rng.permutation(len(cloud))
    return cloud[order], node[order]


SIZES = [(5, 4, 0.51, 0.80), (3, 3, 0.4, 0.4), (6, 6, 0.5, 0.5), (2, 5, 0.8, 0.2)]
KINDS = ['flat', 'cylinder x', 'cylinder y', 'sine x', 'sine y']


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('degrees', [0.0, 20.0, 40.0])
def test_a_grid_is_found_turned_and_bent(size, kind, degrees):
    _find_turned_and_bent(size, kind, degrees)


@pytest.mark.parametrize('kind', ['steep x', 'steep y'])
def test_a_grid_is_found_when_it_is_bent_much(kind):
    _find_turned_and_bent(SIZES[0], kind, 30.0)


def _find_turned_and_bent(size, kind, degrees):
    rng, shape = np.random.default_rng([*map(ord, kind), int(degrees)]), grid(*size)
    for _ in range(3):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
        order = rng.permutation(len(shape))
        points = turn.apply(bent(shape, kind)) + rng.normal(0, 2, 3)
        points += rng.normal(0, 0.001, points.shape)
        np.testing.assert_array_equal(find_grid(points[order], *size[:2], shape), order)


@pytest.mark.parametrize(
    ('size', 'turn', 'expected'),
    [
        ((5, 4, 0.51, 0.80), [0, 0, 170], lambda index: index[::-1, ::-1]),
        ((5, 4, 0.51, 0.80), [170, 0, 0], lambda index: index[::-1]),
        ((5, 4, 0.51, 0.80), [0, 170, 0], lambda index: index[:, ::-1]),
        ((4, 4, 0.3, 0.3), [0, 0, 80], lambda index: np.rot90(index, -1)),
    ],
)
def test_symmetry_is_resolved_by_the_smallest_turn(size, turn, expected):
    shape, rng = grid(*size), np.random.default_rng(3)
    index = np.arange(len(shape)).reshape(size[:2])
    order = rng.permutation(len(shape))
    points = Rotation.from_rotvec(turn, degrees=True).apply(shape)[order]
    found = find_grid(points, *size[:2], shape)
    np.testing.assert_array_equal(found, expected(index).ravel()[order])


@pytest.mark.parametrize('kind', ['flat', 'cylinder y', 'sine x'])
@pytest.mark.parametrize('missing', [(), (0,), (0, 19), (3, 16), (9,), (5, 14)])
@pytest.mark.parametrize('ghosts', [0, 1, 3])
def test_a_grid_is_found_with_missing_points_and_ghosts(kind, missing, ghosts):
    rng, shape = np.random.default_rng([len(missing), ghosts]), grid()
    points = Rotation.from_rotvec([0.2, -0.3, 0.2]).apply(bent(shape, kind))
    points += rng.normal(0, 0.001, points.shape)
    far = np.array([[0.4, 0.1, 0.3], [-0.3, 0.2, -0.4], [0.1, -0.7, 0.3]])[:ghosts]
    node = np.array([n for n in range(20) if n not in missing] + [-1] * ghosts)
    cloud = np.vstack([points[node[node >= 0]], far])
    order = rng.permutation(len(cloud))
    np.testing.assert_array_equal(find_grid(cloud[order], 5, 4, shape), node[order])


@pytest.mark.parametrize(
    ('size', 'missing', 'ghosts', 'least'),
    [
        ((5, 4, 0.51, 0.80), 3, 3, 28),
        ((6, 6, 0.5, 0.5), 3, 3, 30),
        ((12, 12, 1.0, 1.0), 0, 0, 30),
    ],
)
def test_share_of_random_clouds_that_are_found(size, missing, ghosts, least):
    right = 0
    for seed in range(30):
        cloud, node = random_cloud(size, missing, ghosts, seed)
        try:
            right += (find_grid(cloud, *size[:2], grid(*size)) == node).all()
        except FrameError:
            continue
    assert right >= least


@pytest.mark.parametrize('degrees', [-40.0, -10.0, 0.0, 25.0, 44.0])
def test_the_direction_of_neighbours(degrees):
    rng, turn = np.random.default_rng(7), Rotation.from_rotvec([0, 0, degrees], degrees=True)
    plane = turn.apply(grid())[:, :2]
    assert np.degrees(lattice_angle(plane)) == pytest.approx(degrees, abs=1e-6)  # rounding
    noisy = np.vstack([plane + rng.normal(0, 0.002, (20, 2)), [[0.4, 1.5]]])
    assert abs(np.sin(2 * (lattice_angle(noisy) - np.radians(degrees)))) < 0.1  # 3 degrees


@pytest.mark.parametrize('frame', [0, 300, 800])
def test_the_towel_is_found_in_its_recording(frame):
    markers = read(ROOT / 'bags' / 'towel_fan').markers
    shape = rest_shape(load(ROOT / 'config' / 'towel.yaml').model)
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(20)
        found = find_grid(markers.positions[frame][order], 5, 4, shape)
        np.testing.assert_array_equal(found, order)


@pytest.mark.parametrize('frame', [0, 120, 250, 499])
def test_the_order_of_a_rope_is_found_in_its_recording(real, frame):
    positions = read(real('rope/rope_take1.csv')).markers.positions[frame]
    shape = rest_shape(load(ROOT / 'config' / 'rope.yaml').model)
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(13)
        # the first marker is at the larger x, so that the last one is node 0
        found = find_grid(positions[order], 1, 13, shape)
        np.testing.assert_array_equal(found, 12 - order)


def arch(nodes, length=1.2):
    angle = np.linspace(0, np.pi, nodes)
    return length / np.pi * np.column_stack([-np.cos(angle), np.zeros(nodes), np.sin(angle)])


@pytest.mark.parametrize('missing', [(), (4,), (6, 7)])
@pytest.mark.parametrize(('rows', 'cols'), [(1, 13), (13, 1)])
def test_a_chain_with_missing_points(missing, rows, cols):
    shape, rng = grid(rows, cols, 1.2, 1.2), np.random.default_rng(4)
    points = arch(13)
    if cols == 1:
        points = points[:, [1, 0, 2]] * [1, -1, 1]
    node = rng.permutation([n for n in range(13) if n not in missing])
    np.testing.assert_array_equal(find_grid(points[node], rows, cols, shape), node)


def test_a_chain_with_ghosts():
    shape, order = grid(1, 13, 1.2), np.random.default_rng(5).permutation(15)
    cloud = np.vstack([arch(13), [[0, 0.5, 0.2], [0.9, 0, 0.5]]])
    node = np.where(order < 13, order, -1)
    np.testing.assert_array_equal(find_grid(cloud[order], 1, 13, shape), node)


def scattered(nodes, seed):
    return np.random.default_rng(seed).uniform(-0.4, 0.4, (nodes, 3))


@pytest.mark.parametrize(
    ('points', 'size', 'message'),
    [
        (grid()[:9], (5, 4), '9 points are too few for 5 x 4 nodes'),
        (np.zeros((0, 3)), (5, 4), '0 points are too few for 5 x 4 nodes'),
        (grid()[4:], (5, 4), 'no point of the .* row of 5 x 4 nodes'),
        (scattered(36, 0), (6, 6), 'of 36 points fit a grid of 6 x 6 nodes'),
        (scattered(36, 1), (6, 6), 'of 36 points fit a grid of 6 x 6 nodes'),
        (scattered(20, 9), (5, 4), '20 points'),
        (grid() * [0.75, 0.75, 1], (5, 4), r'neighbours are 0.0\d+ m \(rms\) nearer or farther'),
        (3 * grid(), (5, 4), 'of 20 points fit a grid of 5 x 4 nodes'),
        (grid(1, 13, 1.2)[2:], (1, 13), '11 points make a chain of 1 m, but .* has 1.2 m'),
        (np.vstack([grid(1, 13, 1.2)[1:], [[9, 0, 0]]]), (1, 13), 'a gap of 7.8 m'),
        (np.zeros((13, 3)), (1, 13), '13 points do not make a chain of 13 nodes'),
    ],
)
def test_clouds_that_are_no_grid(points, size, message):
    shape = grid(1, 13, 1.2) if size == (1, 13) else grid(*size)
    with pytest.raises(FrameError, match=message) as caught:
        find_grid(points, *size, shape)
    assert '\n' not in str(caught.value)


def test_finding_is_independent_of_the_order_of_points():
    shape, rng = grid(), np.random.default_rng(6)
    points = bent(shape, 'sine y') + rng.normal(0, 0.002, (20, 3))
    orders = [rng.permutation(20) for _ in range(5)]
    for order, reverse in product(orders, (1, -1)):
        chosen = order[::reverse]
        np.testing.assert_array_equal(find_grid(points[chosen], 5, 4, shape), chosen)
