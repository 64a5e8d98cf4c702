"""Bodies are judged by the distance from the surface that is predicted."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import build
from cloth_predict.errors import ConfigError, FormatError
from cloth_predict.evaluation.bodies import by_surface, carried, methods_of, on_surface
from cloth_predict.evaluation.cases import case_of
from cloth_predict.evaluation.compare import compare
from cloth_predict.evaluation.degrade import Degradation, degraded
from cloth_predict.evaluation.predictors import Predicted
from cloth_predict.formats.bag import Recording, Truth
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.types import MarkerSequence, Surface

MESH = ClosedMesh.even(60)
SETTINGS = {
    'horizon': 0.1,
    'model': {'kind': 'superquadric', 'nodes': 60, 'mass': 0.1, 'gravity': [0.0, 0.0, 0.0]},
    'filter': {'kind': 'decoupled', 'measurement_noise': 3e-4},
}


def config(**groups):
    return build({**SETTINGS, **groups}, 'a test')


def sliding_ball(labels='Unlabeled', frames=125, truth=True, speed=0.5):
    """A ball of 0.1 m that moves along x, turning about z, seen by 40 of its 200 points."""
    points = 0.1 * ClosedMesh.even(200).directions * [1.0, 0.8, 1.2]
    time = 0.01 * np.arange(frames)
    turns = Rotation.from_rotvec(np.outer(time, [0.0, 0.0, 0.8]))
    path = np.array([turn.apply(points) for turn in turns])
    path[..., 0] += speed * time[:, None]
    ids = np.full((1, 200), -1)
    ids[0, ::5] = np.arange(40)
    noise = np.random.default_rng(0).normal(0, 3e-4, (frames, 40, 3))
    stamps = np.arange(frames, dtype=np.int64) * 10**7
    names = tuple(f'{labels} {k}' for k in range(40))
    markers = MarkerSequence(stamps, names, path[:, ::5] + noise, np.ones((frames, 40), bool))
    return Recording(markers, Truth(stamps, path[:, None], ids) if truth else None)


def surface_of(position, velocity):
    none = np.zeros_like(position)
    return Surface(0, position, velocity, none, np.zeros((len(position), 3, 3)))


# --- the parts


def test_the_nearest_places_and_what_is_known_of_them():
    position = MESH.directions
    predicted = Predicted(position, np.linspace(1.0, 2.0, 60), MESH.triangles)
    corners = MESH.triangles[7]
    weight = np.array([0.2, 0.5, 0.3])
    inside = weight @ position[corners]
    actual = np.array([1.5 * position[3], [np.nan, 0.0, 0.0], inside])
    found = on_surface(predicted, actual)
    np.testing.assert_allclose(found.position[0], position[3], atol=1e-12)  # rounding
    np.testing.assert_allclose(found.position[2], inside, atol=1e-12)
    assert found.sigma[0] == pytest.approx(predicted.sigma[3], abs=1e-12)
    assert found.sigma[2] == pytest.approx(weight @ predicted.sigma[corners], abs=1e-9)
    assert np.isnan(found.position[1]).all()
    assert np.isnan(found.sigma[1])


def test_what_is_not_predicted_is_nowhere():
    found = on_surface(Predicted.unknown(60), MESH.directions)
    assert np.isnan(found.position).all()
    assert len(found.position) == 60


def test_a_rigid_motion_goes_on_and_nothing_else_does():
    rng = np.random.default_rng(1)
    position = rng.normal(size=(30, 3))
    middle, spin, velocity = position.mean(axis=0), np.array([0.4, -1.0, 2.0]), np.ones(3)
    rigid = velocity + np.cross(spin, position - middle)
    found = carried(surface_of(position, rigid), 0.7)
    turned = Rotation.from_rotvec(0.7 * spin).apply(position - middle)
    np.testing.assert_allclose(found.position, middle + 0.7 + turned, atol=1e-12)  # rounding
    # what grows evenly has no spin and no velocity of its own
    growing = carried(surface_of(position, rigid + 3 * (position - middle)), 0.7)
    np.testing.assert_allclose(growing.position, found.position, atol=1e-12)


# --- the case


def test_every_point_of_a_simulated_body_is_true_and_no_node_is_seen():
    recording = sliding_ball()
    case = case_of(recording, config(), 'ball')
    assert case.reference.surface
    assert case.reference.true
    np.testing.assert_array_equal(case.reference.markers.positions, recording.truth.surface[:, 0])
    positions, visible, points = case.frame(3, associates=True)
    assert not visible.any()
    np.testing.assert_array_equal(points, recording.markers.positions[3])
    assert np.isnan(positions).all()


def test_labels_stay_and_without_the_truth_the_markers_are_what_is_compared():
    recording = sliding_ball('Ball', truth=False)
    case = case_of(recording, config(), 'ball')
    positions, visible, points = case.frame(3, associates=True)
    assert visible.sum() == 40
    assert not len(points)
    np.testing.assert_array_equal(positions[visible], recording.markers.positions[3])
    assert case.reference.noise == 3e-4
    assert case.reference.surface
    np.testing.assert_array_equal(case.reference.markers.positions, recording.markers.positions)


def test_points_without_labels_vanish_too():
    case = case_of(sliding_ball(), config(), 'ball')
    worse = degraded(case, Degradation(drop=0.3, seed=4))
    count = np.array([len(points) for points in worse.points])
    assert (count[:100] == 40).all()  # the first second stays as it is
    assert count[100:].mean() == pytest.approx(28, abs=2)
    np.testing.assert_array_equal(
        worse.reference.markers.positions, case.reference.markers.positions
    )


def test_a_body_with_nodes_at_its_markers_is_judged_by_them():
    at_markers = config(body={'mesh': 'markers'})
    assert not by_surface(at_markers)
    assert list(methods_of(at_markers, ['ekf'])) == ['hold', 'kf_cv', 'kf_ca', 'ekf']
    assert list(methods_of(config(), ['ekf'])) == ['hold', 'rigid', 'ekf']


# --- the comparison


@pytest.fixture(scope='module')
def compared():
    settings = config()
    (found,) = compare(case_of(sliding_ball(), settings, 'ball'), settings, [0.1])
    return found


def test_the_ladder_on_a_ball_that_slides(compared):
    rms = {name: score.rmse_mm for name, score in compared.scores.items()}
    # a ball that is moved by 0.05 m has points off by up to that, by 0.05 cos / sqrt 3 or so
    assert 10 < rms['hold'] < 40
    # nodes 0.044 m apart on a ball of 0.1 m: triangles cut its chords by some 1.5 mm
    assert 1 < rms['rigid'] < 4
    assert 1 < rms['decoupled'] < rms['hold'] / 3
    assert compared.best == 'rigid'
    assert compared.ratios['hold'].ratio == pytest.approx(rms['hold'] / rms['rigid'])
    assert compared.errors['decoupled'].shape[1] == 200


def test_coverage_is_that_of_the_distance(compared):
    answers = compared.judged.answers['decoupled']
    known = np.isfinite(answers.errors)
    expected = [(answers.errors <= k * answers.sigma)[known].mean() for k in (1, 2, 3)]
    assert compared.details['decoupled'].coverage == pytest.approx(expected)
    assert compared.details['rigid'].coverage is None
    assert np.isnan(compared.details['decoupled'].nees)


def test_there_is_no_best_noise_of_what_does_not_follow_a_body():
    settings = config()
    with pytest.raises(ConfigError, match='ball: no kinematic filter'):
        compare(case_of(sliding_ball(), settings, 'ball'), settings, [0.1], search=True)


def test_a_recording_without_a_body_says_why():
    recording = sliding_ball(truth=False)
    line = np.linspace(0.0, 1.0, 40)[:, None] * [1.0, 0.2, 0.1]
    markers = recording.markers
    flat = MarkerSequence(
        markers.stamps, markers.labels, np.tile(line, (len(markers), 1, 1)), markers.visible
    )
    own = config()
    case = case_of(Recording(flat), own, 'here')
    with pytest.raises(FormatError, match=r'^here: no surface yet: all 40 points lie on a line'):
        compare(case, own, [0.1])
