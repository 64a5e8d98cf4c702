"""The thesis' recursion, formula by formula, and how it fares on springs as stiff as a cloth's."""

import warnings

import numpy as np
import pytest
from references import even_surface, random_covariance, selection, state_jacobian

from cloth_predict.config import build
from cloth_predict.evaluation.compare import evaluate
from cloth_predict.evaluation.predictors import methods
from cloth_predict.filters.gomes2016 import Gomes2016
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.observations import VisiblePositions
from cloth_predict.surface.assembly import rest_shape
from cloth_predict.types import Gaussian, MarkerSequence

SIGMA, DT = 1e-3, 0.01


@pytest.fixture
def soft():
    """A 2 x 3 mesh of springs so soft that the literal recursion stays bounded."""
    mesh, flat = even_surface(
        2, 3, (0, 2), gravity=np.zeros(3), stiffness=1e-2, damping=1e-3, mass=1.0
    )
    rng = np.random.default_rng(1)
    x = np.concatenate([flat[mesh.free].ravel(), rng.normal(0, 0.1, 3 * len(mesh.free))])
    q = np.repeat([0.0, 0.4], mesh.dim_x // 2)
    return mesh, flat, x, mesh.input(flat[mesh.driven], np.zeros((2, 3))), q


def test_it_starts_from_a_certain_state(soft):
    mesh, _, x, u, q = soft
    belief = Gomes2016().start(Gaussian(x, np.eye(len(x))), mesh, u, q)
    np.testing.assert_array_equal(belief.mean, x)
    np.testing.assert_array_equal(belief.cov, np.zeros((len(x), len(x))))  # P(0|0) = 0


def test_prediction_is_equations_6_1_6_2_and_6_5(soft):
    mesh, flat, x, u, q = soft
    size = len(x)
    P = random_covariance(np.random.default_rng(2), size)
    found = Gomes2016().predict(Gaussian(x, P), mesh, u, q, DT)
    J = state_jacobian(mesh, flat)  # eq. 3.23, from the second implementation
    v, a = x[size // 2 :], mesh.acceleration(x, u).ravel()
    np.testing.assert_allclose(found.mean, x + DT * np.append(v, a), atol=1e-15)  # rounding
    alpha = DT * 0.4
    np.testing.assert_allclose(
        found.cov, J @ P @ J.T + alpha * np.eye(size), atol=1e-14
    )  # rounding


def test_update_is_equation_6_6(soft):
    _, _, x, _, _ = soft
    rng = np.random.default_rng(3)
    # not quite symmetric, as P is before long: then the forms of the update differ
    P = random_covariance(rng, len(x)) + rng.normal(0, 1e-3, (len(x), len(x)))
    obs = VisiblePositions.of_nodes(np.array([0, 3]), 0.3)
    z = rng.normal(size=6)
    found, learnt = Gomes2016().update(Gaussian(x, P), obs, z)
    H, beta = selection(obs.rows, len(x)), 0.3**2
    S = H @ P @ H.T + beta * np.eye(6)
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(found.mean, x + K @ (z - H @ x), atol=1e-13)  # rounding
    np.testing.assert_allclose(found.cov, (np.eye(len(x)) - K @ H) @ P, atol=1e-13)  # rounding
    np.testing.assert_allclose(learnt.cov, S, atol=1e-14)  # rounding
    nis = (z - H @ x) @ np.linalg.solve(S, z - H @ x)
    assert learnt.nis == pytest.approx(nis, rel=1e-12)  # rounding, condition below 1e3


def test_a_measurement_matrix_does_as_the_rows_do(soft):
    _, _, x, _, _ = soft
    P, z = random_covariance(np.random.default_rng(4), len(x)), np.array([0.1, 0.2, 0.3])
    rows = VisiblePositions.of_nodes(np.array([2]), 0.3)

    class Matrix:
        cov = np.diag(rows.cov)

        def h(self, x):
            return x[rows.rows]

        def jac(self, x):
            return selection(rows.rows, len(x))

    by_rows, _ = Gomes2016().update(Gaussian(x, P), rows, z)
    by_matrix, _ = Gomes2016().update(Gaussian(x, P), Matrix(), z)
    np.testing.assert_array_equal(by_matrix.mean, by_rows.mean)
    np.testing.assert_array_equal(by_matrix.cov, by_rows.cov)


def test_on_soft_springs_it_follows(soft):
    mesh, _, x, u, q = soft
    rng, truth, estimator = np.random.default_rng(5), x.copy(), Gomes2016()
    obs = VisiblePositions.of_nodes(np.arange(len(mesh.free)), SIGMA)
    belief = estimator.start(Gaussian(x, np.eye(len(x))), mesh, u, q)
    for _ in range(50):
        truth = ImplicitEuler().step(mesh, truth, u, DT)
        belief = estimator.predict(belief, mesh, u, q, DT)
        belief, _ = estimator.update(belief, obs, truth[obs.rows] + rng.normal(0, SIGMA, 12))
    # alpha is far above beta, so that it takes a measured position for its own: 4 sigma of 12
    assert np.abs(belief.mean - truth)[:12].max() < 4 * SIGMA


def on_stiff_springs(seen, frames):
    """Estimate and truth after each frame, and NIS per coordinate; `seen` of 6 nodes measured."""
    mesh, flat = even_surface(3, 3, (0, 1, 2), stiffness=300.0)  # up to 400 rad/s
    estimator, rng = Gomes2016(), np.random.default_rng(6)
    u = mesh.input(flat[mesh.driven], np.zeros((3, 3)))
    x = np.append(flat[mesh.free].ravel(), np.zeros(18))
    q = np.repeat([0.0, 1.0], 18)
    obs = VisiblePositions.of_nodes(np.arange(seen), SIGMA)
    belief = estimator.start(Gaussian(x, np.eye(36)), mesh, u, q)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for _ in range(frames):
            x = ImplicitEuler().step(mesh, x, u, DT)
            belief = estimator.predict(belief, mesh, u, q, DT)
            z = x[obs.rows] + rng.normal(0, SIGMA, len(obs.rows))
            belief, learnt = estimator.update(belief, obs, z)
            yield belief.mean, x, learnt.nis / len(z)


def test_on_stiff_springs_its_velocities_are_lost_and_its_nis_shows_it():
    found, truth, nis = zip(*on_stiff_springs(6, 200), strict=True)
    error = np.abs(np.array(found) - np.array(truth))
    # every node is measured in every frame, and taken at its measured place: 4 sigma of 18 x 200
    assert error[:, :18].max() < 4.5 * SIGMA
    assert error[-1, 18:].max() > 10.0  # m/s, of a sheet that sags at 0.3 m/s
    assert np.abs(np.array(truth)[:, 18:]).max() < 0.5
    assert np.mean(nis[10:]) < 1e-4  # a filter that knows its errors has 1


def test_with_nodes_unseen_it_is_lost_altogether_and_says_so():
    with pytest.raises(FloatingPointError, match=r'lost|overflow|invalid|no inverse'):
        for _ in on_stiff_springs(4, 30):
            pass


@pytest.mark.parametrize('cov', [np.full((2, 2), 1e200), np.diag([np.inf, 1.0])])
def test_numbers_that_overflow_are_an_error_of_arithmetic_and_print_nothing(cov, capfd):
    obs = VisiblePositions(np.array([0, 1]), np.zeros(2))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        with pytest.raises(FloatingPointError):
            Gomes2016().update(Gaussian(np.zeros(2), cov), obs, np.ones(2))
    assert capfd.readouterr() == ('', '')


def test_an_innovation_covariance_without_an_inverse_is_an_error_of_arithmetic():
    obs = VisiblePositions(np.array([0, 1]), np.zeros(2))
    with pytest.raises(FloatingPointError, match='has no inverse'):
        Gomes2016().update(Gaussian(np.zeros(2), np.ones((2, 2))), obs, np.ones(2))


@pytest.mark.parametrize(('limit', 'coverage'), [(0.05, None), (1e300, (1.0, 1.0, 1.0))])
def test_an_evaluation_tells_how_wrong_it_is(limit, coverage, capfd):
    config = build(
        {
            'model': {'rows': 3, 'cols': 3, 'width': 0.4, 'height': 0.4, 'mass': 0.05},
            'anchors': {'nodes': [0, 1, 2]},
            'filter': {'kind': 'gomes2016', 'measurement_noise': SIGMA},
            'limits': {'sigma_error': limit},
        },
        'test',
    )
    rng, rest = np.random.default_rng(7), rest_shape(config.model)
    swing = 0.02 * np.abs(rest[:, 1:2]) * np.sin(0.05 * np.arange(150))[:, None, None]
    positions = rest + swing + rng.normal(0, SIGMA, (150, 9, 3))
    markers = MarkerSequence(
        10**7 * np.arange(150), tuple('abcdefghi'), positions, np.ones((150, 9), bool)
    )
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = evaluate(markers, config, 0.1, makers=methods(['ekf', 'gomes2016']))
    assert capfd.readouterr() == ('', '')
    assert found.scores['ekf'].rmse_free_mm < 30
    details, score = found.details['gomes2016'], found.scores['gomes2016']
    # sigma is so large that the limit withholds every prediction, or that it covers metres
    assert details.coverage == coverage
    assert details.nis < 1e-3  # a filter that knows its errors has 1
    assert not score.rmse_free_mm < 1e3  # NaN where nothing is predicted
