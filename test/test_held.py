"""The EKF whose covariance rests: exact where it does not, steady where it does."""

from dataclasses import replace

import numpy as np
import pytest
from references import Linear, kalman_update, random_surface

from cloth_predict.filters import held
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.held import GONE, SETTLED, HeldCovariance
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import Gaussian

NO_INPUT = np.zeros(0)
EXACT = ExtendedKalmanFilter(ImplicitEuler())
DT = 0.01
Q = np.repeat([0.0, 2.0], 9)


@pytest.fixture
def chain():
    """A hung chain of four, linear at rest."""
    rng = np.random.default_rng(1)
    mesh, x, u = random_surface(rng, 1, 4, (0,), rest=(0.8, 0.99))
    return Linear(mesh.jac(x, u).toarray())


def nodes(*free):
    return VisiblePositions.of_nodes(np.array(free), 1e-3)


def run(estimator, model, frames, seen, dts=None):
    """Beliefs after each frame; seen: the nodes that frame k shows."""
    rng = np.random.default_rng(2)
    belief = estimator.start(
        Gaussian(np.zeros(18), np.diag(np.repeat([1e-4, 0.1], 9))), model, NO_INPUT, Q
    )
    found = []
    for k in range(frames):
        for dt in (DT,) if dts is None else dts(k):
            belief = estimator.predict(belief, model, NO_INPUT, Q, dt)
        obs = nodes(*seen(k))
        belief, _ = estimator.update(belief, obs, rng.normal(0, 1e-3, len(obs.rows)))
        found.append(belief)
    return found


def test_until_it_is_settled_it_is_the_exact_filter(chain):
    for resting, exact in zip(
        run(HeldCovariance(EXACT, 4), chain, SETTLED + 1, lambda k: (0, 1, 2)),
        run(EXACT, chain, SETTLED + 1, lambda k: (0, 1, 2)),
        strict=True,
    ):
        np.testing.assert_array_equal(resting.mean, exact.mean)
        np.testing.assert_array_equal(resting.cov, exact.cov)


def test_while_a_marker_is_gone_it_is_the_exact_filter(chain):
    def seen(k):
        return (0, 1, 2) if k % 24 > 6 else (0, 2)  # gone for 7 frames, seen for 17

    for resting, exact in zip(
        run(HeldCovariance(EXACT, 4), chain, 80, seen), run(EXACT, chain, 80, seen), strict=True
    ):
        np.testing.assert_array_equal(resting.cov, exact.cov)


def test_a_marker_that_is_gone_for_good_lets_it_rest_again(chain, monkeypatch):
    calls = []
    exact = held.ExtendedKalmanFilter.predict

    def counted(self, *arguments):
        calls.append(1)
        return exact(self, *arguments)

    monkeypatch.setattr(held.ExtendedKalmanFilter, 'predict', counted)

    def seen(k):
        return (0, 1, 2) if k < 40 or k >= 400 else (0, 2)

    run(HeldCovariance(EXACT, 4), chain, 400, seen)
    # it moves for the first 31, from when the marker is gone until it has settled, and some others
    moved = SETTLED + 1 + GONE + SETTLED
    assert moved < len(calls) < moved + (400 - moved) / 3
    calls.clear()
    # and from the frame at which it is back
    beliefs = run(HeldCovariance(EXACT, 4), chain, 410, seen)
    assert [belief.even for belief in beliefs[399:403]] == [400 - 40 - GONE, 0, 1, 2]


def test_while_the_rate_changes_the_covariance_moves(chain):
    # after a gap of many steps the uncertainty is that of the exact filter
    def dts(k):
        return (DT,) * 20 if k == 59 else (DT,)

    resting = run(HeldCovariance(EXACT, 4), chain, 60, lambda k: (0, 1, 2), dts)[-1]
    exact = run(EXACT, chain, 60, lambda k: (0, 1, 2), dts)[-1]
    spread, expected = np.diag(resting.prior), np.diag(exact.cov)
    assert (spread > 2 * expected).any()  # it has grown before the measurement
    # in the steady state one step of twenty that rested is not missed
    np.testing.assert_allclose(np.diag(resting.cov), expected, rtol=1e-3)


def test_in_the_steady_state_it_is_the_exact_filter_again(chain):
    resting = run(HeldCovariance(EXACT, 4), chain, 2500, lambda k: (0, 2))[-1]
    exact = run(EXACT, chain, 2500, lambda k: (0, 2))[-1]
    # the slowest part of the covariance has been forgotten in the 6 s in which it moved
    scale = np.sqrt(np.diag(exact.cov))
    assert np.abs((resting.cov - exact.cov) / np.outer(scale, scale)).max() < 1e-3


def test_the_mean_moves_at_every_frame_with_the_gain_of_what_it_sees(chain):
    estimator = HeldCovariance(EXACT, 4)
    belief = run(estimator, chain, 42, lambda k: (0, 1, 2))[-1]
    assert belief.even % 4 == 2  # the next step rests
    predicted = estimator.predict(belief, chain, NO_INPUT, Q, DT)
    F = ImplicitEuler().step_jac(chain, belief.mean, NO_INPUT, DT)[1]
    np.testing.assert_allclose(predicted.mean, F @ belief.mean, atol=1e-15)  # rounding
    np.testing.assert_array_equal(predicted.cov, belief.prior)
    z = np.array([1.0, 2.0, 3.0]) * 1e-3
    found, _ = estimator.update(predicted, nodes(1), z)
    H = np.zeros((3, 18))
    H[np.arange(3), [3, 4, 5]] = 1.0
    x, P = kalman_update(predicted.mean, belief.prior, H, 1e-6 * np.eye(3), z)
    np.testing.assert_allclose(found.mean, x, atol=1e-12)  # rounding, condition of S below 1e3
    np.testing.assert_allclose(found.cov, P, atol=1e-12)  # the same
    # a marker that is missed for a frame or two is not gone
    again = estimator.predict(found, chain, NO_INPUT, Q, DT)
    np.testing.assert_array_equal(again.cov, belief.prior)


def test_it_rests_in_all_but_every_fourth_frame(chain, monkeypatch):
    calls = []
    exact = held.ExtendedKalmanFilter.predict

    def counted(self, *arguments):
        calls.append(1)
        return exact(self, *arguments)

    monkeypatch.setattr(held.ExtendedKalmanFilter, 'predict', counted)
    run(HeldCovariance(EXACT, 4), chain, SETTLED + 81, lambda k: (0, 1) if k % 3 else (0,))
    assert len(calls) == SETTLED + 1 + 20  # though every third frame misses a marker


def test_the_covariance_of_a_prediction_rests_as_well(chain):
    estimator, rows = HeldCovariance(EXACT, 4), np.array([[0, 1, 2], [6, 7, 8]])

    def ahead(filter_, belief, steps=3):
        return filter_.forecast(belief, chain, [NO_INPUT] * steps, Q, DT, rows)

    belief = run(estimator, chain, 41, lambda k: (0, 1, 2))[-1]
    mean, first = ahead(estimator, belief)
    for found, expected in zip((mean, first), ahead(EXACT, belief), strict=True):
        np.testing.assert_array_equal(found, expected)
    last, anew = first, []
    for frame in range(42, 51):
        belief = estimator.predict(belief, chain, NO_INPUT, Q, DT)
        belief, _ = estimator.update(belief, nodes(0, 1, 2), np.full(9, 1e-3))
        mean, cov = ahead(estimator, belief)
        exact_mean, exact = ahead(EXACT, belief)
        np.testing.assert_allclose(mean, exact_mean, atol=1e-15)  # rounding
        np.testing.assert_allclose(cov, exact, rtol=0.02)  # nearly steady after 0.4 s
        if cov is not last:
            anew.append(frame)
            np.testing.assert_array_equal(cov, exact)
        last = cov
        other = ahead(estimator, belief, 5)[1]  # another horizon is another prediction
        np.testing.assert_allclose(other, ahead(EXACT, belief, 5)[1], rtol=0.02)
    assert anew == [44, 48]


def test_a_belief_cannot_be_written_to_and_can_be_repaired(chain):
    belief = run(HeldCovariance(EXACT, 4), chain, 40, lambda k: (0, 1))[-1]
    for array in (belief.mean, belief.cov, belief.prior, belief.last):
        with pytest.raises(ValueError, match='read-only'):
            array.flat[0] = 1.0
    assert replace(belief, cov=np.eye(18)).prior is not None
