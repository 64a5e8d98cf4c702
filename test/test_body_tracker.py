"""A body followed live: markers without labels, ghosts, absences, late frames, and found again."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swinging_body import FRAME, MARKERS, SIGMA, Feed, Swinging, settings
from test_body_start import surface_error

from cloth_predict.bodies.registration import aligned, registered
from cloth_predict.bodies.surface_distance import nearest_on_surface
from cloth_predict.config import load
from cloth_predict.errors import FrameError, UncertainError
from cloth_predict.filters.family import BODY_FILTERS
from cloth_predict.formats.recording import read
from cloth_predict.models.superquadric_shape import PARAMETERS
from cloth_predict.tracker import Tracker

ROOT = Path(__file__).parents[1]
BODY = Swinging()


def followed(frames, labels=0, seed=0, **changes):
    """A tracker after some frames, and what feeds it."""
    tracker = Tracker(settings(**changes))
    feed = Feed(tracker, BODY, seed, named=range(labels))
    for frame in range(frames):
        feed(frame)
    return tracker, feed


def attached(tracker):
    return tracker._track().attached


def off_ahead(tracker, frame, horizon=0.1):
    """Distances [m] of true points from the surface that is predicted."""
    true, found = BODY.surface(frame * FRAME / 1e9 + horizon), tracker.predict(horizon)
    return np.linalg.norm(
        nearest_on_surface(true, found.position, tracker.triangles).place - true, axis=1
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


# --- points without labels


@pytest.mark.parametrize('mesh', ['even', 'markers'])
def test_a_body_is_followed_by_points_without_labels(mesh):
    tracker, feed = followed(100, body__mesh=mesh)
    held, ahead, inside = [], [], []
    for frame in range(100, 180):
        step = feed(frame)
        assert step.markers['matched'] == MARKERS
        if frame % 8 == 0:
            true = BODY.surface(frame * FRAME / 1e9 + 0.1)
            now = tracker.estimate().position
            held.append(nearest_on_surface(true, now, tracker.triangles).place - true)
            ahead.append(off_ahead(tracker, frame))
            inside.append(ahead[-1] < 3.0 * tracker.predict(0.1).sigma.mean())
    assert surface_error(tracker, frame * FRAME / 1e9) < 2.5e-3
    hold = rms(np.linalg.norm(np.concatenate(held), axis=1))
    assert rms(np.concatenate(ahead)) < 0.3 * hold  # of a motion with 0.35 m/s
    assert np.mean(inside) > 0.95


def test_the_same_frames_give_the_same_bytes():
    first, second = (followed(8)[0].predict(0.1) for _ in range(2))
    for name in ('position', 'velocity', 'acceleration', 'covariance', 'normal'):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_what_a_step_tells_is_where_the_nodes_are():
    tracker, feed = followed(20)
    step = feed(20)
    found = tracker.estimate()
    assert step.visible.sum() == MARKERS
    off = (step.positions - found.position)[step.visible]
    assert 0.2 * SIGMA < rms(off) < 2.0 * SIGMA
    assert np.isnan(step.positions[~step.visible]).all()
    assert len(step.innovation.residual) == 3 * MARKERS


def test_velocity_is_the_change_of_the_position():
    tracker, _ = followed(30)
    now, soon = tracker.predict(0.05), tracker.predict(0.05 + 1e-5)
    np.testing.assert_allclose(
        (soon.position - now.position) / 1e-5,
        now.velocity,
        atol=1e-4,  # acceleration x 1e-5
    )
    assert np.abs(now.velocity).max() > 0.1


@pytest.mark.parametrize('kind', BODY_FILTERS)
def test_every_filter_of_bodies(kind):
    few = {'model__nodes': 40, 'body__nodes': 10, 'body__mesh': 'even', 'filter__kind': kind}
    tracker, feed = followed(12, **few, limits__sigma_error=1.0)
    for frame in range(12, 16):
        feed(frame)
    assert tracker.counts['updated'] == 15
    assert rms(off_ahead(tracker, 15, 0.02)) < 0.02


def test_inertial_forces_take_short_steps():
    few = {'model__nodes': 40, 'body__nodes': 10, 'body__mesh': 'even', 'body__inertial': True}
    found = [
        followed(4, **few, limits__sigma_error=1.0, filter__predict_step=step)[0].predict(0.04)
        for step in (0.005, 0.01, 0.02)
    ]
    fine, middle, coarse = (surface.position for surface in found)
    ratio = np.abs(coarse - fine).max() / np.abs(middle - fine).max()
    assert ratio == pytest.approx(5.0, rel=0.2)  # 16 - 1 by 4 - 1: the step is of second order


# --- labels


@pytest.mark.parametrize('mesh', ['even', 'markers'])
def test_labels_stay_with_their_nodes(mesh):
    tracker, feed = followed(2, labels=MARKERS, body__mesh=mesh, body__reattach=0.05)
    first = attached(tracker)
    np.testing.assert_array_equal(np.sort(first.label), np.arange(MARKERS))
    for frame in range(2, 40):
        feed(frame, np.full(MARKERS, not 10 <= frame < 20))
    after = attached(tracker)
    np.testing.assert_array_equal(after.label, first.label)
    np.testing.assert_array_equal(after.node, first.node)
    np.testing.assert_array_equal(after.offset, first.offset)


def test_swapped_labels_are_put_right():
    tracker, feed = followed(20, labels=MARKERS)
    positions, visible, points = feed.made(20)
    positions[[3, 40]] = positions[[40, 3]]
    step = tracker.step(20 * FRAME, positions, visible, points)
    assert (step.markers['relabelled'], step.markers['rejected']) == (2, 0)
    assert rms(off_ahead(tracker, 20)) < 0.02


def test_a_label_that_comes_later_gets_a_node():
    tracker, feed = followed(0, labels=MARKERS)
    late = np.arange(MARKERS) != 7
    for frame in range(10):
        feed(frame, late)
    assert 7 not in attached(tracker).label
    feed(10)
    (row,) = np.flatnonzero(attached(tracker).label == 7)
    place = tracker._track().places[row]
    np.testing.assert_allclose(place, BODY.markers(0.1)[7], atol=3e-3)


# --- points that come and go


def test_a_ghost_is_no_marker():
    tracker, feed = followed(20)
    clean, _ = followed(21)
    step = feed(20, more=[[0.3, 1.2, 0.6], BODY.markers(0.2)[4] + [0.0, 0.02, 0.02]])
    assert (step.markers['matched'], step.markers['ghosts']) == (MARKERS, 2)
    assert len(attached(tracker)) == MARKERS
    np.testing.assert_array_equal(tracker.estimate().position, clean.estimate().position)


def test_a_new_marker_on_the_surface_is_attached_when_it_stays():
    tracker, feed = followed(20, body__mesh='even')
    extra = BODY.surface

    def point(frame):
        return extra(frame * FRAME / 1e9)[400]

    feed(20, more=point(20))
    assert len(attached(tracker)) == MARKERS
    for frame in range(21, 30):
        step = feed(frame, more=point(frame))
    assert len(attached(tracker)) == MARKERS + 1
    assert step.markers['matched'] == MARKERS + 1
    np.testing.assert_allclose(tracker._track().places[-1], point(29), atol=2e-3)


def test_a_marker_that_is_gone_is_forgotten_in_time():
    tracker, feed = followed(10, body__reattach=0.1)
    shown = np.arange(MARKERS) != 9
    for frame in range(10, 40):
        feed(frame, shown)
    assert len(attached(tracker)) == MARKERS - 1
    for frame in range(40, 44):
        feed(frame)
    assert len(attached(tracker)) == MARKERS


# --- a body that is hidden


def test_a_body_hidden_for_a_second_is_carried_on_and_found_again():
    tracker, feed = followed(100)
    nobody, refused = np.zeros(MARKERS, bool), 0
    moved = tracker.predict(0.05).position
    for frame in range(100, 200):
        step = feed(frame, nobody)
        assert step.outcome == 'updated'
        if frame == 104:
            # hidden nodes are put where the membrane is at rest at each frame
            np.testing.assert_allclose(tracker.estimate().position, moved, atol=1e-4)
        try:
            tracker.predict(0.1)
        except UncertainError:
            refused += 1
    assert 50 < refused < 100
    assert 'sigma' in tracker.health().text
    nodes = attached(tracker).node
    step = feed(200)
    assert (step.outcome, step.markers['matched']) == ('restarted', MARKERS)
    assert tracker.counts['lost'] == 1
    for frame in range(201, 230):
        feed(frame)
    np.testing.assert_array_equal(np.sort(attached(tracker).node), np.sort(nodes))
    assert surface_error(tracker, 2.29) < 2.5e-3
    assert rms(off_ahead(tracker, 229)) < 0.02


def test_most_of_a_body_is_enough_to_find_it():
    tracker, feed = followed(60)
    for frame in range(60, 130):
        feed(frame, np.zeros(MARKERS, bool))
    step = feed(130, np.arange(MARKERS) < 50)
    assert (step.outcome, step.markers['matched']) == ('restarted', 50)
    for frame in range(131, 150):
        feed(frame)
    assert surface_error(tracker, 1.49) < 2.5e-3


def test_a_soft_body_is_found_again_though_it_came_back_in_another_shape():
    """The balloon of the package without labels: after a second no rigid motion lays it there."""
    recording, own = read(ROOT / 'bags/balloon'), load(ROOT / 'config/balloon.yaml')
    tracker, markers = Tracker(own), recording.markers
    nobody, nowhere = np.zeros(tracker.nodes, bool), np.full((tracker.nodes, 3), np.nan)
    for k in range(206):
        seen = markers.visible[k] & (not 100 <= k < 200)
        step = tracker.step(int(markers.stamps[k]), nowhere, nobody, markers.positions[k][seen])
        if k == 200:
            assert step.outcome == 'restarted'
    assert tracker.predict(0.1).sigma.max() < own.limits.sigma_warn
    true, estimate = recording.truth.surface[205, 0], tracker.estimate()
    off = nearest_on_surface(true, estimate.position, tracker.triangles).place - true
    assert rms(np.linalg.norm(off, axis=1)) < 2.5e-3


def test_a_hidden_body_keeps_its_shape():
    tracker, feed = followed(60)
    for frame in range(60, 75):
        feed(frame, np.zeros(MARKERS, bool))
    shape = tracker.belief.mean[7 : 18 + 3 * 80]
    for frame in range(75, 100):
        feed(frame, np.zeros(MARKERS, bool))
    later = tracker.belief.mean[7 : 18 + 3 * 80]
    np.testing.assert_array_equal(later[:11], shape[:11])
    np.testing.assert_allclose(later, shape, atol=1e-3)  # the membrane pulls a little


@pytest.mark.parametrize('labels', [0, MARKERS])
def test_a_body_that_was_carried_elsewhere_is_found_by_its_shape(labels):
    tracker, feed = followed(50, labels)
    before, shift = attached(tracker), np.array([0.5, -0.3, 0.4])
    for frame in range(50, 120):
        step = feed(frame, shift=shift)
        if step.outcome == 'restarted':
            break
    assert 0.1 < (frame - 50) * FRAME / 1e9 < 0.15  # no marker is where it should be for so long
    np.testing.assert_array_equal(attached(tracker).node, before.node)
    np.testing.assert_array_equal(attached(tracker).label, before.label)
    true = BODY.markers(frame * FRAME / 1e9) + shift
    off = nearest_on_surface(true, tracker.estimate().position, tracker.triangles).place - true
    assert rms(np.linalg.norm(off, axis=1)) < 2.5e-3


def test_another_body_is_started_anew():
    tracker, _feed = followed(30)
    rng, outcomes = np.random.default_rng(0), []
    other = rng.normal(size=(30, 3))
    other = 0.4 * other / np.linalg.norm(other, axis=1)[:, None] * [1.0, 0.6, 0.5] + 3.0
    none = np.full((tracker.nodes, 3), np.nan), np.zeros(tracker.nodes, bool)
    for frame in range(30, 90):
        outcomes.append(tracker.step(frame * FRAME, *none, other).outcome)
    assert outcomes.index('restarted') == 50  # association.patience
    off = nearest_on_surface(other, tracker.estimate().position, tracker.triangles).place - other
    assert rms(np.linalg.norm(off, axis=1)) < 0.01


# --- registration


def some_places(seed=0, count=40):
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.1, 0.15, 0.3]


def turned(seed, largest=np.pi):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = rng.uniform(0, largest) * axis / np.linalg.norm(axis)
    return Rotation.from_rotvec(turn).as_matrix(), rng.normal(size=3)


def test_pairs_are_aligned():
    places, (rotation, shift) = some_places(), turned(1)
    found = aligned(places, places @ rotation.T + shift)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.shift, shift, atol=1e-12)
    assert found.rms < 1e-12
    noise = np.random.default_rng(2).normal(0, 1e-3, places.shape)
    noisy = aligned(places, places @ rotation.T + shift + noise)
    off = noisy.apply(places) - (places @ rotation.T + shift + noise)
    assert noisy.rms == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))), rel=1e-12)


@pytest.mark.parametrize('seed', range(6))
def test_a_known_shape_is_found_wherever_it_is_turned_to(seed):
    places, (rotation, shift) = some_places(seed), turned(seed)
    rng = np.random.default_rng(seed)
    points = rng.permutation(places @ rotation.T + shift) + rng.normal(0, 1e-3, places.shape)
    found = registered(places, points)
    np.testing.assert_allclose(found.rotation, rotation, atol=0.02)
    np.testing.assert_allclose(found.shift, shift, atol=2e-3)


@pytest.mark.parametrize('seed', range(6))
def test_a_part_of_it_is_enough_where_it_is_turned_little(seed):
    places, (rotation, shift) = some_places(seed), turned(seed, 0.2)
    points = np.random.default_rng(seed).permutation(places @ rotation.T + shift)[:30]
    found = registered(places, points)
    np.testing.assert_allclose(found.apply(places), places @ rotation.T + shift, atol=1e-9)


# --- time, and frames that do not fit


def test_late_frames_are_put_in_their_place():
    late, _ = followed(0)
    ordered, _ = followed(0)
    feed = Feed(ordered, BODY)
    frames = [feed.made(frame) for frame in range(12)]
    for tracker, order in ((ordered, range(12)), (late, [*range(8), 10, 8, 9, 11])):
        for frame in order:
            tracker.step(frame * FRAME, *frames[frame])
    assert late.counts['rewound'] == 2
    assert late.estimate().position.tobytes() == ordered.estimate().position.tobytes()
    assert late.predict(0.1).covariance.tobytes() == ordered.predict(0.1).covariance.tobytes()


def test_a_gap_starts_anew():
    tracker, feed = followed(5)
    assert feed(5 + 150).outcome == 'restarted'
    assert surface_error(tracker, 1.55) < 2.5e-3


def test_a_frame_that_does_not_fit_changes_nothing():
    tracker, feed = followed(5)
    positions, visible, points = feed.made(5)
    before = tracker.estimate().position
    with pytest.raises(FrameError, match=r'model\.nodes has 300 nodes'):
        tracker.step(5 * FRAME, positions[:10], visible[:10], points)
    points[3, 0] = np.inf
    with pytest.raises(FrameError, match='point 3 has a coordinate that is not finite'):
        tracker.step(5 * FRAME, positions, visible, points)
    np.testing.assert_array_equal(tracker.estimate().position, before)


def test_fixed_parameters_never_move():
    tracker, _ = followed(30, body__fixed=['a0', 'b3'], body__local=False)
    mean, first = tracker.belief.mean, followed(1, body__fixed=['a0', 'b3'])[0].belief.mean
    for name in ('a0', 'b3'):
        assert mean[7 + PARAMETERS.index(name)] == first[7 + PARAMETERS.index(name)]
    assert not mean[18:].reshape(-1)[: 3 * 80].any()
