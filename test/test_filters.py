"""The EKF against filterpy, the textbook's filter, itself run ahead, and its own statistics."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
from references import (
    Linear,
    damped_oscillators,
    kalman_predict,
    kalman_update,
    random_covariance,
    random_surface,
    selection,
    state_jacobian,
    trapezoid,
)
from scipy.stats import chi2

from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.linear import condition, propagate
from cloth_predict.integrators import INTEGRATORS, DenseTangent, ImplicitEuler
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import Gaussian

NO_INPUT = np.zeros(0)
SIGMA = 1e-3


@pytest.fixture
def surface():
    """A 4 x 3 mesh under unknown forces, slack and taut springs, its noise, and a first belief."""
    rng = np.random.default_rng(1)
    mesh, x, u = random_surface(rng, 4, 3, (0, 2))
    model = Disturbed(mesh, 0.3)
    n = 3 * len(mesh.free)
    q = np.concatenate([np.zeros(n), np.full(n, 0.5), np.full(n, 0.07)])
    variance = np.repeat([1e-4, 0.25, 0.01], n)
    return model, u, q, Gaussian(np.append(x, np.zeros(n)), np.diag(variance))


def frames(rng, model, u, belief, count):
    """Markers of a true motion that starts at another state, about a third of them missing."""
    mesh = model.model
    x = belief.mean[: mesh.dim_x] + rng.normal(0, 0.01, mesh.dim_x)
    for _ in range(count):
        x = ImplicitEuler().step(mesh, x, u, 0.01)
        seen = np.flatnonzero(rng.random(len(mesh.free)) < 0.7)
        obs = VisiblePositions.of_nodes(seen, SIGMA)
        yield obs, x[obs.rows] + rng.normal(0, SIGMA, len(obs.rows))


# --- against other implementations


@pytest.mark.parametrize('name', ['implicit_euler', 'rk4'])
def test_ekf_equals_filterpy_with_missing_markers(surface, name):
    model, u, q, belief = surface
    kalman = ExtendedKalmanFilter(INTEGRATORS[name])
    other = FilterpyEKF(dim_x=model.dim_x, dim_z=1)
    other.x, other.P = belief.mean[:, None].copy(), belief.cov.copy()
    sizes = set()
    dt = 0.005
    for obs, z in frames(np.random.default_rng(2), model, u, belief, 40):
        after, F = INTEGRATORS[name].step_jac(model, other.x[:, 0], u, dt)
        other.x, other.P = after[:, None], F @ other.P @ F.T + trapezoid(F, dt * q)
        H = selection(obs.rows, model.dim_x)
        expected_S = H @ other.P @ H.T + SIGMA**2 * np.eye(len(z))
        expected_nis = (z - H @ after) @ np.linalg.solve(expected_S, z - H @ after)
        other.update(
            z[:, None], lambda x, H=H: H, lambda x, H=H: H @ x, R=SIGMA**2 * np.eye(len(z))
        )
        belief = kalman.predict(belief, model, u, q, dt)
        belief, innovation = kalman.update(belief, obs, z)
        # the house bound; positions of 0.5 m, velocities of 5 m/s, variances below 1
        np.testing.assert_allclose(belief.mean, other.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(belief.cov, other.P, atol=1e-9)
        np.testing.assert_allclose(innovation.cov, expected_S, atol=1e-9)
        assert innovation.nis == pytest.approx(expected_nis, rel=1e-6)  # 1e-9 over sigma of 1e-3
        sizes.add(len(z))
    assert len(sizes) > 5  # the number of markers did change


@pytest.mark.parametrize('name', INTEGRATORS)
def test_ekf_on_a_linear_model_is_the_textbook_filter(name):
    rng = np.random.default_rng(3)
    model = damped_oscillators(rng, 3)
    q, dt, R = np.repeat([0.0, 0.2], 3), 0.05, 0.01 * np.eye(3)
    F = INTEGRATORS[name].step_jac(model, np.zeros(6), NO_INPUT, dt)[1]
    obs = VisiblePositions.of_nodes(np.array([0]), 0.1)
    kalman = ExtendedKalmanFilter(INTEGRATORS[name])
    x, P = rng.normal(size=6), random_covariance(rng, 6)
    belief = Gaussian(x, P)
    for _ in range(60):
        z = rng.normal(size=3)
        x, P = kalman_predict(x, P, F, trapezoid(F, dt * q))
        x, P = kalman_update(x, P, np.eye(3, 6), R, z)
        belief = kalman.predict(belief, model, NO_INPUT, q, dt)
        belief, _ = kalman.update(belief, obs, z)
        np.testing.assert_allclose(belief.mean, x, atol=1e-9)  # the house bound
        np.testing.assert_allclose(belief.cov, P, atol=1e-9)


def test_rows_and_a_matrix_condition_alike():
    rng = np.random.default_rng(4)
    belief = Gaussian(rng.normal(size=8), random_covariance(rng, 8))
    rows, noise, residual = np.array([6, 1, 3]), rng.uniform(0.1, 1, 3), rng.normal(size=3)
    H = selection(rows, 8)
    by_rows, learnt = condition(belief, rows, noise, residual)
    x, P = kalman_update(belief.mean, belief.cov, H, np.diag(noise), residual + H @ belief.mean)
    for by_matrix, also in (
        condition(belief, H, noise, residual),
        condition(belief, H, np.diag(noise), residual),
        condition(belief, rows, np.diag(noise), residual),
    ):
        np.testing.assert_allclose(by_matrix.mean, by_rows.mean, atol=1e-14)  # rounding
        np.testing.assert_allclose(by_matrix.cov, by_rows.cov, atol=1e-14)  # rounding
        assert also.nis == pytest.approx(learnt.nis, rel=1e-13)  # rounding
    np.testing.assert_allclose(by_rows.mean, x, atol=1e-13)  # rounding, condition below 1e3
    np.testing.assert_allclose(by_rows.cov, P, atol=1e-13)  # the same


def test_a_full_noise_covariance_and_any_matrix():
    rng = np.random.default_rng(5)
    belief = Gaussian(rng.normal(size=6), random_covariance(rng, 6))
    H, R, z = rng.normal(size=(4, 6)), random_covariance(rng, 4), rng.normal(size=4)
    x, P = kalman_update(belief.mean, belief.cov, H, R, z)
    found, learnt = condition(belief, H, R, z - H @ belief.mean)
    np.testing.assert_allclose(found.mean, x, atol=1e-12)  # rounding, condition below 1e4
    np.testing.assert_allclose(found.cov, P, atol=1e-12)  # the same
    np.testing.assert_allclose(learnt.cov, H @ belief.cov @ H.T + R, atol=1e-14)  # rounding


def test_propagate_equals_the_trapezoid_rule():
    rng = np.random.default_rng(6)
    P, F, noise = random_covariance(rng, 5), rng.normal(size=(5, 5)), rng.uniform(0, 1, 5)
    expected = F @ P @ F.T + trapezoid(F, noise)
    np.testing.assert_allclose(
        propagate(P, DenseTangent(F), noise), expected, atol=1e-14
    )  # rounding


def test_an_update_without_markers_changes_nothing(surface):
    _, _, _, belief = surface
    kalman = ExtendedKalmanFilter(ImplicitEuler())
    obs = VisiblePositions.of_nodes(np.zeros(0, np.int64), SIGMA)
    after, innovation = kalman.update(belief, obs, np.zeros(0))
    np.testing.assert_array_equal(after.mean, belief.mean)
    np.testing.assert_array_equal(after.cov, belief.cov)
    assert (innovation.nis, innovation.residual.shape) == (0.0, (0,))


def test_an_update_without_markers_prints_nothing(surface, capfd):
    # LAPACK complains of an empty matrix on stdout, where `evaluate --json` writes
    _, _, _, belief = surface
    obs = VisiblePositions.of_nodes(np.zeros(0, np.int64), SIGMA)
    ExtendedKalmanFilter(ImplicitEuler()).update(belief, obs, np.zeros(0))
    assert capfd.readouterr() == ('', '')


# --- run ahead


@pytest.mark.parametrize('name', ['implicit_euler', 'rk4'])
def test_forecast_equals_a_chain_of_predictions(surface, name):
    model, u, q, belief = surface
    kalman, dt = ExtendedKalmanFilter(INTEGRATORS[name]), 0.005
    rng = np.random.default_rng(7)
    inputs = [u + rng.normal(0, 0.01, len(u)) for _ in range(12)]
    rows = np.array([[0, 1, 2], [7, 29, 35], [80, 4, 3]])
    mean, cov = kalman.forecast(belief, model, inputs, q, dt, rows)
    chain = belief
    for step_input in inputs:
        chain = kalman.predict(chain, model, step_input, q, dt)
    np.testing.assert_array_equal(mean, chain.mean)
    for group, found in zip(rows, cov, strict=True):
        expected = chain.cov[np.ix_(group, group)]
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        # products in another order
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-10)


def test_forecast_by_no_step_is_the_belief(surface):
    model, _, q, belief = surface
    kalman, rows = ExtendedKalmanFilter(ImplicitEuler()), np.array([[3, 40], [40, 41]])
    mean, cov = kalman.forecast(belief, model, [], q, 0.01, rows)
    np.testing.assert_array_equal(mean, belief.mean)
    np.testing.assert_allclose(cov, belief.marginals(rows), atol=1e-16)  # rounding


# --- statistics


def test_covariance_stays_symmetric_and_positive(surface):
    model, u, q, belief = surface
    kalman = ExtendedKalmanFilter(ImplicitEuler())
    for obs, z in frames(np.random.default_rng(8), model, u, belief, 500):
        belief = kalman.predict(belief, model, u, q, 0.01)
        np.testing.assert_array_equal(belief.cov, belief.cov.T)
        belief, _ = kalman.update(belief, obs, z)
        np.testing.assert_array_equal(belief.cov, belief.cov.T)
    eigenvalues = np.linalg.eigvalsh(belief.cov)
    assert eigenvalues[0] > -1e-14 * eigenvalues[-1]  # rounding of the subtraction P - W'W
    # and positions are known better than one marker tells
    assert np.sqrt(np.diag(belief.cov)[:30]).max() < 3 * SIGMA


def test_update_where_the_noise_is_far_below_the_spread():
    # the literal (I - K H) P loses symmetry here: 1 m against a micrometre
    rng = np.random.default_rng(9)
    belief = Gaussian(np.zeros(12), random_covariance(rng, 12))
    rows = np.arange(6)
    for _ in range(100):
        belief, _ = condition(belief, rows, np.full(6, 1e-12), rng.normal(0, 1e-6, 6))
        np.testing.assert_array_equal(belief.cov, belief.cov.T)
    variance = np.diag(belief.cov)[:6]
    # 1e-12 / 100, and the rounding of the first update: 1e-16 of variances of 1
    np.testing.assert_allclose(variance, 1e-14, atol=2e-15)


@pytest.mark.parametrize('name', ['implicit_euler', 'rk4'])
def test_nees_and_nis_lie_in_their_chi_square_bands(name):
    """A hung chain linearised at rest, drawn from its own noise; 60 runs of 40 steps."""
    rng = np.random.default_rng(10)
    mesh, x, u = random_surface(rng, 1, 4, (0,), rest=(0.8, 0.99))
    model = Linear(state_jacobian(mesh, mesh.surface(x, u)[0]))
    dt, runs, steps = 0.01, 60, 40
    q = np.repeat([0.0, 2.0], 9)
    F = INTEGRATORS[name].step_jac(model, np.zeros(18), NO_INPUT, dt)[1]
    kalman = ExtendedKalmanFilter(INTEGRATORS[name])
    obs = VisiblePositions.of_nodes(np.array([0, 2]), SIGMA)
    start = np.diag(np.repeat([1e-4, 0.1], 9))
    half = np.sqrt(dt * q / 2)
    nees, nis = [], []
    for _ in range(runs):
        truth = rng.multivariate_normal(np.zeros(18), start)
        belief = Gaussian(np.zeros(18), start)
        for _ in range(steps):
            truth = F @ (truth + half * rng.normal(size=18)) + half * rng.normal(size=18)
            belief = kalman.predict(belief, model, NO_INPUT, q, dt)
            z = truth[obs.rows] + rng.normal(0, SIGMA, 6)
            belief, learnt = kalman.update(belief, obs, z)
            nis.append(learnt.nis)
        error = truth - belief.mean
        nees.append(error @ np.linalg.solve(belief.cov, error))
    # innovations are independent, errors of one run are not: one NEES per run; 99.8 % bands
    low, high = chi2.ppf([0.001, 0.999], 18 * runs)
    assert low < sum(nees) < high
    low, high = chi2.ppf([0.001, 0.999], 6 * runs * steps)
    assert low < sum(nis) < high


# --- the contract


def test_an_innovation_covariance_that_is_not_positive_definite_is_an_error():
    belief = Gaussian(np.zeros(2), np.diag([-1.0, 1.0]))
    with pytest.raises(FloatingPointError, match='positive definite'):
        condition(belief, np.array([0]), np.array([0.5]), np.zeros(1))


def test_a_belief_cannot_be_written_to_and_is_not_changed(surface):
    model, u, q, belief = surface
    before = belief.mean.copy(), belief.cov.copy()
    kalman = ExtendedKalmanFilter(ImplicitEuler())
    obs = VisiblePositions.of_nodes(np.array([1, 4]), SIGMA)
    predicted = kalman.predict(belief, model, u, q, 0.01)
    updated, _ = kalman.update(predicted, obs, np.zeros(6))
    for found in (belief, predicted, updated):
        for array in (found.mean, found.cov):
            with pytest.raises(ValueError, match='read-only'):
                array.flat[0] = 1.0
    np.testing.assert_array_equal(belief.mean, before[0])
    np.testing.assert_array_equal(belief.cov, before[1])


def test_observation_selects_position_rows():
    obs = VisiblePositions.of_nodes(np.array([2, 0]), 0.5)
    x = np.arange(20.0)
    assert obs.h(x).tolist() == [6, 7, 8, 0, 1, 2]
    assert obs.jac(x).tolist() == [6, 7, 8, 0, 1, 2]
    assert obs.cov.tolist() == [0.25] * 6
