"""From the markers of one frame to a body: moments, the fit of pose and shape, what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swinging_body import MARKERS, SHAPE, Feed, Swinging, settings

from cloth_predict.bodies.global_fit import global_fit
from cloth_predict.bodies.moments import ellipsoid
from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.superquadric_shape import PARAMETERS, check_parameters, positions
from cloth_predict.tracker import Tracker

FREE = np.ones(11, bool)


def placed(points, seed=0):
    """Points turned and moved at random, with the motion."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    centre = np.random.default_rng(seed).normal(size=3)
    return points @ rotation.T + centre, rotation, centre


# --- moments


def test_an_ellipsoid_is_found_by_its_moments():
    axes = np.array([0.1, 0.15, 0.25])
    points, rotation, centre = placed(ClosedMesh.even(2000).directions * axes)
    found = ellipsoid(points)
    np.testing.assert_allclose(found.centre, centre, atol=1e-4)  # the lattice is even to 1e-4
    np.testing.assert_allclose(found.semi_axes, axes, rtol=1e-3)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    # each axis but for its sign, the longest is z
    np.testing.assert_allclose(np.abs(found.rotation.T @ rotation), np.eye(3), atol=1e-3)
    np.testing.assert_allclose(found.in_axes(points + found.rotation[:, 2] * 0.25)[:, 2],
                               found.in_axes(points)[:, 2] + 1.0, atol=1e-3)  # fmt: skip


def test_its_parameters_are_those_of_a_superquadric():
    axes = np.array([0.1, 0.15, 0.25])
    guess = ellipsoid(ClosedMesh.even(500).directions * axes)
    check_parameters(guess.parameters)
    mesh = ClosedMesh.even(50)
    expected = mesh.directions * guess.semi_axes
    np.testing.assert_allclose(positions(guess.parameters, mesh.coordinates), expected, atol=1e-12)


@pytest.mark.parametrize(
    ('spread', 'where'), [((1.0, 0.0, 0.0), 'on a line'), ((1.0, 0.5, 0.0), 'in a plane')]
)
def test_points_on_a_line_or_in_a_plane_are_no_body(spread, where):
    flat = np.random.default_rng(0).normal(size=(20, 3)) * spread
    with pytest.raises(FrameError, match=f'all 20 points lie {where}'):
        ellipsoid(placed(flat)[0])


# --- pose and shape


def test_a_superquadric_is_fitted_to_points_of_its_surface():
    theta = np.array([0.9, 0.1, -0.4, 0.1]) / np.linalg.norm([0.9, 0.1, -0.4, 0.1])
    rotation = Rotation.from_quat([*theta[1:], theta[0]]).as_matrix()
    points = positions(SHAPE, ClosedMesh.even(80).coordinates) @ rotation.T + [1.0, 2.0, 3.0]
    guess = ellipsoid(points)
    begin = np.concatenate([guess.centre, theta + 0.05, guess.parameters])
    found = global_fit(begin, FREE, points)
    dense = ClosedMesh.even(3000)
    turn = Rotation.from_quat([*found.shared[4:7], found.shared[3]]).as_matrix()
    surface = positions(found.shared[7:], dense.coordinates) @ turn.T + found.shared[:3]
    off = nearest_on_surface(points, surface, dense.triangles).place - points
    # 0.5 % of the size: what is unsure stays near the guess; the mesh is coarser by 0.1 %
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.005 * SHAPE[0]
    np.testing.assert_allclose(np.linalg.norm(found.shared[3:7]), 1.0, rtol=1e-12)


def test_what_is_fixed_stays_as_it_was():
    points, *_ = placed(positions(SHAPE, ClosedMesh.even(80).coordinates))
    guess = ellipsoid(points)
    begin = np.concatenate([guess.centre, [1.0, 0.0, 0.0, 0.0], guess.parameters])
    free = ~np.isin(PARAMETERS, ('a0', 'e1', 'b3'))
    found = global_fit(begin, free, points).shared
    np.testing.assert_array_equal(found[7:][~free], begin[7:][~free])
    assert (found[7:][free] != begin[7:][free]).all()


# --- the first frame


def started(points=None, labels=0, **changes):
    """A tracker after a first frame."""
    tracker = Tracker(settings(**changes))
    feed = Feed(tracker, Swinging(), named=range(labels))
    positions, visible, seen = feed.made(0)
    tracker.step(0, positions, visible, seen if points is None else points)
    return tracker


def surface_error(tracker, time=0.0):
    """RMS distance [m] of true points from the estimated surface."""
    true, now = Swinging().surface(time), tracker.estimate()
    off = nearest_on_surface(true, now.position, tracker.triangles).place - true
    return np.sqrt(np.mean(np.sum(off**2, axis=1)))


@pytest.mark.parametrize('mesh', ['even', 'markers'])
def test_the_first_frame_gives_the_surface(mesh):
    tracker = started(body__mesh=mesh)
    assert tracker.started
    # markers are 6 cm apart on a body of 0.36 m
    assert surface_error(tracker) < 2.5e-3
    normal, triangles = tracker.estimate().normal, tracker.triangles
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-9)
    corner = tracker.estimate().position[triangles]
    outward = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    volume = np.einsum('ti,ti->', corner[:, 0], outward) / 6.0
    true = ClosedMesh.even(800)
    corner = Swinging().surface(0.0)[true.triangles]
    exact = np.linalg.det(corner).sum() / 6.0
    assert volume == pytest.approx(exact, rel=0.03)
    assert (np.einsum('ti,tci->tc', outward, normal[triangles]) > 0).all()


def test_ghosts_far_from_the_others_are_left_out():
    tracker = Tracker(settings())
    feed, ghosts = Feed(tracker, Swinging()), [[1.5, 1.2, 0.0], [0.3, 2.0, 0.4]]
    step = feed(0, more=ghosts)
    assert (step.markers['matched'], step.markers['ghosts']) == (MARKERS, 2)
    assert surface_error(tracker) < 2.5e-3


def test_a_given_shape_is_where_it_starts_from():
    tracker = started(body__initial=SHAPE.tolist(), body__fixed=list(PARAMETERS))
    np.testing.assert_array_equal(tracker.belief.mean[7:18], SHAPE)


def refused(tracker):
    with pytest.raises(FrameError) as caught:
        tracker.predict(0.1)
    assert str(caught.value) == tracker.health().text
    return str(caught.value).removeprefix('no surface yet: ')


def test_fewer_points_than_global_parameters():
    points = Swinging().markers(0.0)
    assert refused(started(points[:10])) == (
        '10 markers, fewer than the 11 global parameters of a body (those in body.fixed do not '
        'count)'
    )
    assert started(points[:10], body__fixed=['b1', 'b2', 'b3']).started
    assert refused(started(points[:0])).startswith('0 markers')


def test_points_on_a_line():
    line = np.outer(np.linspace(0.0, 1.0, 15), [0.3, 0.2, 0.1])
    assert refused(started(line)) == 'all 15 points lie on a line: they show no body'
    assert refused(started(np.zeros((15, 3)))) == 'all 15 points lie on a line: they show no body'


def test_a_point_that_is_not_a_number():
    points = Swinging().markers(0.0)
    points[7, 1] = np.nan
    with pytest.raises(FrameError, match='point 7 has a coordinate that is not finite'):
        started(points)


# --- nodes that are markers


def test_a_node_for_each_marker_in_the_order_of_the_labels():
    tracker = Tracker(settings(model__nodes=MARKERS, body__nodes=0))
    feed = Feed(tracker, Swinging(), named=range(MARKERS))
    shown = np.arange(MARKERS) != 5
    feed(0, shown)
    assert refused(tracker) == f'{MARKERS - 1} of {MARKERS} markers seen, of which each is a node'
    feed(1)
    expected = Swinging().markers(0.01)
    np.testing.assert_allclose(tracker.estimate().position, expected, atol=2e-3)  # 6 sigma
    assert np.abs(tracker.estimate().position - expected).mean() < 5e-4


def test_more_markers_than_nodes():
    assert refused(started(body__nodes=50)) == (
        '60 markers, but body.mesh markers has a node for each, and there are 50 nodes'
    )


# --- parameters


@pytest.mark.parametrize(
    ('changes', 'told'),
    [
        ({2: 1.2}, 'a2 is 1.2, expected a number from 0.001 to 1'),
        ({4: -0.1}, 'e1 is -0.1, expected a number from 0 to 2'),
        ({10: 0.0}, 'b3 is 0, expected a number from 0.001 to 1'),
    ],
)
def test_a_shape_that_is_none(changes, told):
    shape = [changes.get(k, value) for k, value in enumerate(SHAPE.tolist())]
    with pytest.raises(ConfigError) as caught:
        Tracker(settings(body__initial=shape))
    assert str(caught.value) == f'body.initial: superquadric: {told}'


def test_a_shape_of_too_few_parameters():
    with pytest.raises(ConfigError, match=r'body\.initial: a superquadric has 11 parameters'):
        Tracker(settings(body__initial=[0.2, 1.0]))


def test_a_parameter_that_there_is_not():
    with pytest.raises(ConfigError, match=r"body\.fixed: 'a4' is no global parameter; they are"):
        Tracker(settings(body__fixed=['a4']))
