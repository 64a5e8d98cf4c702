"""The smoother: against filterpy, one least-squares problem for all times, and the textbook."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from references import (
    damped_oscillators,
    random_covariance,
    random_surface,
    selection,
    trapezoid,
)

from cloth_predict.config import build, load
from cloth_predict.encoding.interpolation import errors_between, through
from cloth_predict.encoding.smoothed import smoothed, timeline
from cloth_predict.errors import ConfigError
from cloth_predict.evaluation.cases import case_of, frames_of
from cloth_predict.filters.kinematic import POLYNOMIALS, swing
from cloth_predict.filters.kinematic_bank import KinematicBank
from cloth_predict.filters.smoothing import Moment, smooth, smooth_bank, stepped, taken
from cloth_predict.formats.recording import read
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.observations import LinearObservation, VisiblePositions
from cloth_predict.surface.starting import Starter
from cloth_predict.types import Gaussian, MarkerSequence

ROOT = Path(__file__).parents[1]
DT, TIMES = 0.01, 25
NO_INPUT = np.zeros(0)


def passed(model, integrator, prior, q, observations, u=NO_INPUT):
    """Moments of the filter with all states, and what a textbook needs of each time."""
    rows, belief = np.arange(model.dim_x), prior
    moments, steps = [Moment.of(belief, rows)], []
    for obs, z in observations:
        start = belief
        ahead, tangent = stepped(integrator, belief, model, u, q, DT)
        belief, learnt = taken(ahead, obs, z)
        moments.append(Moment.of(belief, rows, tangent, learnt))
        steps.append((start, tangent.push(np.eye(model.dim_x)), ahead))
    return moments, steps, belief


def measured(rng, size, sigma=0.02):
    """Measurements of some coordinates, others every time, and now and then of none."""
    found = []
    for k in range(TIMES):
        rows = np.flatnonzero(rng.random(size) < (0.0 if k % 7 == 3 else 0.6))
        obs = VisiblePositions.of_rows(rows, sigma)
        found.append((obs, rng.normal(0, 0.1, len(rows))))
    return found


def linear(rng, size=4):
    model = damped_oscillators(rng, size)
    q = np.concatenate([np.zeros(size), np.full(size, 0.3)])
    prior = Gaussian(rng.normal(size=2 * size), 0.1 * random_covariance(rng, 2 * size))
    return model, q, prior


def textbook(steps, last):
    """Rauch, Tung & Striebel 1965, by explicit inverses."""
    found = [(last.mean, last.cov)]
    for start, step_jac, ahead in reversed(steps):
        gain = start.cov @ step_jac.T @ np.linalg.inv(ahead.cov)
        mean, cov = found[-1]
        found.append(
            (
                start.mean + gain @ (mean - ahead.mean),
                start.cov + gain @ (cov - ahead.cov) @ gain.T,
            )
        )
    return found[::-1]


def all_at_once(model, q, prior, observations):
    """Mean and covariance of the states of all times: one linear least-squares problem."""
    size = model.dim_x
    _, tangent = ImplicitEuler().step_tangent(model, np.zeros(size), NO_INPUT, DT)
    F = tangent.push(np.eye(size))
    noise = np.linalg.inv(trapezoid(F, DT * q))
    information = np.zeros(((TIMES + 1) * size,) * 2)
    right = np.zeros(len(information))
    information[:size, :size] = np.linalg.inv(prior.cov)
    right[:size] = information[:size, :size] @ prior.mean
    for k, (obs, z) in enumerate(observations):
        H = selection(obs.rows, size)
        both = slice(k * size, (k + 2) * size)
        error = np.hstack([-F, np.eye(size)])
        information[both, both] += error.T @ noise @ error
        here = slice((k + 1) * size, (k + 2) * size)
        information[here, here] += H.T @ np.diag(1 / obs.cov) @ H
        right[here] += H.T @ (z / obs.cov)
    cov = np.linalg.inv(information)
    means = (cov @ right).reshape(-1, size)
    blocks = cov.reshape(TIMES + 1, size, TIMES + 1, size)
    return means, blocks[np.arange(TIMES + 1), :, np.arange(TIMES + 1)]


def test_equals_the_least_squares_fit_to_all_times():
    rng = np.random.default_rng(1)
    model, q, prior = linear(rng)
    observations = measured(rng, 4)
    moments, _, _ = passed(model, ImplicitEuler(), prior, q, observations)
    means, covs = all_at_once(model, q, prior, observations)
    for belief, mean, cov in zip(smooth(moments), means, covs, strict=True):
        np.testing.assert_allclose(belief.mean, mean, atol=1e-9)
        np.testing.assert_allclose(belief.cov, cov, atol=1e-9)


def test_equals_filterpy():
    rng = np.random.default_rng(2)
    model, q, prior = linear(rng)
    H = rng.normal(size=(3, 8))
    obs = LinearObservation(H, np.zeros(3), np.full(3, 4e-4))
    observations = [(obs, rng.normal(0, 0.1, 3)) for _ in range(TIMES)]
    moments, _, _ = passed(model, ImplicitEuler(), prior, q, observations)
    other = KalmanFilter(8, 3)
    _, tangent = ImplicitEuler().step_tangent(model, prior.mean, NO_INPUT, DT)
    other.F, other.H, other.R = tangent.push(np.eye(8)), H, np.diag(obs.cov)
    other.Q = trapezoid(other.F, DT * q)
    other.x, other.P = prior.mean.copy(), prior.cov.copy()
    means, covs, *_ = other.batch_filter([z for _, z in observations])
    means, covs, *_ = other.rts_smoother(means, covs)
    found = list(smooth(moments))[1:]  # filterpy does not keep the prior
    np.testing.assert_allclose([b.mean for b in found], means, atol=1e-9)
    np.testing.assert_allclose([b.cov for b in found], covs, atol=1e-9)


@pytest.mark.parametrize('name', ['implicit_euler', 'rk4'])
def test_equals_the_textbook_on_springs_with_unknown_forces(name):
    rng = np.random.default_rng(3)
    mesh, x, u = random_surface(rng, 2, 3, (0, 1))
    model = Disturbed(mesh, 0.3)
    size, loads = mesh.dim_x, model.dim_x - mesh.dim_x
    q = np.concatenate([np.zeros(size // 2), np.full(size // 2, 0.1), np.full(loads, 0.5)])
    prior = Gaussian(
        np.concatenate([x, np.zeros(loads)]), 1e-4 * random_covariance(rng, model.dim_x)
    )
    observations = [(obs, x[obs.rows] + z) for obs, z in measured(rng, size // 2, sigma=0.01)]
    moments, steps, last = passed(model, INTEGRATORS[name], prior, q, observations, u)
    for belief, (mean, cov) in zip(smooth(moments), textbook(steps, last), strict=True):
        np.testing.assert_allclose(belief.mean, mean, atol=1e-9 * np.abs(mean).max())
        np.testing.assert_allclose(belief.cov, cov, atol=1e-9 * np.abs(cov).max())


def test_rows_are_those_of_the_whole():
    rng = np.random.default_rng(4)
    model, q, prior = linear(rng)
    moments, _, _ = passed(model, ImplicitEuler(), prior, q, measured(rng, 4))
    rows = np.array([6, 0, 3])
    few = [replace(m, mean=m.mean[rows], cov=m.cov[rows], rows=rows) for m in moments]
    for part, whole in zip(smooth(few), smooth(moments), strict=True):
        np.testing.assert_allclose(part.mean, whole.mean[rows], atol=1e-15)
        np.testing.assert_allclose(part.cov, whole.cov[np.ix_(rows, rows)], atol=1e-15)


def test_a_window_sees_as_much_of_the_future_as_its_lag():
    rng = np.random.default_rng(5)
    model, q, prior = linear(rng)
    moments, _, _ = passed(model, ImplicitEuler(), prior, q, measured(rng, 4))
    for window, lag in ((4, 2), (3, 5), (1, 0), (40, 5)):
        held = list(smooth(iter(moments), window, lag))
        assert len(held) == len(moments)
        for k, belief in enumerate(held):
            seen = moments[: window * (k // window + 1) + lag]
            exact = list(smooth(seen))[k]
            np.testing.assert_array_equal(belief.mean, exact.mean)
            np.testing.assert_array_equal(belief.cov, exact.cov)
    assert list(smooth([])) == []


def test_the_past_gains_by_the_future():
    rng = np.random.default_rng(7)
    model, q, prior = linear(rng)
    moments, _, last = passed(model, ImplicitEuler(), prior, q, measured(rng, 4))
    found = list(smooth(moments))
    np.testing.assert_array_equal(found[-1].mean, last.mean)
    for belief, moment in zip(found, moments, strict=True):
        gain = np.linalg.eigvalsh(moment.cov - belief.cov)
        assert gain.min() > -1e-12  # rounding of covariances of the order of 0.1
    assert np.trace(found[5].cov) < 0.9 * np.trace(moments[5].cov)


@pytest.mark.parametrize('motion', [*POLYNOMIALS.values(), swing(5.0, 20.0)])
def test_driven_markers_equal_filterpy(motion):
    rng = np.random.default_rng(6)
    bank = KinematicBank.unseen(motion, 3.0, 0.01, 2)
    bank, _ = bank.updated(rng.normal(size=(2, 3)), np.ones(2, bool))
    dt = rng.uniform(0.005, 0.02, TIMES)
    before, after, measured_at = [bank], [bank], rng.normal(0, 0.1, (TIMES, 2, 3))
    for step, z in zip(dt, measured_at, strict=True):
        before.append(after[-1].moved(float(step)))
        after.append(before[-1].updated(z, np.ones(2, bool))[0])
    found = smooth_bank(before, after, dt)
    other = KalmanFilter(motion.order, 1)
    transitions, noises = zip(*(motion.over(float(step)) for step in dt), strict=True)
    means, covs, *_ = other.rts_smoother(
        np.array([b.mean[1, :, 2] for b in after])[..., None],
        np.array([b.cov[1] for b in after]),
        Fs=[np.eye(motion.order), *transitions],
        Qs=[np.eye(motion.order), *(3.0 * noise for noise in noises)],
    )
    np.testing.assert_allclose([b.mean[1, :, 2] for b in found], means[..., 0], atol=1e-9)
    np.testing.assert_allclose([b.cov[1] for b in found], covs, atol=1e-9)


# --- a surface between its frames


SHEET = {
    'model': {
        'rows': 3, 'cols': 3, 'width': 0.4, 'height': 0.4, 'mass': 0.1,
        'stiffness_structural': 60.0, 'stiffness_shear': 20.0, 'stiffness_flexion': 2.0,
        'damping': 0.05,
    },
    'anchors': {'nodes': [0, 1, 2], 'motion': 'fixed'},
    'force': {'kind': 'ornstein_uhlenbeck', 'sigma': 0.01, 'tau': 0.2},
    'filter': {'process_noise': 0.01, 'measurement_noise': 0.001},
    'frame': '',
}  # fmt: skip


def swinging(config, rng, seconds=3.0, every=4, sigma=1e-3, seen=0.9):
    """Truth at 100 Hz of a sheet that obeys the model to the letter, and measurements of it."""
    start = np.array([[x, -y, 0.0] for y in (0.0, 0.2, 0.4) for x in (0.0, 0.2, 0.4)])
    tracker_start = Starter(config).offer(0, start, np.ones(9, bool), np.zeros((0, 3)))
    model, q = tracker_start.model, tracker_start.noise
    x = tracker_start.belief.mean.copy()
    x[18:36] = rng.normal(0, 0.1, 18)
    u = tracker_start.input(start[:3], np.zeros((3, 3)))
    truth = []
    for _ in range(int(100 * seconds)):
        truth.append(np.concatenate([start[:3], x[:18].reshape(6, 3)]))
        noise = [rng.normal(0, np.sqrt(0.5 * DT * q)) for _ in range(2)]
        x = ImplicitEuler().step(model, x + noise[0], u, DT) + noise[1]
    truth = np.array(truth)
    stamps = 10_000_000 * np.arange(len(truth))
    positions = truth + rng.normal(0, sigma, truth.shape)
    visible = rng.random(positions.shape[:2]) < seen
    positions[~visible] = np.nan
    labels = tuple(f'n{k}' for k in range(9))
    given = slice(None, None, every)
    return truth, MarkerSequence(stamps[given], labels, positions[given], visible[given]), stamps


def test_errors_between_frames_are_as_large_as_predicted():
    config = build(SHEET, 'x')
    truth, markers, stamps = swinging(config, np.random.default_rng(8))
    inside = stamps <= markers.stamps[-1]
    positions, sigma = smoothed(markers, config, stamps[inside])
    error = (positions - truth[inside])[:, 3:] / sigma[:, 3:, None]
    # 300 times x 18 coordinates, alike over some 0.1 s: about 500 independent ones
    assert 0.85 < np.sqrt(np.mean(error[25:] ** 2)) < 1.15
    between = np.arange(len(error)) % 4 != 0
    spline = through(markers, stamps[inside], 'cubic')
    rms = [
        np.sqrt(np.nanmean((p - truth[inside])[25:][between[25:]][:, 3:] ** 2))
        for p in (positions, spline)
    ]
    assert rms[0] < 0.6 * rms[1]


def test_half_a_second_of_the_future_is_as_good_as_all_of_it():
    config = build(SHEET, 'x')
    _, markers, _ = swinging(config, np.random.default_rng(9), 4.0)
    whole, sigma = smoothed(markers, config, markers.stamps, window=10.0)
    apart, _ = smoothed(markers, config, markers.stamps)
    assert np.abs(whole - apart).max() < 0.02 * sigma[:, 3:].min()


def test_a_gap_parts_the_recording_and_nothing_is_known_in_it():
    config = build(SHEET, 'x')
    _, markers, _ = swinging(config, np.random.default_rng(10), 2.0)
    late = np.where(np.arange(len(markers)) < 20, 0, 2_000_000_000)
    markers = replace(markers, stamps=markers.stamps + late)
    times = np.arange(-10_000_000, int(markers.stamps[-1]) + 30_000_000, 10_000_000)
    positions, sigma = smoothed(markers, config, times)
    known = np.isfinite(sigma).all(axis=1)
    first, last, after = markers.stamps[19], markers.stamps[-1], markers.stamps[20]
    begins = [
        markers.stamps[k + int(markers.visible[k:, :3].all(axis=1).argmax())] for k in (0, 20)
    ]
    inside = ((times >= begins[0]) & (times <= first)) | ((times >= begins[1]) & (times <= last))
    np.testing.assert_array_equal(known, inside)
    np.testing.assert_array_equal(np.isfinite(positions).all(axis=(1, 2)), inside)
    assert after > first


def test_nothing_is_said_beside_a_frame_that_is_nowhere_near():
    config = build(SHEET, 'x')
    _, markers, stamps = swinging(config, np.random.default_rng(12), 1.5, seen=1.0)
    positions = markers.positions.copy()
    positions[20:, 4:] += [0.0, 0.0, 0.5]
    markers = replace(markers, positions=positions)
    _, sigma = smoothed(markers, config, stamps[stamps <= markers.stamps[-1]])
    known = np.isfinite(sigma).all(axis=1)
    assert known[: 4 * 19 + 1].all()
    assert not known[4 * 19 + 1 : 4 * 21].any()


def test_what_a_start_calibrates_is_known_from_the_first_frame_on():
    settings = SHEET | {
        'model': SHEET['model'] | {'rest_length': 'calibrated', 'calibration': 0.5}
    }
    config = build(settings, 'x')
    _, markers, _ = swinging(build(SHEET, 'x'), np.random.default_rng(11), 2.0, seen=1.0)
    positions, _ = smoothed(markers, config, markers.stamps)
    assert np.isfinite(positions).all()


def test_hands_that_move_carry_the_surface_between_frames():
    moving = {'nodes': [0, 1, 2], 'motion': 'swing', 'process_noise': 1.0}
    config = build(SHEET | {'anchors': moving}, 'x')
    at = 40_000_000 * np.arange(60)
    carried = 0.2 * np.sin(2e-9 * at)[:, None, None] * [1.0, 0.0, 0.0]
    sheet = np.array([[x, -y, 0.0] for y in (0.0, 0.2, 0.4) for x in (0.0, 0.2, 0.4)])
    labels = tuple(f'n{k}' for k in range(9))
    markers = MarkerSequence(at, labels, sheet + carried, np.ones((60, 9), bool))
    times = at[:-1] + 20_000_000
    positions, sigma = smoothed(markers, config, times)
    hand = 0.2 * np.sin(2e-9 * times)
    # the hand's spectral density allows for far more than a swing of 2 rad/s
    np.testing.assert_allclose(positions[5:-5, 0, 0], hand[5:-5], atol=2e-4)
    assert (sigma > 0).all()


def test_a_body_is_refused():
    config = build({'model': {'kind': 'superquadric', 'nodes': 12}}, 'x')
    nothing = MarkerSequence(np.zeros(0, int), (), np.zeros((0, 0, 3)), np.zeros((0, 0), bool))
    with pytest.raises(ConfigError, match='superquadric'):
        smoothed(nothing, config, np.zeros(0, int))


def test_no_step_is_longer_than_the_longest():
    stamps, times = np.array([0, 40, 80]) * 1_000_000, np.array([10, 41, 80]) * 1_000_000
    line = timeline(stamps, times, 0.01)
    assert np.diff(line).max() <= 10_000_000
    assert (np.diff(line) > 0).all()
    assert set(stamps) | set(times) <= set(line)
    np.testing.assert_array_equal(line[:5], np.array([0, 10, 20, 30, 40]) * 1_000_000)


def test_the_towel_errs_less_between_frames_than_a_spline():
    config = load(ROOT / 'config/towel_between.yaml')
    case = case_of(read(ROOT / 'bags/towel_fan'), config, 'towel')
    frames = np.arange(160)
    given, truth = (frames_of(m, frames) for m in (case.markers, case.reference.markers))
    found = errors_between(given, truth, config, 4)
    assert found['model'] < 0.7 * min(found['cubic'], found['linear'])
