"""Conditioning, propagation, and what a marker shows of a state, against the formulas."""

import numpy as np
import pytest
from references import kalman_update, random_covariance, selection, trapezoid

from cloth_predict.filters.linear import condition, propagate
from cloth_predict.integrators.dense_tangent import DenseTangent
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import Gaussian


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


def test_an_innovation_covariance_that_is_not_positive_definite_is_an_error():
    belief = Gaussian(np.zeros(2), np.diag([-1.0, 1.0]))
    with pytest.raises(FloatingPointError, match='positive definite'):
        condition(belief, np.array([0]), np.array([0.5]), np.zeros(1))


def test_observation_selects_position_rows():
    obs = VisiblePositions.of_nodes(np.array([2, 0]), 0.5)
    x = np.arange(20.0)
    assert obs.h(x).tolist() == [6, 7, 8, 0, 1, 2]
    assert obs.jac(x).tolist() == [6, 7, 8, 0, 1, 2]
    assert obs.cov.tolist() == [0.25] * 6
