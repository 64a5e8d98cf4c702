"""How coordinates move by themselves: against expm, integrals, closed forms and limits."""

import numpy as np
import pytest
from references import order_of
from scipy.integrate import quad_vec
from scipy.linalg import expm

from cloth_predict.filters.kinematic import POLYNOMIALS, Motion, swing
from cloth_predict.filters.kinematic_bank import KinematicBank

MOTIONS = {
    **POLYNOMIALS,
    'a hand': swing(3.5, 15.0),
    'double root': swing(4.0, 4.0),
    'without decay': swing(0.0, 40.0),
    'Singer': swing(2.0, 0.0),
    'fast': swing(300.0, 1e4),
    'a pendulum': Motion((9.0, 0.4)),
}


def drift_of(motion):
    n = motion.order
    drift = np.diag(np.ones(n - 1), 1)
    drift[n - 1] = [-r for r in motion.resistance]
    return drift


def integral(motion, dt):
    drift, last = drift_of(motion), np.eye(motion.order)[:, [-1]]

    def spread(s):
        column = expm(drift * s) @ last
        return column @ column.T

    return quad_vec(spread, 0, dt, epsabs=1e-30, epsrel=1e-13)[0]


@pytest.mark.parametrize('dt', [1e-4, 0.01, 0.7, -0.02])
@pytest.mark.parametrize('motion', MOTIONS.values(), ids=MOTIONS.keys())
def test_transition_equals_expm(motion, dt):
    expected = expm(drift_of(motion) * dt)
    # rounding of expm, by the size of the whole matrix
    atol = 1e-13 * np.abs(expected).max()
    np.testing.assert_allclose(motion.over(dt)[0], expected, rtol=1e-12, atol=atol)


@pytest.mark.parametrize('dt', [1e-4, 0.01, 0.7])
@pytest.mark.parametrize('motion', MOTIONS.values(), ids=MOTIONS.keys())
def test_noise_equals_the_integral(motion, dt):
    expected = integral(motion, dt)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # by the size of each element, so that the 1e-22 of a position over 0.1 ms counts as well;
    # rounding, and what the quadrature leaves of an integrand that dies within a hundredth of dt
    np.testing.assert_allclose(motion.over(dt)[1] / size, expected / size, atol=1e-10)


@pytest.mark.parametrize('motion', MOTIONS.values(), ids=MOTIONS.keys())
def test_no_time_changes_nothing(motion):
    step, noise = motion.over(0.0)
    np.testing.assert_array_equal(step, np.eye(motion.order))
    np.testing.assert_array_equal(noise, np.zeros((motion.order, motion.order)))


def test_polynomials_are_those_of_the_textbooks():
    step, noise = POLYNOMIALS['constant_acceleration'].over(0.1)
    np.testing.assert_allclose(step, [[1, 0.1, 0.005], [0, 1, 0.1], [0, 0, 1]], rtol=1e-15)
    expected = [
        [0.1**5 / 20, 0.1**4 / 8, 0.1**3 / 6],
        [0.1**4 / 8, 0.1**3 / 3, 0.1**2 / 2],
        [0.1**3 / 6, 0.1**2 / 2, 0.1],
    ]
    np.testing.assert_allclose(noise, expected, rtol=1e-14)  # rounding
    noise = POLYNOMIALS['constant_velocity'].over(0.1)[1]
    np.testing.assert_allclose(noise, [row[1:] for row in expected[1:]], rtol=1e-14)  # rounding
    assert POLYNOMIALS['fixed'].over(0.1)[1] == pytest.approx(0.1, rel=1e-15)  # rounding


def test_without_restoring_a_swing_is_singers_model():
    """Singer 1970, eq. 7 and the first elements of eq. 9."""
    a, t = 1.7, 0.6
    e = np.exp(-a * t)
    step, noise = swing(a, 0.0).over(t)
    expected = [[1, t, (a * t - 1 + e) / a**2], [0, 1, (1 - e) / a], [0, 0, e]]
    np.testing.assert_allclose(step, expected, rtol=1e-14)  # rounding
    by_acceleration = [(1 - e) ** 2 / 2 / a**2, (1 - e**2) / 2 / a]
    np.testing.assert_allclose(noise[1:, 2], by_acceleration, rtol=1e-14)  # rounding


def test_without_decay_and_restoring_a_swing_is_a_constant_acceleration():
    exact = POLYNOMIALS['constant_acceleration']
    assert swing(0.0, 0.0) == exact
    small = np.array([1e-2, 3e-3, 1e-3])
    for part in (0, 1):
        for motions in ([swing(s, 0.0) for s in small], [swing(0.0, s) for s in small]):
            apart = [np.abs(m.over(0.3)[part] - exact.over(0.3)[part]).max() for m in motions]
            assert order_of(apart, small) == pytest.approx(1.0, abs=0.01)  # the first term's


def test_the_velocity_of_a_swing_is_a_damped_oscillation():
    decay, restoring, t = 3.5, 15.0, np.linspace(0.0, 3.0, 50)
    rate = np.sqrt(restoring - decay**2 / 4)
    wave = np.exp(-decay * t / 2) * (np.cos(rate * t) + decay / 2 / rate * np.sin(rate * t))
    found = [swing(decay, restoring).over(float(s))[0][1, 1] for s in t]
    np.testing.assert_allclose(found, wave, atol=1e-14)  # rounding


def test_the_noise_of_a_swing_settles():
    decay, restoring = 3.5, 15.0
    noise = swing(decay, restoring).over(60.0)[1]
    # the stationary covariance of a damped oscillator that white noise drives
    expected = [[1 / (2 * decay * restoring), 0], [0, 1 / (2 * decay)]]
    np.testing.assert_allclose(noise[1:, 1:], expected, atol=1e-15)  # rounding


@pytest.mark.parametrize('motion', ['fixed', 'a hand', 'without decay', 'fast'])
def test_two_steps_are_one(motion):
    first, second, both = (MOTIONS[motion].over(dt) for dt in (0.03, 0.11, 0.14))
    np.testing.assert_allclose(second[0] @ first[0], both[0], atol=1e-13)  # rounding
    expected = second[0] @ first[1] @ second[0].T + second[1]
    np.testing.assert_allclose(expected, both[1], rtol=1e-11, atol=1e-18)  # rounding


# --- one marker -------------------------------------------------------------------------------


def follow(motion, density, sigma, path, spread=1.0, dt=0.01):
    """Follow positions [m], shape (frames, 3), one after another."""
    bank = KinematicBank.unseen(motion, density, sigma, 1, spread)
    for position in path:
        bank, _ = bank.moved(dt).updated(position[None], np.ones(1, bool))
        yield bank


def test_a_fixed_node_without_noise_is_the_running_mean():
    sigma = 3e-4
    seen = np.array([0.4, 1.5, -0.2]) + np.random.default_rng(2).normal(0, sigma, (200, 3))
    banks = follow(POLYNOMIALS['fixed'], 0.0, sigma, seen)
    for count, bank in enumerate(banks, start=1):
        position, variance = bank.ahead(0.1)
        np.testing.assert_allclose(position[0], seen[:count].mean(axis=0), atol=1e-14)  # rounding
        assert variance[0] == pytest.approx(sigma**2 / count, rel=1e-12)  # rounding


@pytest.mark.parametrize(
    ('motion', 'start'),
    [
        ('constant_velocity', [0.3, -0.2]),
        ('constant_acceleration', [0.3, -0.2, 1.0]),
        ('a hand', [0.3, -0.2, 1.0]),
        ('Singer', [0.3, -0.2, 1.0]),
    ],
)
def test_without_noise_a_motion_is_followed_exactly(motion, start):
    drift = drift_of(MOTIONS[motion])
    path = [(expm(drift * k * 0.01) @ start)[[0, 0, 0]] * [1, -2, 3] for k in range(100)]
    *_, bank = follow(MOTIONS[motion], 0.0, 1e-4, np.array(path), spread=1e3)
    expected = np.outer(expm(drift * 1.19) @ start, [1, -2, 3])
    # the first belief of zero speed is forgotten but for (1e-4 / 1e3)^2 of it
    np.testing.assert_allclose(bank.mean_at(0.2)[0], expected, atol=1e-7)
