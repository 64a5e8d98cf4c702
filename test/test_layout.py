"""A mesh finer than the grid of markers: its numbers, its start, and how well it follows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from cloth_predict.config import build, load, parse_yaml
from cloth_predict.errors import ConfigError
from cloth_predict.formats.bag import read_recording
from cloth_predict.surface.assembly import (
    BETWEEN,
    build_mass_spring,
    mesh_rest_shape,
    on_mesh,
    rest_shape,
    topology_of,
)
from cloth_predict.surface.layout import lay_out
from cloth_predict.surface.topology import delaunay, grid
from cloth_predict.tracker import Tracker
from cloth_predict.tracking.track import Frame, _allowance

ROOT = Path(__file__).parents[1]
MS = 10**6
ROUNDING = 1e-12
"""Numbers near 1, after a few operations."""


def settings(rows=3, cols=3, refine=2, driven=(0, 1, 2), model=None, **groups):
    size = {'rows': rows, 'cols': cols, 'refine': refine, 'width': 0.4, 'height': 0.4}
    values = {'model': {**size, 'mass': 0.05, **(model or {})}, **groups}
    values['anchors'] = {'nodes': list(driven), **values.get('anchors', {})}
    return build(values, 'test')


def laid_out(config):
    surface = rest_shape(config.model)
    return lay_out(config, topology_of(config.model, surface), surface)


def towel(refine, kind='ekf'):
    """The towel with forces of the size that suits the lighter nodes of a finer mesh."""
    config = load(ROOT / 'config' / 'towel.yaml')
    return replace(
        config,
        model=replace(config.model, refine=refine),
        force=replace(config.force, sigma=0.1),
        filter=replace(config.filter, kind=kind),
    )


@pytest.fixture(scope='module')
def recording():
    return read_recording(ROOT / 'bags' / 'towel_fan')


def step(tracker, markers, k):
    seen = markers.visible[k]
    positions = np.where(seen[:, None], markers.positions[k], np.nan)
    return tracker.step(int(markers.stamps[k]), positions, seen)


# --- the two numberings


def test_three_by_three_markers_by_hand():
    """Mesh nodes 0-24 in rows of five; the first row of markers, and so of the mesh, is driven."""
    found = laid_out(settings())
    assert found.nodes == 25
    assert found.markers.tolist() == [0, 2, 4, 10, 12, 14, 20, 22, 24]
    assert found.driven.tolist() == [0, 1, 2]
    assert found.free.tolist() == [3, 4, 5, 6, 7, 8]
    assert found.driven_mesh.tolist() == [0, 1, 2, 3, 4]
    # free mesh nodes are 5-24, so that mesh node 10 is the sixth of them
    assert found.rows[:, 0].tolist() == [15, 21, 27, 45, 51, 57]
    assert found.rows[0].tolist() == [15, 16, 17]
    half = [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]
    np.testing.assert_array_equal(found.drive, half)
    weights = found.interpolation
    assert weights.shape == (20, 6)
    for node, expected in {
        5: {3: 1},  # between markers 0, driven, and 3
        6: {3: 0.5, 4: 0.5},
        11: {3: 0.5, 4: 0.5},
        12: {4: 1},
        16: {3: 0.25, 4: 0.25, 6: 0.25, 7: 0.25},
        23: {7: 0.5, 8: 0.5},
    }.items():
        row = {int(found.free[i]): weights[node - 5, i] for i in np.flatnonzero(weights[node - 5])}
        assert row == expected
    for name, families in grid(5, 5).families.items():
        np.testing.assert_array_equal(found.topology.families[name], families)


def test_shares_are_thirds_of_triangles():
    share = laid_out(settings()).share.reshape(5, 5)
    # a cell of the mesh is a quarter of that of the markers, a triangle half, a corner a third
    third = 1 / 4 / 2 / 3
    np.testing.assert_allclose(share[1:-1, 1:-1], 6 * third, rtol=ROUNDING)
    np.testing.assert_allclose(share[0, 1:-1], 3 * third, rtol=ROUNDING)
    assert share[[0, 0, 4, 4], [0, 4, 0, 4]] == pytest.approx(np.array([1, 2, 2, 1]) * third)
    assert share.sum() == pytest.approx(4)  # cells of markers


@pytest.mark.parametrize('refine', [1, 2, 3])
def test_shares_cover_the_sheet_whatever_the_mesh(refine):
    assert laid_out(settings(4, 3, refine)).share.sum() == pytest.approx(6)


def test_shares_of_chains_and_triangulations():
    assert (laid_out(settings(1, 5, 2, (0,))).share == 0).all()
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.random((12, 2)), np.zeros(12)])
    config = build(
        {'model': {'topology': 'delaunay', 'nodes': 12, 'rest_length': 'measured'}}, 'test'
    )
    joined = delaunay(points)
    found = lay_out(config, joined, points)
    a, b, c = (points[joined.triangles[:, k], :2] for k in range(3))
    areas = np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1))) / 2
    expected = [areas[(joined.triangles == n).any(axis=1)].sum() / 3 for n in range(12)]
    np.testing.assert_allclose(found.share, np.array(expected) / 2 / areas.mean(), rtol=ROUNDING)


def test_only_what_lies_between_driven_markers_is_driven():
    ends = laid_out(settings(driven=(0, 2)))  # marker 1 between them is free
    assert ends.driven_mesh.tolist() == [0, 4]
    np.testing.assert_array_equal(ends.drive, np.eye(2))
    assert ends.interpolation[0, 0] == 1  # mesh node 1 takes the value of marker 1
    down = laid_out(settings(driven=(3, 6)))
    assert down.driven_mesh.tolist() == [10, 15, 20]
    plate = laid_out(settings(driven=(4, 0, 3, 1)))  # a cell held at its four corners
    assert plate.driven.tolist() == [0, 1, 3, 4]
    assert plate.driven_mesh.tolist() == [0, 1, 2, 5, 6, 7, 10, 11, 12]
    np.testing.assert_array_equal(plate.drive[4], 0.25)
    none = laid_out(settings(driven=()))
    assert none.drive.shape == (0, 0)
    assert none.interpolation.shape == (25, 9)


@pytest.mark.parametrize('refine', [2, 3, 5])
def test_between_is_the_bilinear_interpolation(refine):
    found = laid_out(settings(3, 4, refine, ()))
    values = np.random.default_rng(1).normal(size=(3, 4))
    rows, cols = 2 * refine + 1, 3 * refine + 1
    places = np.stack(np.mgrid[:rows, :cols], axis=-1) / refine
    expected = RegularGridInterpolator((np.arange(3), np.arange(4)), values)(
        np.minimum(places, [2, 3])
    )
    np.testing.assert_allclose(found.between @ values.ravel(), expected.ravel(), atol=ROUNDING)
    np.testing.assert_allclose(found.interpolation, found.between, atol=ROUNDING)
    flat = laid_out(settings(3, 4, refine, (0, 1, 2, 3)))
    np.testing.assert_allclose(flat.interpolation.sum(axis=1), 1.0, rtol=ROUNDING)
    # a linear function: below the first free row as it is, above it as in that row
    linear = np.array([[1.0, -2.0]]) @ np.stack([places[..., 0].ravel(), places[..., 1].ravel()])
    linear = linear.reshape(rows, cols)
    free = linear[::refine, ::refine][1:].ravel()
    spread = (flat.interpolation @ free).reshape(-1, cols)
    np.testing.assert_allclose(spread[refine - 1 :], linear[refine:], atol=ROUNDING)
    expected = np.broadcast_to(linear[refine], (refine - 1, cols))
    np.testing.assert_allclose(spread[: refine - 1], expected, atol=ROUNDING)


@pytest.mark.parametrize(('rows', 'cols'), [(3, 4), (1, 5), (5, 1)])
@pytest.mark.parametrize('refine', [1, 2, 3])
def test_markers_lie_on_the_mesh_at_rest(rows, cols, refine):
    config = settings(rows, cols, refine, (0,))
    shape, found = mesh_rest_shape(config.model), laid_out(config)
    np.testing.assert_allclose(shape[found.markers], rest_shape(config.model), atol=ROUNDING)
    np.testing.assert_allclose(found.between @ rest_shape(config.model), shape, atol=ROUNDING)


def test_without_refinement_everything_is_the_identity():
    config = settings(3, 4, 1, (3, 0))
    found, joined = laid_out(config), grid(3, 4)
    np.testing.assert_array_equal(found.markers, np.arange(12))
    np.testing.assert_array_equal(found.driven_mesh, [0, 3])
    np.testing.assert_array_equal(found.rows, np.arange(30).reshape(10, 3))
    for matrix, size in ((found.between, 12), (found.drive, 2), (found.interpolation, 10)):
        np.testing.assert_array_equal(matrix, np.eye(size))
    np.testing.assert_array_equal(found.topology.pairs, joined.pairs)
    with pytest.raises(ValueError, match='read-only'):
        found.drive[0, 0] = 2.0


# --- the model


def test_the_finer_surface_weighs_as_much_and_rests_in_its_shape():
    config = settings(3, 4, 3, (0, 1, 2, 3), model={'gravity': [0.0, 0.0, 0.0]})
    mesh, shape = (
        build_mass_spring(config, rest_shape(config.model)),
        mesh_rest_shape(config.model),
    )
    assert mesh.nodes == 70
    assert mesh.mass.sum() == pytest.approx(0.05)
    assert mesh.driven.tolist() == list(range(10))
    x = np.concatenate([shape[mesh.free].ravel(), np.zeros(180)])
    force = mesh.f(x, mesh.input(shape[mesh.driven]))
    np.testing.assert_allclose(force, 0.0, atol=1e-8)  # m/s^2: 60 N/m by 0.7 g by 1e-16 m, summed


@pytest.mark.parametrize(('flexion', 'expected'), [(-1.0, 0.3), (0.0, 0.0), (0.8, 0.8)])
def test_flexion_may_resist_compression_by_a_share_of_its_own(flexion, expected):
    config = settings(model={'compression': 0.3, 'compression_flexion': flexion})
    springs = build_mass_spring(config, rest_shape(config.model)).springs
    count = [len(pairs) for pairs in grid(5, 5).families.values()]
    share = np.repeat([0.3, 0.3, expected], count)
    short, long = 0.9 * springs.rest_length, 1.1 * springs.rest_length
    np.testing.assert_allclose(springs.stiffness_at(short), share * 60.0, rtol=ROUNDING)
    np.testing.assert_array_equal(springs.stiffness_at(long), 60.0)


# --- the start


def test_nodes_between_the_markers_start_on_the_lines_between_them():
    config = settings()
    surface = rest_shape(config.model) + np.random.default_rng(4).normal(0, 0.02, (9, 3))
    visible = np.ones(9, bool)
    visible[7] = False  # filled in, and so less certain
    tracker = Tracker(config)
    tracker.step(0, np.where(visible[:, None], surface, np.nan), visible)
    now, noise = tracker._track().now, config.filter.measurement_noise
    mean = now.belief.mean[:60].reshape(20, 3)
    sigma = np.sqrt(np.diag(now.belief.cov)[:60:3])
    np.testing.assert_array_equal(mean[[5, 7, 9]], surface[3:6])
    np.testing.assert_allclose(mean[6], (surface[3] + surface[4]) / 2, rtol=ROUNDING)
    np.testing.assert_allclose(
        mean[1], surface[[0, 1, 3, 4]].mean(axis=0), rtol=ROUNDING, atol=ROUNDING
    )
    assert sigma[[5, 7, 9]] == pytest.approx(noise)
    assert sigma[6] == pytest.approx(noise + BETWEEN)
    edge = 0.2  # m
    assert sigma[17] == pytest.approx(noise + edge)  # marker 7 is mesh node 22
    assert sigma[16] == pytest.approx(noise + np.hypot(edge / 2, BETWEEN))
    _, spread = on_mesh(now.layout, surface, np.zeros(9))
    assert np.count_nonzero(spread) == 16


# --- what is shown, and how well it follows


@pytest.mark.parametrize('motion', ['fixed', 'constant_velocity'])
def test_what_is_shown_is_of_the_markers(motion):
    noise = 0.0 if motion == 'fixed' else 1.0
    config = settings(anchors={'motion': motion, 'process_noise': noise})
    tracker, rest = Tracker(config), rest_shape(config.model)
    for k in range(20):
        carried = rest + 0.01 * k * np.array([0.3, 0.0, 0.2])
        tracker.step(10 * MS * k, carried, np.ones(9, bool))
    for shown in (tracker.estimate(), tracker.predict(0.1)):
        for array in (shown.position, shown.velocity, shown.acceleration):
            assert array.shape == (9, 3)
        assert shown.covariance.shape == (9, 3, 3)
        assert (shown.sigma > 0).all()
    assert tracker.triangles.tolist() == grid(3, 3).triangles.tolist()
    track = tracker._track()
    now, held = track.now, track.now.driven.extrapolate(0.05)
    u = now.input(held[0], held[1])
    edge = u[:30].reshape(2, 5, 3)  # positions and velocities of the first row of the mesh
    np.testing.assert_allclose(edge[:, 1::2], (edge[:, :-1:2] + edge[:, 2::2]) / 2, atol=ROUNDING)
    np.testing.assert_array_equal(edge[:, ::2], held[:2])
    held = now.driven.extrapolate(0.0)
    rate = now.model.f(now.belief.mean, now.input(held[0], held[1]))[60:120].reshape(20, 3)
    shown = tracker.estimate()
    np.testing.assert_array_equal(shown.acceleration[3:], rate[[5, 7, 9, 15, 17, 19]])
    np.testing.assert_array_equal(shown.covariance[7], now.belief.cov[51:54, 51:54])


def test_a_finer_mesh_follows_the_towel_and_what_nobody_sees(recording):
    """The simulated nodes are twice as fine as the mesh: every other one is one of its nodes."""
    markers, truth = recording.markers, recording.truth.surface
    tracker = Tracker(towel(2))
    hidden_error, straight, off, held, inside = [], [], [], [], []
    for k in range(250):
        step(tracker, markers, k)
        if k < 100 or k % 5:
            continue
        now, true = tracker._track().now, truth[k, ::2, ::2].reshape(-1, 3)
        layout = now.layout
        mesh, _ = now.mesh.surface(now.belief.mean, now.input(*now.driven.extrapolate(0.0)[:2]))
        hidden = np.setdiff1d(now.mesh.free, layout.markers)
        hidden_error.append((mesh - true)[hidden])
        straight.append((layout.between @ true[layout.markers] - true)[hidden])
        later = truth[k + 10, ::4, ::4].reshape(-1, 3)
        predicted = tracker.predict(0.1)
        error = (predicted.position - later)[4:]
        off.append(error)
        held.append((true[layout.markers] - later)[4:])
        inside.append((np.abs(error) < 2 * predicted.sigma[4:, None]).mean())
    rms = [np.sqrt(np.mean(np.square(e))) for e in (hidden_error, straight, off, held)]
    assert rms[0] < 0.75 * rms[1]  # it knows better than a straight line: 0.63 measured
    assert rms[2] < 0.25 * rms[3]  # by how far the markers go in 0.1 s: 0.20 measured
    assert np.mean(inside) > 0.8  # 0.85 measured; of normal errors it would be 0.954


@pytest.mark.parametrize('kind', ['ekf', 'reduced_rank', 'least_squares', 'ckf', 'ukf'])
def test_filters_that_take_a_finer_mesh(kind):
    """A sheet that falls from rest: its fall is the same for every node."""
    config = settings(
        2, 2, 2, (), filter={'kind': kind, 'window': 0.03, 'measurement_noise': 1e-3}
    )
    rest, tracker = rest_shape(config.model), Tracker(config)
    rng = np.random.default_rng(5)
    for k in range(30):
        fallen = rest + np.array([0.0, -9.81 * (0.01 * k) ** 2 / 2, 0.0])
        tracker.step(10 * MS * k, fallen + rng.normal(0, 1e-3, (4, 3)), np.ones(4, bool))
    assert dict(tracker.counts) == {'started': 1, 'updated': 29}
    expected = rest + np.array([0.0, -9.81 * 0.34**2 / 2, 0.0])
    error = tracker.predict(0.05).position - expected
    assert np.sqrt(np.mean(error**2)) < 5e-3  # m; the mean of a few frames, 0.05 s ahead


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('filter: {kind: fixed_gain}', 'filter.kind fixed_gain needs model.refine 1'),
        (
            'filter: {kind: recursive_least_squares}',
            'filter.kind recursive_least_squares needs model.refine 1',
        ),
        (
            'model: {rest_length: measured}',
            'model.refine: nobody sees the nodes between the markers, so that it needs '
            'rest_length dimensions',
        ),
        (
            'model: {topology: delaunay, nodes: 9, rest_length: measured}',
            'model.refine: has no meaning with topology delaunay',
        ),
        ('model: {refine: 0}', 'model.refine: 0 is out of range, must be at least 1'),
    ],
)
def test_what_does_not_fit_a_finer_mesh_is_refused(text, message):
    values = parse_yaml(text)
    values['model'] = {'refine': 2, **values.get('model', {})}
    with pytest.raises(ConfigError) as error:
        build(values, 'test')
    assert str(error.value) == f'test: {message}'


def test_points_without_labels_are_found_at_the_markers(recording):
    markers, labelled, unlabelled = recording.markers, Tracker(towel(2)), Tracker(towel(2))
    step(unlabelled, markers, 0)
    step(labelled, markers, 0)
    none = np.full((20, 3), np.nan)
    for k in range(1, 15):
        step(labelled, markers, k)
        points = markers.positions[k][markers.visible[k]][::-1]
        found = unlabelled.step(int(markers.stamps[k]), none, np.zeros(20, bool), points)
        np.testing.assert_array_equal(found.visible, markers.visible[k])
    np.testing.assert_allclose(
        unlabelled.estimate().position, labelled.estimate().position, atol=1e-9
    )  # m; the driven nodes are taken in another order


def test_the_gate_of_an_unseen_marker_reaches_its_neighbours_markers():
    frame = Frame(60_000 * MS, np.zeros((9, 3)), np.zeros(9, bool), np.zeros((0, 3)))
    widest = []
    for refine in (1, 2, 3):
        config = settings(refine=refine)
        tracker = Tracker(config)
        tracker.step(0, rest_shape(config.model), np.ones(9, bool))
        widest.append(_allowance(tracker._track(), frame, config))
    np.testing.assert_allclose(widest[1:], [widest[0]] * 2, rtol=ROUNDING)
