"""Least squares against the closed form, the textbook's filter and another optimiser."""

import warnings
from math import exp

import numpy as np
import pytest
from references import (
    Linear,
    damped_oscillators,
    kalman_predict,
    kalman_update,
    random_covariance,
    random_surface,
    selection,
    trapezoid,
)
from scipy.optimize import least_squares

from cloth_predict.filters.least_squares import LeastSquares
from cloth_predict.filters.recursive_least_squares import RecursiveLeastSquares
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import Gaussian

NO_INPUT = np.zeros(0)
NO_NOISE = np.zeros(12)
SIGMA, DT = 0.1, 0.05


@pytest.fixture
def problem():
    """Coupled oscillators in two nodes' coordinates, a prior, and 12 frames, some incomplete."""
    rng = np.random.default_rng(1)
    model = damped_oscillators(rng, 6)
    prior = Gaussian(rng.normal(size=12), random_covariance(rng, 12))
    frames = []
    for nodes in ([0, 1], [1], [], [0], [0, 1], [1], [0], [0, 1], [], [0, 1], [0, 1], [1]):
        obs = VisiblePositions.of_nodes(np.array(nodes, np.int64), SIGMA)
        frames.append((obs, rng.normal(size=len(obs.rows))))
    F = INTEGRATORS['rk4'].step_jac(model, np.zeros(12), NO_INPUT, DT)[1]
    return model, prior, frames, F


def run(kalman, belief, model, frames, q=0.0):
    noise = np.repeat([0.0, q], model.dim_x // 2)
    for obs, z in frames:
        belief = kalman.predict(belief, model, NO_INPUT, noise, DT)
        belief, _ = kalman.update(belief, obs, z)
    return belief


def closed_form(prior, frames, F, weights=None):
    """State at the end and its covariance, (A'A)^-1 A'y and (A'A)^-1 (Gomes 2016, eq. 4.10).

    A has the prior's rows, then those of each frame over sigma; weights, one for each of these.
    """
    weights = np.ones(len(frames) + 1) if weights is None else weights
    whitening = np.linalg.inv(np.linalg.cholesky(prior.cov))
    A, y, Phi = [weights[0] * whitening], [weights[0] * whitening @ prior.mean], np.eye(len(F))
    for weight, (obs, z) in zip(weights[1:], frames, strict=True):
        Phi = F @ Phi
        A.append(weight * Phi[obs.rows] / SIGMA)
        y.append(weight * z / SIGMA)
    A, y = np.concatenate(A), np.concatenate(y)
    x0 = np.linalg.lstsq(A, y, rcond=None)[0]
    return Phi @ x0, Phi @ np.linalg.inv(A.T @ A) @ Phi.T


# --- the sliding window


def test_a_full_window_is_the_closed_form(problem):
    model, prior, frames, F = problem
    kalman = LeastSquares(INTEGRATORS['rk4'], window=10.0)
    found = run(kalman, kalman.start(prior, model, NO_INPUT, NO_NOISE), model, frames, q=3.0)
    mean, cov = closed_form(prior, frames, F)
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)  # the house bound
    np.testing.assert_allclose(found.cov, cov, atol=1e-9)  # the same
    np.testing.assert_allclose(
        np.linalg.matrix_power(F, 12) @ found.start, mean, atol=1e-9
    )  # the same
    assert found.prior is prior
    assert len(found.legs) == 12


def test_a_full_window_is_the_kalman_filter_without_process_noise(problem):
    model, prior, frames, F = problem
    kalman = LeastSquares(INTEGRATORS['rk4'], window=10.0)
    belief, x, P = kalman.start(prior, model, NO_INPUT, NO_NOISE), prior.mean, prior.cov
    for obs, z in frames:
        belief = kalman.predict(belief, model, NO_INPUT, np.ones(12), DT)
        belief, learnt = kalman.update(belief, obs, z)
        x, P = kalman_predict(x, P, F, np.zeros((12, 12)))
        H = selection(obs.rows, 12)
        R = SIGMA**2 * np.eye(len(z))
        S, residual = H @ P @ H.T + R, z - H @ x
        np.testing.assert_allclose(learnt.residual, residual, atol=1e-9)  # the house bound
        np.testing.assert_allclose(learnt.cov, S, atol=1e-9)  # the same
        nis = residual @ np.linalg.solve(S, residual)
        assert learnt.nis == pytest.approx(nis, rel=1e-7)  # 1e-9 over sigma^2 of 0.01
        x, P = kalman_update(x, P, H, R, z)
        np.testing.assert_allclose(belief.mean, x, atol=1e-9)  # the house bound
        np.testing.assert_allclose(belief.cov, P, atol=1e-9)  # the same


def test_a_short_window_is_fitted_onto_what_a_kalman_filter_knew_at_its_start(problem):
    model, prior, frames, F = problem
    q, kept = 0.7, 4
    kalman = LeastSquares(INTEGRATORS['rk4'], window=kept * DT)
    found = run(kalman, kalman.start(prior, model, NO_INPUT, NO_NOISE), model, frames, q)
    Q = trapezoid(F, DT * np.repeat([0.0, q], 6))
    x, P = prior.mean, prior.cov
    for obs, z in frames[:-kept]:
        x, P = kalman_predict(x, P, F, Q)
        x, P = kalman_update(x, P, selection(obs.rows, 12), SIGMA**2 * np.eye(len(z)), z)
    np.testing.assert_allclose(found.prior.mean, x, atol=1e-9)  # the house bound
    np.testing.assert_allclose(found.prior.cov, P, atol=1e-9)  # the same
    mean, cov = closed_form(Gaussian(x, P), frames[-kept:], F)
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)  # the same
    np.testing.assert_allclose(found.cov, cov, atol=1e-9)  # the same


@pytest.mark.parametrize(('window', 'legs'), [(0.2, 4), (0.2499, 4), (0.25, 5), (0.01, 1)])
def test_the_window_stays_as_long_as_configured(problem, window, legs):
    model, prior, frames, _ = problem
    kalman = LeastSquares(INTEGRATORS['rk4'], window)
    found = run(kalman, kalman.start(prior, model, NO_INPUT, NO_NOISE), model, frames)
    assert len(found.legs) == legs
    # a step longer than the window is kept: without one there is nothing to fit
    assert found.duration <= max(window, DT) + 1e-9


def test_measurements_at_the_start_and_several_after_one_step(problem):
    model, prior, frames, F = problem
    kalman = LeastSquares(INTEGRATORS['rk4'], window=10.0)
    belief = kalman.start(prior, model, NO_INPUT, NO_NOISE)
    x, P = prior.mean, prior.cov
    for move, (obs, z) in zip([0, 1, 0, 1, 1, 0], frames, strict=False):
        if move:
            belief = kalman.predict(belief, model, NO_INPUT, NO_NOISE, DT)
            x, P = kalman_predict(x, P, F, np.zeros((12, 12)))
        belief, _ = kalman.update(belief, obs, z)
        x, P = kalman_update(x, P, selection(obs.rows, 12), SIGMA**2 * np.eye(len(z)), z)
        np.testing.assert_allclose(belief.mean, x, atol=1e-9)  # the house bound
        np.testing.assert_allclose(belief.cov, P, atol=1e-9)  # the same


def test_any_measurement_matrix_and_a_full_noise_covariance(problem):
    model, prior, _, F = problem
    rng = np.random.default_rng(2)

    class Mixture:
        matrix, cov = rng.normal(size=(3, 12)), random_covariance(rng, 3)

        def h(self, x):
            return self.matrix @ x

        def jac(self, x):
            return self.matrix

    kalman, obs = LeastSquares(INTEGRATORS['rk4'], window=10.0), Mixture()
    frames = [(obs, rng.normal(size=3)) for _ in range(5)]
    found = run(kalman, kalman.start(prior, model, NO_INPUT, NO_NOISE), model, frames)
    x, P = prior.mean, prior.cov
    for _, z in frames:
        x, P = kalman_update(F @ x, F @ P @ F.T, obs.matrix, obs.cov, z)
    np.testing.assert_allclose(found.mean, x, atol=1e-9)  # the house bound
    np.testing.assert_allclose(found.cov, P, atol=1e-9)  # the same


def test_on_springs_the_fit_is_the_minimum_that_another_optimiser_finds():
    rng = np.random.default_rng(3)
    mesh, x, u = random_surface(rng, 2, 3, (0, 2))
    size, sigma, dt, step = mesh.dim_x, 1e-3, 0.01, ImplicitEuler().step
    prior = Gaussian(x, np.diag(np.repeat([1e-4, 0.1], size // 2)))
    truth = x + rng.normal(0, 1, size) * np.sqrt(np.diag(prior.cov))
    kalman = LeastSquares(ImplicitEuler(), window=1.0)
    belief, frames = kalman.start(prior, mesh, u, np.zeros(size)), []
    for _ in range(8):
        truth = step(mesh, truth, u, dt)
        obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(4) < 0.7), sigma)
        frames.append((obs, obs.h(truth) + rng.normal(0, sigma, len(obs.rows))))
        belief = kalman.predict(belief, mesh, u, np.zeros(size), dt)
        belief, _ = kalman.update(belief, *frames[-1])

    def residuals(x0):
        parts, at = [(x0 - x) / np.sqrt(np.diag(prior.cov))], x0
        for obs, z in frames:
            at = step(mesh, at, u, dt)
            parts.append((z - obs.h(at)) / sigma)
        return np.concatenate(parts)

    best = least_squares(residuals, x, x_scale=np.sqrt(np.diag(prior.cov)), xtol=1e-12, ftol=1e-12)
    spread = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    # the last step was below 1e-2 of the spread, and the one before at least ten times longer
    assert np.abs((belief.start - best.x) / spread).max() < 1e-3
    first = np.linalg.norm(residuals(x)) ** 2
    assert first > 10 * np.linalg.norm(residuals(best.x)) ** 2  # the prior was far off


def test_a_window_without_a_root_is_an_error_of_arithmetic(problem):
    model, prior, frames, _ = problem
    kalman = LeastSquares(INTEGRATORS['rk4'], window=10.0)
    flat = Gaussian(prior.mean, np.diag([0.0] + [1.0] * 11))
    with pytest.raises(FloatingPointError, match='the covariance is not positive definite'):
        run(kalman, kalman.start(flat, model, NO_INPUT, NO_NOISE), model, frames)


# --- recursive, with forgetting


@pytest.mark.parametrize('forgetting', [0.07, 0.5, 1e9])
def test_recursive_is_the_closed_form_with_exponential_weights(problem, forgetting):
    model, prior, frames, F = problem
    kalman = RecursiveLeastSquares(INTEGRATORS['rk4'], forgetting)
    found = run(kalman, kalman.start(prior, model, NO_INPUT, NO_NOISE), model, frames, q=3.0)
    age = DT * np.append(12, np.arange(12)[::-1])  # of the prior, then of each frame
    mean, cov = closed_form(prior, frames, F, np.sqrt(np.exp(-age / forgetting)))
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)  # the house bound
    np.testing.assert_allclose(found.cov, cov, atol=1e-9)  # the same


def test_what_is_forgotten_depends_on_time_and_not_on_the_frame_rate():
    still, prior = Linear(np.zeros((2, 2))), Gaussian(np.zeros(2), np.diag([1.0, 2.0]))
    kalman = RecursiveLeastSquares(INTEGRATORS['rk4'], 0.2)
    for steps in (1, 7):
        belief = prior
        for _ in range(steps):
            belief = kalman.predict(belief, still, NO_INPUT, np.zeros(2), 0.1 / steps)
        np.testing.assert_allclose(belief.cov, exp(0.5) * prior.cov, rtol=1e-14)  # rounding


def test_blind_for_too_long_it_overflows_as_an_error_of_arithmetic():
    still, prior = Linear(np.zeros((2, 2))), Gaussian(np.zeros(2), np.eye(2))
    kalman = RecursiveLeastSquares(INTEGRATORS['rk4'], 0.01)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        with pytest.raises(FloatingPointError, match='overflow'):
            kalman.predict(prior, still, NO_INPUT, np.zeros(2), 8.0)
        rows = np.array([[0, 1]])
        with pytest.raises(FloatingPointError, match='overflow'):
            kalman.forecast(prior, still, [NO_INPUT] * 8, np.zeros(2), 1.0, rows)
