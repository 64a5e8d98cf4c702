"""Sigma points against filterpy's, exact moments of a square, and what they cost and refuse."""

from dataclasses import dataclass

import numpy as np
import pytest
from filterpy.kalman import CubatureKalmanFilter, MerweScaledSigmaPoints, unscented_transform
from filterpy.kalman.CubatureKalmanFilter import ckf_transform, spherical_radial_sigmas
from references import Linear, random_covariance

from cloth_predict.filters.sigma_points import SigmaPointFilter
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.types import Gaussian

NO_INPUT = np.zeros(0)
ALPHAS = [1e-3, 0.3, 1.0]


class Squared:
    """A step that takes every state to its square."""

    def step(self, model, x, u, dt):
        return x**2


class Counted:
    """A step that goes nowhere, and counts how often it is asked."""

    def __init__(self):
        self.steps = 0

    def step(self, model, x, u, dt):
        self.steps += 1
        return x


@dataclass
class Mixed:
    """A step in which every state acts on every other, none of it linearly."""

    matrix: np.ndarray

    def step(self, model, x, u, dt):
        return x + dt * (np.sin(self.matrix @ x) + x**2)


def ukf(integrator, alpha=1e-3):
    return SigmaPointFilter(integrator, alpha, beta=2.0)


def ckf(integrator):
    return SigmaPointFilter(integrator, alpha=1.0, beta=0.0)


def moved(kalman, mean, cov, q=0.0, dt=1.0):
    noise = np.full(len(mean), q)
    return kalman.predict(Gaussian(mean, cov), None, NO_INPUT, noise, dt)


@pytest.mark.parametrize('alpha', ALPHAS)
def test_points_and_weights_are_those_of_van_der_merwe(alpha):
    rng = np.random.default_rng(1)
    mean, cov = rng.normal(size=5), random_covariance(rng, 5)
    points, mean_weights, cov_weights = ukf(None, alpha).points(mean, cov)
    other = MerweScaledSigmaPoints(5, alpha, beta=2.0, kappa=0.0)
    np.testing.assert_allclose(points, other.sigma_points(mean, cov), atol=1e-13)  # rounding
    # filterpy takes c = (c - n) + n, which costs digits where alpha is small
    np.testing.assert_allclose(mean_weights, other.Wm, rtol=1e-9)
    np.testing.assert_allclose(cov_weights, other.Wc, rtol=1e-9)  # the same


def test_points_of_the_cubature_filter_are_filterpys():
    rng = np.random.default_rng(2)
    mean, cov = rng.normal(size=5), random_covariance(rng, 5)
    points, mean_weights, cov_weights = ckf(None).points(mean, cov)
    np.testing.assert_allclose(points, spherical_radial_sigmas(mean, cov), atol=1e-14)  # rounding
    np.testing.assert_allclose(mean_weights, 0.1, rtol=1e-15)  # rounding
    np.testing.assert_allclose(cov_weights, 0.1, rtol=1e-15)  # rounding


@pytest.mark.parametrize('alpha', ALPHAS)
def test_a_nonlinear_step_has_the_moments_of_filterpys_unscented_transform(alpha):
    rng = np.random.default_rng(3)
    mean, cov, step = rng.normal(size=6), random_covariance(rng, 6), Mixed(rng.normal(size=(6, 6)))
    q, dt = 0.3, 0.4
    half = 0.5 * dt * q * np.eye(6)
    other = MerweScaledSigmaPoints(6, alpha, beta=2.0, kappa=0.0)
    after = [step.step(None, x, NO_INPUT, dt) for x in other.sigma_points(mean, cov + half)]
    x, P = unscented_transform(np.array(after), other.Wm, other.Wc, half)
    found = moved(ukf(step, alpha), mean, cov, q, dt)
    np.testing.assert_allclose(found.mean, x, atol=1e-9)  # filterpy's sum of weights of 1e6
    np.testing.assert_allclose(found.cov, P, atol=1e-9)  # the same


def test_a_nonlinear_step_has_the_moments_of_filterpys_cubature():
    rng = np.random.default_rng(4)
    mean, cov, step = rng.normal(size=6), random_covariance(rng, 6), Mixed(rng.normal(size=(6, 6)))
    q, dt = 0.3, 0.4
    half = 0.5 * dt * q * np.eye(6)
    after = [step.step(None, x, NO_INPUT, dt) for x in spherical_radial_sigmas(mean, cov + half)]
    x, P = ckf_transform(np.array(after), half)
    found = moved(ckf(step), mean, cov, q, dt)
    np.testing.assert_allclose(found.mean, x[:, 0], atol=1e-13)  # rounding
    np.testing.assert_allclose(found.cov, P, atol=1e-13)  # rounding
    other = CubatureKalmanFilter(6, 1, dt, hx=None, fx=lambda x, dt: step.step(None, x, None, dt))
    other.x, other.P, other.Q = mean[:, None], cov + half, half
    other.predict()
    np.testing.assert_allclose(found.cov, other.P, atol=1e-13)  # rounding


@pytest.mark.parametrize('alpha', ALPHAS)
def test_mean_and_variance_of_a_square_are_exact(alpha):
    mean, variance = 0.7, 0.4  # of x; those of x^2 are m^2 + P and 4 m^2 P + 2 P^2
    found = moved(ukf(Squared(), alpha), np.array([mean]), np.array([[variance]]))
    # differences of alpha^2 P on numbers of 1, times a weight of 1 / alpha^2
    np.testing.assert_allclose(found.mean, [mean**2 + variance], rtol=1e-15 / alpha**2 + 1e-14)
    exact = 4 * mean**2 * variance + 2 * variance**2
    np.testing.assert_allclose(found.cov, [[exact]], rtol=1e-15 / alpha**2 + 1e-14)  # the same


def test_cubature_knows_the_mean_of_a_square_but_not_all_of_its_variance():
    mean, variance = 0.7, 0.4
    found = moved(ckf(Squared()), np.array([mean]), np.array([[variance]]))
    np.testing.assert_allclose(found.mean, [mean**2 + variance], rtol=1e-14)  # rounding
    # two points at one standard deviation: the fourth moment is 1 P^2, not 3 P^2
    np.testing.assert_allclose(found.cov, [[4 * mean**2 * variance]], rtol=1e-14)  # rounding


@pytest.mark.parametrize('kalman', [ukf(Squared(), 0.5), ckf(Squared())], ids=['ukf', 'ckf'])
def test_means_of_the_squares_of_correlated_states_are_exact(kalman):
    rng = np.random.default_rng(5)
    mean, cov = rng.normal(size=7), random_covariance(rng, 7)
    np.testing.assert_allclose(
        moved(kalman, mean, cov).mean, mean**2 + np.diag(cov), atol=1e-13
    )  # rounding


def test_unscented_mean_of_a_curved_step_is_better_than_the_linearised():
    # the reason for sigma points: E[sin x] = exp(-P/2) sin m for a Gaussian
    class Sine:
        def step(self, model, x, u, dt):
            return np.sin(x)

    mean, variance = 1.0, 0.09
    exact = np.exp(-variance / 2) * np.sin(mean)
    linearised = abs(np.sin(mean) - exact)
    for kalman in (ukf(Sine()), ckf(Sine())):
        found = moved(kalman, np.array([mean]), np.array([[variance]])).mean[0]
        # what is left is of fourth order: P^2 / 8, over P / 2 of the linearised mean
        assert abs(found - exact) < 0.05 * linearised


@pytest.mark.parametrize(('make', 'expected'), [(ukf, 13), (ckf, 12)])
def test_a_prediction_costs_one_step_per_point_and_no_more(make, expected):
    counting = Counted()
    kalman, belief = make(counting), Gaussian(np.zeros(6), np.eye(6))
    moved(kalman, belief.mean, belief.cov)
    assert counting.steps == expected  # 2 n + 1, and 2 n
    rows = np.array([[0, 1]])
    kalman.forecast(belief, None, [NO_INPUT] * 4, np.zeros(6), 0.1, rows)
    assert counting.steps == 5 * expected


@pytest.mark.parametrize('make', [ukf, ckf])
@pytest.mark.parametrize('bad', [-1.0, 0.0, np.nan])
def test_a_covariance_without_a_root_is_an_error_of_arithmetic(make, bad):
    cov = np.diag([1.0, bad, 1.0])
    with pytest.raises(FloatingPointError, match='the covariance is not positive definite'):
        moved(make(Squared()), np.zeros(3), cov)


@pytest.mark.parametrize('make', [ukf, ckf])
def test_noise_enters_half_before_and_half_after_the_step(make):
    rng = np.random.default_rng(6)
    model = Linear(rng.normal(size=(4, 4)))
    cov, q, dt = random_covariance(rng, 4), rng.uniform(0.1, 1, 4), 0.1
    F = INTEGRATORS['rk4'].step_jac(model, np.zeros(4), NO_INPUT, dt)[1]
    half = 0.5 * dt * np.diag(q)
    found = make(INTEGRATORS['rk4']).predict(Gaussian(np.ones(4), cov), model, NO_INPUT, q, dt)
    # differences of 1e-3 of the spread, squared, for alpha = 1e-3
    np.testing.assert_allclose(found.cov, F @ (cov + half) @ F.T + half, atol=1e-9)
    np.testing.assert_allclose(found.mean, F @ np.ones(4), atol=1e-9)  # the same
