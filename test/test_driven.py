"""Driven nodes: their path, and what their uncertainty does to the free ones."""

import numpy as np
import pytest
from references import KinematicTrack, random_surface

from cloth_predict.config import build
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.surface.driven import DrivenNodes

DT = 0.01


def settings(motion, integrator='implicit_euler'):
    noise = {'fixed': 0.0, 'constant_velocity': 3.0, 'swing': 1e4}[motion]
    return build(
        {
            'anchors': {'motion': motion, 'process_noise': noise},
            'filter': {'integrator': integrator, 'measurement_noise': 1e-4},
        },
        'test',
    )


def followed(config, nodes, surface, frames=30, drive=None):
    driven = DrivenNodes(config, nodes, surface, drive)
    rng = np.random.default_rng(3)
    for _ in range(frames):
        driven.advance(DT)
        driven.update(surface + rng.normal(0, 1e-4, surface.shape), np.ones(len(surface), bool))
    return driven


@pytest.mark.parametrize('integrator', ['implicit_euler', 'rk4'])
@pytest.mark.parametrize('between', [False, True])
@pytest.mark.parametrize('motion', ['constant_velocity', 'swing'])
def test_spread_is_the_change_with_a_path_that_errs(integrator, between, motion):
    """With two driven nodes, or with a third one that moves as their mean."""
    nodes = (0, 1, 2) if between else (0, 2)
    drive = np.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]]) if between else np.eye(2)
    mesh, x, u = random_surface(np.random.default_rng(1), 4, 3, nodes)
    model, x = Disturbed(mesh, 0.3), np.append(x, np.zeros(3 * len(mesh.free)))
    config = settings(motion, integrator)
    surface = mesh.surface(x, u)[0]
    driven = followed(config, np.array([0, 2]), surface, drive=drive if between else None)
    times = [k * 0.005 for k in range(11)]
    path = driven.path(times)
    spread = driven.spread(model, x, [mesh.input(drive @ p, drive @ v) for p, v in path], 0.005)
    assert spread.shape == (model.dim_x, 6)

    def end(column, size):
        """State at the end where one coordinate errs by `size` standard deviations."""
        offset = np.zeros((11, 2, 3))
        sigma = np.sqrt([driven.variances(time) for time in times])
        offset[:, column // 3, column % 3] = size * sigma[:, column // 3]
        y = x
        for k, (position, velocity) in enumerate(path):
            rate = velocity + (offset[k + 1] - offset[k]) / 0.005
            at = mesh.input(drive @ (position + offset[k]), drive @ rate)
            y = INTEGRATORS[integrator].step(model, y, at, 0.005)
        return y

    for column in range(6):
        expected = (end(column, 0.01) - end(column, -0.01)) / 0.02
        # the third derivative over a hundredth of a sigma
        np.testing.assert_allclose(spread[:, column], expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(spread[: 3 * len(mesh.free)]).max() > 1e-3  # m; the neighbours feel it


def test_fixed_nodes_spread_nothing():
    mesh, x, u = random_surface(np.random.default_rng(1), 3, 3, (0, 2))
    driven = followed(settings('fixed'), mesh.driven, mesh.surface(x, u)[0])
    assert driven.spread(mesh, x, [u, u], DT).shape == (mesh.dim_x, 0)


def test_a_copy_moves_on_by_itself():
    mesh, x, u = random_surface(np.random.default_rng(1), 3, 3, (0, 2))
    surface = mesh.surface(x, u)[0]
    driven = followed(settings('constant_velocity'), mesh.driven, surface)
    before = driven.extrapolate(0.1), driven.variances(0.1)
    other = driven.copy()
    other.advance(0.5)
    other.update(surface + 1.0, np.ones(9, bool))
    np.testing.assert_array_equal(driven.extrapolate(0.1), before[0])
    np.testing.assert_array_equal(driven.variances(0.1), before[1])
    assert np.abs(other.extrapolate(0.1) - before[0]).max() > 0.1


def test_a_swinging_node_is_followed_and_extrapolated_as_by_filterpy():
    config = build(
        {
            'anchors': {'motion': 'swing', 'process_noise': 30.0, 'decay': 3.0, 'restoring': 12.0},
            'filter': {'measurement_noise': 1e-4, 'initial_velocity': 0.4},
        },
        'test',
    )
    drift = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -12.0, -3.0]])
    path = np.sin(4.0 * DT * np.arange(100))[:, None] * [0.1, -0.2, 0.05]
    driven = DrivenNodes(config, np.array([1]), np.stack([path[0], path[0]]))
    track = KinematicTrack(drift, 30.0, 1e-4, path[0], 0.4)
    for position in path[1:]:
        driven.advance(DT)
        driven.update(np.stack([position + 1.0, position]), np.ones(2, bool))
        track.predict(DT)
        track.update(position)
    for ahead in (-DT, 0.0, 0.05, 0.2):
        # the house bound; accelerations are 1e4 times that
        expected, atol = track.extrapolate(ahead), np.array([[1e-9], [1e-7], [1e-5]])
        assert (np.abs(driven.extrapolate(ahead)[:, 0] - expected) < atol).all()
    assert driven.variances(0.2)[0] == pytest.approx(track.variance(0.2), rel=1e-9)  # the same
    (start, velocity), *_ = driven.path([0.05, 0.2])
    np.testing.assert_allclose(start[0], track.extrapolate(0.05)[0], atol=1e-9)  # the same
    mean = (track.extrapolate(0.2)[0] - track.extrapolate(0.05)[0]) / 0.15
    np.testing.assert_allclose(velocity[0], mean, atol=1e-8)  # the same, over 0.15 s
