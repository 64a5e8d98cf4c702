"""Kinematic filters of one marker: their matrices against expm and integrals, then as a whole."""

from math import factorial

import numpy as np
import pytest
from references import kalman_predict, kalman_update
from scipy.integrate import quad_vec
from scipy.linalg import expm

from cloth_predict.filters.kinematic import ORDERS, KinematicTrack, transition, white_noise


@pytest.mark.parametrize('order', ORDERS.values())
@pytest.mark.parametrize('dt', [0.0, 0.01, 0.7])
def test_transition_equals_expm(order, dt):
    shift = np.eye(order, k=1)
    np.testing.assert_allclose(transition(order, dt), expm(shift * dt), atol=1e-15)  # rounding


@pytest.mark.parametrize('order', ORDERS.values())
@pytest.mark.parametrize('dt', [0.01, 0.7])
def test_white_noise_equals_the_integral(order, dt):
    shift, last = np.eye(order, k=1), np.eye(order)[:, [-1]]

    def spread(s):
        column = expm(shift * s) @ last
        return 3.0 * column @ column.T

    expected = quad_vec(spread, 0, dt, epsabs=1e-20, epsrel=1e-12)[0]
    # a polynomial of degree 4, which the quadrature integrates to rounding
    np.testing.assert_allclose(white_noise(order, 3.0, dt), expected, rtol=1e-12)


def test_white_noise_of_a_constant_velocity_as_in_the_textbooks():
    expected = 2.0 * np.array([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]])
    np.testing.assert_allclose(white_noise(2, 2.0, 0.1), expected, rtol=1e-15)  # rounding


@pytest.mark.parametrize('motion', ORDERS)
def test_track_equals_a_textbook_filter_of_three_coordinates(motion):
    rng = np.random.default_rng(1)
    order, density, sigma, spread = ORDERS[motion], 0.3, 2e-3, 0.7
    start = rng.normal(size=3)
    track = KinematicTrack(motion, density, sigma, start, spread)
    x = np.append(start, np.zeros(3 * order - 3))
    P = np.diag([sigma**2] * 3 + [spread**2] * (3 * order - 3))
    H, R = np.eye(3, 3 * order), sigma**2 * np.eye(3)
    for _ in range(50):
        dt, ahead = rng.uniform(0.005, 0.03), rng.uniform(0, 0.2)
        F = np.kron(expm(np.eye(order, k=1) * dt), np.eye(3))
        last = [dt**k / factorial(k) for k in range(order)][::-1]
        Q = np.array(
            [
                [density * a * b * dt / (2 * order - 1 - i - j) for j, b in enumerate(last)]
                for i, a in enumerate(last)
            ]
        )
        x, P = kalman_predict(x, P, F, np.kron(Q, np.eye(3)))
        track.predict(dt)
        if rng.random() < 0.8:
            z = start + rng.normal(0, 0.05, 3)
            x, P = kalman_update(x, P, H, R, z)
            track.update(z)
        found = track.extrapolate(0.0)
        np.testing.assert_allclose(found[:order].ravel(), x, atol=1e-9)  # the house bound
        np.testing.assert_array_equal(found[order:], 0.0)
        F = np.kron(expm(np.eye(order, k=1) * ahead), np.eye(3))
        np.testing.assert_allclose(track.extrapolate(ahead)[0], (F @ x)[:3], atol=1e-9)  # the same
        expected = (F @ P @ F.T)[0, 0] + white_noise(order, density, ahead)[0, 0]
        assert track.variance(ahead) == pytest.approx(expected, rel=1e-9)  # the same
        assert track.variance(0.0) == pytest.approx(P[2, 2], rel=1e-9)  # the same


def test_a_fixed_node_without_noise_is_the_running_mean():
    rng = np.random.default_rng(2)
    sigma = 3e-4
    seen = np.array([0.4, 1.5, -0.2]) + rng.normal(0, sigma, (200, 3))
    track = KinematicTrack('fixed', 0.0, sigma, seen[0])
    for count, position in enumerate(seen[1:], start=2):
        track.predict(0.01)
        track.update(position)
        found = track.extrapolate(0.1)
        np.testing.assert_allclose(found[0], seen[:count].mean(axis=0), atol=1e-14)  # rounding
        assert track.variance(0.1) == pytest.approx(sigma**2 / count, rel=1e-12)  # rounding
        np.testing.assert_array_equal(found[1:], 0.0)


def test_constant_motions_are_followed_exactly():
    # without noise a polynomial of the filter's degree is extrapolated to itself
    time = np.arange(100) * 0.01
    velocity, acceleration = np.array([0.3, -0.2, 1.0]), np.array([1.0, 2.0, -3.0])
    for motion, curve in (('constant_velocity', 0.0), ('constant_acceleration', 1.0)):
        path = time[:, None] * velocity + curve * 0.5 * time[:, None] ** 2 * acceleration
        track = KinematicTrack(motion, 0.0, 1e-4, path[0], spread=1e3)
        for position in path[1:]:
            track.predict(0.01)
            track.update(position)
        end = time[-1] + 0.2
        found = track.extrapolate(0.2)
        expected = end * velocity + curve * 0.5 * end**2 * acceleration
        # the first belief of zero speed is forgotten but for (1e-4 / 1e3)^2 of it
        np.testing.assert_allclose(found[0], expected, atol=1e-8)
        np.testing.assert_allclose(found[1], velocity + curve * end * acceleration, atol=1e-7)
