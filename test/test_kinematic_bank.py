"""Many kinematic filters at once, against filterpy's and a textbook's; late frames."""

from __future__ import annotations

import numpy as np
import pytest
from references import KinematicTrack, kalman_predict, kalman_update, noise_over
from scipy.linalg import expm

from cloth_predict.config import build
from cloth_predict.evaluation.predictors import BASELINES, Hold, Kinematic
from cloth_predict.filters.kinematic import POLYNOMIALS, swing
from cloth_predict.filters.kinematic_bank import KinematicBank
from cloth_predict.types import FloatArray

SIGMA, DENSITY, MARKERS = 1e-3, 3.0, 5
MOTIONS = {**POLYNOMIALS, 'swing': swing(3.5, 15.0), 'Singer': swing(2.0, 0.0)}
DRIFTS = {
    'fixed': [[0.0]],
    'constant_velocity': [[0.0, 1.0], [0.0, 0.0]],
    'constant_acceleration': [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]],
    'swing': [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -15.0, -3.5]],
    'Singer': [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -2.0]],
}
"""Of the position and its derivatives."""


@pytest.mark.parametrize('name', MOTIONS)
def test_bank_equals_one_filter_of_filterpy_for_each_marker(name: str) -> None:
    rng = np.random.default_rng(1)
    drift = np.array(DRIFTS[name])
    bank = KinematicBank.unseen(MOTIONS[name], DENSITY, SIGMA, MARKERS)
    tracks: dict[int, KinematicTrack] = {}
    for _ in range(30):
        dt, ahead = rng.uniform(0.002, 0.05), rng.uniform(0.0, 0.3)
        positions = rng.normal(0.0, 0.1, (MARKERS, 3))
        visible = rng.random(MARKERS) > 0.5
        bank = bank.moved(dt)
        nis = []
        for marker, track in tracks.items():
            track.predict(dt)
            if visible[marker]:
                residual = positions[marker] - track.extrapolate(0.0)[0]
                nis += list(residual**2 / (track.variance(0.0) + SIGMA**2))
                track.update(positions[marker])
        for marker in np.flatnonzero(visible).tolist():
            if marker not in tracks:
                tracks[marker] = KinematicTrack(drift, DENSITY, SIGMA, positions[marker])
        bank, found = bank.updated(positions, visible)
        # 1e-11: the same numbers, but for rounding of the reference's integral
        assert found == pytest.approx(np.mean(nis) if nis else np.nan, rel=1e-11, nan_ok=True)
        position, variance = bank.ahead(ahead)
        for marker in range(MARKERS):
            if marker not in tracks:
                assert np.isnan(position[marker]).all()
                assert np.isnan(variance[marker])
                continue
            expected = tracks[marker].extrapolate(ahead)[0]
            np.testing.assert_allclose(position[marker], expected, rtol=1e-11, atol=1e-12)
            assert variance[marker] == pytest.approx(tracks[marker].variance(ahead), rel=1e-11)
    assert len(tracks) == MARKERS


@pytest.mark.parametrize('name', MOTIONS)
def test_a_marker_equals_a_textbook_filter_of_three_coordinates(name: str) -> None:
    rng = np.random.default_rng(1)
    drift, spread, start = np.array(DRIFTS[name]), 0.7, rng.normal(size=3)
    order, one = len(drift), np.eye(3)
    bank = KinematicBank.unseen(MOTIONS[name], DENSITY, SIGMA, 1, spread)
    bank, _ = bank.updated(start[None], np.ones(1, bool))
    x = np.append(start, np.zeros(3 * order - 3))
    P = np.diag([SIGMA**2] * 3 + [spread**2] * (3 * order - 3))
    H, R = np.eye(3, 3 * order), SIGMA**2 * one
    for _ in range(50):
        dt, z, seen = rng.uniform(0.005, 0.03), start + rng.normal(0, 0.05, 3), rng.random() < 0.8
        Q = np.kron(DENSITY * noise_over(drift, dt), one)
        x, P = kalman_predict(x, P, np.kron(expm(drift * dt), one), Q)
        bank = bank.moved(dt)
        if seen:
            x, P = kalman_update(x, P, H, R, z)
            bank, _ = bank.updated(z[None], np.ones(1, bool))
        np.testing.assert_allclose(bank.mean[0].ravel(), x, atol=1e-9)  # the house bound
        expected = np.kron(bank.cov[0], one)
        np.testing.assert_allclose(expected, P, rtol=1e-9, atol=1e-12)  # the same


def frames(count: int = 80) -> tuple[list[int], FloatArray, np.ndarray]:
    rng = np.random.default_rng(2)
    stamps = (np.arange(count) * 10_000_000 + rng.integers(-3_000_000, 3_000_000, count)).tolist()
    return stamps, rng.normal(size=(count, MARKERS, 3)), rng.random((count, MARKERS)) > 0.3


@pytest.mark.parametrize('name', BASELINES)
def test_late_frames_change_nothing_in_the_end(name: str) -> None:
    config = build({'model': {'rows': 1, 'cols': MARKERS}}, 'test')
    stamps, positions, visible = frames()
    order = np.arange(len(stamps))
    for k in (3, 20, 21, 40, 60):  # each comes after the five that follow it, 50 ms late
        order[k : k + 6] = np.roll(order[k : k + 6], -1)
    late, punctual = BASELINES[name](config), BASELINES[name](config)
    for k in order.tolist():
        late.step(stamps[k], positions[k], visible[k], np.zeros((0, 3)))
        late.step(stamps[k], positions[k] + 9.0, visible[k], np.zeros((0, 3)))  # there already
    for k in range(len(stamps)):
        punctual.step(stamps[k], positions[k], visible[k], np.zeros((0, 3)))
    np.testing.assert_array_equal(late.predict(0.1).position, punctual.predict(0.1).position)
    np.testing.assert_array_equal(late.predict(0.1).sigma, punctual.predict(0.1).sigma)
    np.testing.assert_array_equal(late.estimate().covariance, punctual.estimate().covariance)


def test_a_frame_before_all_others() -> None:
    config = build({'model': {'rows': 1, 'cols': MARKERS}}, 'test')
    stamps, positions, visible = frames(4)
    late, punctual = (Kinematic(config, 'constant_velocity', DENSITY) for _ in range(2))
    for k in (1, 2, 0, 3):
        late.step(stamps[k], positions[k], visible[k])
    for k in range(4):
        punctual.step(stamps[k], positions[k], visible[k])
    np.testing.assert_array_equal(late.predict(0.1).position, punctual.predict(0.1).position)


def test_hold_keeps_the_newest_of_each_marker() -> None:
    hold = Hold(build({'model': {'rows': 1, 'cols': 2}}, 'test'))
    hold.step(20, np.full((2, 3), 2.0), np.array([True, False]))
    hold.step(10, np.full((2, 3), 1.0), np.array([True, True]))
    assert hold.predict(0.1).position[:, 0].tolist() == [2.0, 1.0]
    assert hold.estimate().position[:, 0].tolist() == [2.0, 1.0]
    assert np.isnan(hold.estimate().covariance).all()


def test_several_densities_side_by_side() -> None:
    config = build({'model': {'rows': 1, 'cols': MARKERS}}, 'test')
    densities = np.array([0.01, 3.0, 100.0])
    together = Kinematic(config, 'constant_acceleration', densities)
    alone = [Kinematic(config, 'constant_acceleration', density) for density in densities]
    for stamp, positions, visible in zip(*frames(), strict=True):
        for filters in (together, *alone):
            filters.step(stamp, positions, visible)
    found = together.predict(0.1).position.reshape(3, MARKERS, 3)
    np.testing.assert_array_equal(found, [filters.predict(0.1).position for filters in alone])
