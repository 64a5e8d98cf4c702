"""The start: what it waits for, calibrated rest lengths, and markers without labels."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import build, load
from cloth_predict.formats.recording import read
from cloth_predict.markers.labelling import follow, label
from cloth_predict.models.springs import grid_pairs
from cloth_predict.surface.assembly import lengths_of, rest_shape
from cloth_predict.surface.calibration import filled_in, median_lengths
from cloth_predict.surface.starting import Starter
from cloth_predict.surface.topology import delaunay, of_edges

ROOT = Path(__file__).parents[1]
MS = 10**6
NONE = np.zeros((0, 3))
SIGMA = 1e-3
"""Noise [m] of a coordinate of a marker."""


def settings(model=None, **groups):
    """A 3 x 3 surface that hangs from its first row, unless the model says otherwise."""
    sheet = {'rows': 3, 'cols': 3, 'width': 0.4, 'height': 0.4, 'rest_length': 'measured'}
    return build({'model': model or sheet, **groups}, 'test')


def of_kind(kind, rest_length='calibrated', **more):
    """A sheet, a chain or a triangulation without driven nodes, and its true shape [m]."""
    if kind == 'sheet':
        config = build({'model': {'rest_length': rest_length, **more}}, 'test')
        return config, rest_shape(config.model)
    if kind == 'chain':
        size = {'rows': 1, 'cols': 9, 'width': 0.9}
        config = build({'model': {**size, 'rest_length': rest_length, **more}}, 'test')
        return config, rest_shape(config.model)
    mesh = {'topology': 'delaunay', 'nodes': 20, 'rest_length': rest_length}
    flat = np.random.default_rng(8).uniform(0, 0.6, (20, 2))
    return build({'model': mesh | more}, 'test'), np.column_stack([flat, flat[:, 0] ** 2])


def rigid(shape, frames, seed=0, rate=100):
    """Stamps [ns] and noisy positions [m] of a shape that is carried about and turned."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / rate
    turn = Rotation.from_rotvec(np.outer(np.sin(2 * time), [0.5, -0.3, 0.8]))
    moved = np.stack([turn[k].apply(shape) for k in range(frames)])
    moved += 0.3 * np.sin(3 * time)[:, None, None] * np.array([1.0, 0.5, -0.7])
    return (time * 1e9).round().astype(int), moved + rng.normal(0, SIGMA, moved.shape)


def offered(starter, stamps, positions, visible=None):
    """Offer labelled frames until there is a start; returns it and the number of frames."""
    for k, stamp in enumerate(stamps.tolist()):
        seen = np.ones(positions.shape[1], bool) if visible is None else visible[k]
        start = starter.offer(stamp, np.where(seen[:, None], positions[k], np.nan), seen, NONE)
        if start is not None:
            return start, k + 1
    return None, len(stamps)


def surface(start):
    """Positions [m] of all nodes at the start."""
    found = np.zeros((start.mesh.nodes, 3))
    found[start.mesh.free] = start.belief.mean[: 3 * len(start.mesh.free)].reshape(-1, 3)
    found[start.mesh.driven] = start.driven.extrapolate(0.0)[0]
    return found


# --- what it waits for -----------------------------------------------------------------------


def test_the_reason_says_what_is_lacking():
    starter = Starter(settings(anchors={'nodes': [0, 2]}))
    positions = rest_shape(starter._config.model)
    for hidden, reason in (
        (range(9), '0 of 3 x 3 = 9 nodes seen, waiting for the driven nodes 0, 2'),
        ([0, 5], '7 of 3 x 3 = 9 nodes seen, waiting for the driven node 0'),
        ([1, 3, 4, 5, 6, 7, 8], '2 of 3 x 3 = 9 nodes seen, waiting for 3'),
    ):
        visible = ~np.isin(np.arange(9), list(hidden))
        assert starter.offer(0, positions, visible, NONE) is None
        assert starter.reason == reason
    assert starter.offer(0, positions, np.ones(9, bool), NONE) is not None
    assert starter.reason == ''


def test_a_triangulation_waits_for_all_its_markers_by_label():
    mesh = {'topology': 'delaunay', 'rest_length': 'measured'}
    labels = [f'm{k}' for k in range(8)]
    starter = Starter(build({'labels': labels, 'model': mesh}, 'test'))
    positions = np.random.default_rng(0).uniform(size=(8, 3)) * [1, 1, 0.1]
    visible = np.arange(8) < 2
    assert starter.offer(0, positions, visible, NONE) is None
    assert starter.reason == '2 of 8 nodes seen, waiting for nodes m2, m3, m4, m5, 2 more'
    assert starter.offer(0, positions, visible, positions[2:]) is None  # nothing tells which
    assert starter.reason == '2 of 8 nodes seen, waiting for nodes m2, m3, m4, m5, 2 more'
    start = starter.offer(1, positions, np.ones(8, bool), NONE)
    np.testing.assert_array_equal(start.topology.edges, delaunay(positions).edges)
    assert len(start.mesh.driven) == 0
    np.testing.assert_array_equal(surface(start), positions)


def test_a_mesh_of_edges_starts_with_hidden_nodes_and_usual_lengths():
    flat = [n for k in range(7) for n in (k, k + 1)]
    mesh = {'topology': 'edges', 'nodes': 8, 'edges': flat, 'rest_length': 'measured'}
    positions, visible = np.outer(np.arange(8.0), [0.0, 0.1, 0.0]), np.arange(8) != 7
    start = Starter(settings(mesh)).offer(0, positions, visible, NONE)
    # a straight chain goes on straight, but for 1e-6 of an edge
    np.testing.assert_allclose(surface(start), positions, atol=1e-6)
    rest = start.mesh.springs.rest_length
    np.testing.assert_allclose(rest[:7], 0.1, rtol=1e-12)  # rounding
    np.testing.assert_allclose(rest[7:], 0.2, rtol=1e-12)


# --- calibration -----------------------------------------------------------------------------


def error_of(start, shape):
    """Root mean square error of the rest lengths [m]."""
    true = lengths_of(start.mesh.springs.pairs, shape)
    return np.sqrt(np.mean(np.square(start.mesh.springs.rest_length - true)))


@pytest.mark.parametrize('kind', ['sheet', 'chain', 'mesh'])
@pytest.mark.parametrize('dropped', [0.0, 0.3])
def test_calibrated_lengths_are_nearer_to_the_truth(kind, dropped):
    squared = np.zeros(2)
    for seed in range(6):
        config, shape = of_kind(kind)
        stamps, positions = rigid(shape, 250, seed)
        visible = np.random.default_rng(seed).random(positions.shape[:2]) >= dropped
        visible[0] = True
        start, frames = offered(Starter(config), stamps, positions, visible)
        assert frames == 201  # 2 s at 100 Hz, the first frame included
        measured, _ = offered(Starter(of_kind(kind, 'measured')[0]), stamps, positions, visible)
        squared += [error_of(measured, shape) ** 2, error_of(start, shape) ** 2]
    # a median has pi / 2 times the variance of a mean, over the frames that show both ends
    expected = np.sqrt(201 * (1 - dropped) ** 2 / (np.pi / 2))
    # of 90 lengths at least, of which a chain's neighbours share their ends: the RMS of either
    # has a standard deviation of some 10 %
    assert 0.65 * expected < np.sqrt(squared[0] / squared[1]) < 1.5 * expected


def test_the_median_of_a_length_leaves_out_frames_that_lack_an_end():
    rng = np.random.default_rng(3)
    positions, visible = rng.normal(size=(40, 6, 3)), rng.random((40, 6)) < 0.5
    visible[:, 5] = False
    pairs = np.array([[0, 1], [2, 4], [3, 5], [1, 4]])
    found = median_lengths(pairs, np.where(visible[..., None], positions, np.nan), visible)
    for length, (i, j) in zip(found.tolist(), pairs.tolist(), strict=True):
        each = [
            np.linalg.norm(p[i] - p[j])
            for p, v in zip(positions, visible, strict=True)
            if v[i] and v[j]
        ]
        expected = np.median(each) if each else np.nan
        np.testing.assert_allclose(length, expected, rtol=1e-14)  # rounding of the norm


def test_unknown_lengths_of_a_mesh_are_the_usual_ones_of_their_family():
    joined = of_edges(5, np.array([[0, 1], [1, 2], [2, 3], [3, 4]]))
    nan, shape = np.nan, np.outer(np.arange(5.0), [1, 0, 0])
    given = np.array([1.0, 5.0, nan, 3.0, nan, nan, nan])
    found = filled_in(given, joined, shape)
    assert found.tolist() == [1.0, 5.0, 3.0, 3.0, 2.0, 2.0, 2.0]  # and what the surface shows
    assert np.isnan(given[2])  # inputs are not written to


def test_calibration_starts_anew_after_a_jump_in_time_and_ignores_late_frames():
    config, shape = of_kind('sheet', calibration=0.5)
    stamps, positions = rigid(shape, 200)
    starter, seen = Starter(config), np.ones(20, bool)

    def offer(k, shift=0):
        return starter.offer(int(stamps[k]) + shift, positions[k], seen, NONE)

    for k in range(30):
        assert offer(k) is None
    assert starter.reason == 'calibrating: 0.29 of 0.5 s'
    assert offer(10) is None  # late, by 190 ms
    assert starter.reason == 'calibrating: 0.29 of 0.5 s'
    jump = 5 * 10**9
    for k in range(30, 80):
        assert offer(k, jump) is None
    assert starter.reason == 'calibrating: 0.49 of 0.5 s'
    start = offer(80, jump)
    pairs = start.mesh.springs.pairs
    expected = np.median(lengths_of(pairs, positions[30:81]), axis=0)
    np.testing.assert_array_equal(start.mesh.springs.rest_length, expected)
    # what is known is known: no second calibration
    again = offer(100, 2 * jump)
    np.testing.assert_array_equal(again.mesh.springs.rest_length, expected)
    np.testing.assert_array_equal(surface(again), positions[100])


def test_hidden_nodes_at_the_end_of_calibration_are_carried_along():
    noise = {'measurement_noise': SIGMA, 'initial_velocity': 0.5}
    mesh = {'topology': 'delaunay', 'nodes': 20, 'rest_length': 'calibrated', 'calibration': 0.5}
    config = build({'model': mesh, 'filter': noise}, 'test')
    stamps, positions = rigid(of_kind('mesh')[1], 60)
    visible = np.ones((60, 20), bool)
    visible[45:, 4] = visible[10:, 7] = False  # for 60 and for 410 ms
    start, frames = offered(Starter(config), stamps, positions, visible)
    assert frames == 51
    found, variance = surface(start), np.diag(start.belief.cov)[:60].reshape(20, 3)
    assert np.linalg.norm(positions[50, 4] - positions[44, 4]) > 0.01
    # carried along rigidly: three times the noise of the marker and of what it is aligned with
    assert np.linalg.norm(found[4] - positions[50, 4]) < 3 * 3**0.5 * SIGMA
    # 0.5 m/s for 60 ms; the other could have gone 0.2 m, farther than an edge
    np.testing.assert_allclose(variance[4] ** 0.5, SIGMA + 0.03, rtol=1e-9)
    edge = np.median(lengths_of(start.topology.edges, positions[50]))
    np.testing.assert_allclose(variance[7] ** 0.5, SIGMA + edge, rtol=0.05)  # one is filled in


# --- markers without labels ------------------------------------------------------------------


TOWEL = load(ROOT / 'config' / 'towel_coarse.yaml')


@pytest.fixture(scope='module')
def towel():
    """The first frames of the shipped recording that show all markers."""
    markers = read(ROOT / 'bags' / 'towel_fan').markers
    whole = np.flatnonzero(markers.visible.all(axis=1))[[0, 1, 10, 20]]
    return markers.stamps[whole], markers.positions[whole]


def unlabelled(positions, missing, ghosts, rng):
    """Points in random order: without the missing nodes, and with ghosts 0.1 m off and more."""
    around = rng.uniform(positions.min(axis=0) - 0.2, positions.max(axis=0) + 0.2, (80, 3))
    far = np.linalg.norm(around[:, None] - positions, axis=2).min(axis=1) > 0.1
    return rng.permutation(
        np.vstack([np.delete(positions, missing, axis=0), around[far][:ghosts]])
    )


@pytest.mark.parametrize('frame', range(4))
@pytest.mark.parametrize('missing', [(), (9,), (19,), (5, 14)])
@pytest.mark.parametrize('ghosts', [0, 2])
def test_the_towel_starts_without_labels(towel, frame, missing, ghosts):
    stamps, positions = towel
    points = unlabelled(positions[frame], missing, ghosts, np.random.default_rng(frame))
    hidden = np.full((20, 3), np.nan), np.zeros(20, bool)
    start = Starter(TOWEL).offer(int(stamps[frame]), *hidden, points)
    seen = np.delete(np.arange(20), missing)
    np.testing.assert_array_equal(surface(start)[seen], positions[frame][seen])


def test_a_driven_node_has_to_be_among_the_points(towel):
    points = np.delete(towel[1][0], 2, axis=0)
    starter = Starter(TOWEL)
    assert starter.offer(0, np.full((20, 3), np.nan), np.zeros(20, bool), points) is None
    assert starter.reason == '19 of 5 x 4 = 20 nodes seen, waiting for the driven node 2'


@pytest.mark.parametrize('turn', [0, 180])
def test_labels_decide_where_the_shape_alone_does_not(towel, turn):
    positions = Rotation.from_euler('z', turn, degrees=True).apply(towel[1][0])
    visible = np.isin(np.arange(20), [3, 8])
    points = np.random.default_rng(1).permutation(positions[~visible])
    found, there = label(TOWEL.model, positions, visible, points)
    assert there.all()
    np.testing.assert_array_equal(found, positions)
    start = Starter(TOWEL).offer(0, positions, visible, points)
    np.testing.assert_array_equal(surface(start), positions)


def test_labels_that_contradict_the_shape_are_not_mixed_with_it(towel):
    positions = towel[1][0].copy()
    positions[[5, 14]] = positions[[14, 5]]
    visible = np.arange(20) < 18
    starter = Starter(TOWEL)
    start = starter.offer(0, positions, visible, positions[18:])
    # with labels enough they alone are taken
    np.testing.assert_array_equal(surface(start)[:18], positions[:18])
    assert not np.array_equal(surface(start)[18:], positions[18:])
    visible[3] = False
    assert starter.offer(10**9, positions, visible, positions[[3, 18, 19]]) is None
    assert 'labelled as node 5 lies at node 14' in starter.reason


def test_a_label_is_believed_where_the_shape_has_no_node(towel):
    positions, visible = towel[1][0].copy(), np.isin(np.arange(20), [0, 1, 13])
    positions[13] += [0.1, 0.0, 0.4]
    found, there = label(TOWEL.model, positions, visible, positions[~visible])
    assert there.all()
    np.testing.assert_array_equal(found, positions)


def test_a_failed_search_is_not_repeated_at_once(towel, monkeypatch):
    calls = []
    monkeypatch.setattr(
        'cloth_predict.surface.starting.label', lambda *args: calls.append(1) or label(*args)
    )
    starter, nothing = Starter(TOWEL), (np.full((20, 3), np.nan), np.zeros(20, bool))
    for k in range(61):
        assert starter.offer(k * 10 * MS, *nothing, towel[1][0][:13]) is None
    assert len(calls) == 3  # at 0, 250 and 500 ms
    assert starter.reason.startswith('13 markers do not fit 5 x 4 = 20 nodes: ')
    assert starter.offer(0, *nothing, towel[1][0]) is not None  # time has gone back


@pytest.mark.parametrize(
    ('config', 'points', 'reason'),
    [
        (of_kind('mesh')[0], 13, '13 markers without labels do not fit 20 nodes: topology '
         'delaunay takes them in the order in which they come'),
        (settings({'topology': 'edges', 'nodes': 3, 'edges': [0, 1, 1, 2],
                   'rest_length': 'measured'}), 3, '3 markers without labels for 3 nodes: '
         'topology edges needs labels'),
        (settings(), 4, '4 markers do not fit 3 x 3 = 9 nodes: 4 points are too few for 3 x 3 '
         'nodes'),
    ],
)  # fmt: skip
def test_points_that_cannot_be_nodes(config, points, reason):
    starter, nodes = Starter(config), config.model.count
    nothing = np.full((nodes, 3), np.nan), np.zeros(nodes, bool)
    cloud = np.random.default_rng(0).uniform(size=(points, 3))
    assert starter.offer(0, *nothing, cloud) is None
    assert starter.reason == reason


def test_a_triangulation_takes_points_in_their_order():
    config, shape = of_kind('mesh', 'measured')
    nothing = np.full((20, 3), np.nan), np.zeros(20, bool)
    start = Starter(config).offer(0, *nothing, shape)
    np.testing.assert_array_equal(surface(start), shape)


def test_points_are_followed_during_calibration():
    config, shape = of_kind('sheet', calibration=0.5)
    stamps, positions = rigid(shape, 60)
    starter, rng = Starter(config), np.random.default_rng(2)
    nothing = np.full((20, 3), np.nan), np.zeros(20, bool)
    for k in range(51):
        missing = rng.permutation(20)[: 2 if 0 < k < 50 else 0]
        points = unlabelled(positions[k], missing, 1 if 0 < k < 50 else 0, rng)
        start = starter.offer(int(stamps[k]), *nothing, points)
    np.testing.assert_array_equal(surface(start), positions[50])
    # the error of a measured length is 1.4 mm; the median of some 41 frames that show both ends
    # has 1.25 / 6.4 of it, with 55 springs within 25 % of that
    assert error_of(start, shape) < 1.25 * 2**0.5 * SIGMA * 1.25 / 41**0.5


def test_following_takes_no_point_that_is_far():
    edges, before = grid_pairs(1, 4)['structural'], np.outer(np.arange(4.0), [0.1, 0, 0])
    positions, visible = np.full((4, 3), np.nan), np.arange(4) == 0
    positions[0] = before[0]
    points = before[[3, 1, 2]] + [[0.039, 0, 0], [0, 0.041, 0], [0, 0, 0.02]]
    found, there = follow(before, edges, positions, visible, points)
    assert there.tolist() == [True, False, True, True]  # 0.4 of 0.1 m
    np.testing.assert_array_equal(found[[2, 3]], points[[2, 0]])
    assert np.isnan(positions[1:]).all()  # inputs are not written to
