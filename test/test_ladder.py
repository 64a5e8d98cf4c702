"""The evaluation of several methods, horizons and recordings, where the answer is known."""

from __future__ import annotations

from dataclasses import replace
from math import erf, sqrt
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from cloth_predict.config import Config, build
from cloth_predict.evaluation.baselines import best_noise
from cloth_predict.evaluation.bootstrap import ratio_interval, rms_interval
from cloth_predict.evaluation.cases import labelled_case
from cloth_predict.evaluation.compare import Evaluation, compare, evaluate, pooled
from cloth_predict.evaluation.degrade import Degradation, degraded
from cloth_predict.evaluation.judging import Judged
from cloth_predict.evaluation.predictors import BASELINES, Kinematic, methods
from cloth_predict.metrics import normalised, ratio
from cloth_predict.types import FloatArray, IntArray, MarkerSequence

DT = 0.01
STEP = 10_000_000  # ns
MARKERS = 6
ROUNDING = 1e-8  # mm; positions of 3 m have 4e-16 m left, which gains multiply


def config(**values: Any) -> Config:
    model = {'rows': 2, 'cols': 3, 'gravity': [0, 0, 0], 'rest_length': 'measured'}
    certain = {'sigma_warn': 100, 'sigma_error': 100}
    return build({'model': model, 'limits': certain, **values}, 'test')


def sequence(positions: FloatArray, stamps: IntArray | None = None) -> MarkerSequence:
    stamps = np.arange(len(positions)) * STEP if stamps is None else stamps
    return MarkerSequence(stamps, tuple('abcdef'), positions, np.ones(positions.shape[:2], bool))


def moving(seconds: FloatArray, speed: float = 1.3) -> FloatArray:
    """Move six markers alike, at a constant speed [m/s], positions [m], (frames, 6, 3)."""
    shape = np.array([[x, y, 0.0] for y in (0.0, -0.1) for x in (0.0, 0.1, 0.2)])
    return shape + speed * np.array([0.6, 0.0, -0.8]) * seconds[:, None, None]


# --- closed forms ----------------------------------------------------------------------------


@pytest.mark.parametrize('horizon', [0.02, 0.1, 0.23])
def test_hold_on_a_sinusoid(horizon: float) -> None:
    # A sin(w (t + h)) - A sin(w t) = 2 A sin(w h / 2) cos(w (t + h / 2)); over whole periods the
    # mean square of the cosine is a half
    ahead, amplitude, rate = round(horizon / DT), 0.05, 2 * np.pi / 0.5
    seconds = np.arange(300 + ahead) * DT  # judged are 200 frames, four periods
    positions = moving(0.0 * seconds)
    positions[..., 2] += amplitude * np.sin(rate * seconds)[:, None]
    found = evaluate(sequence(positions), config(), horizon, makers=BASELINES)
    assert len(found.targets) == 200
    size = 2e3 * amplitude * abs(np.sin(rate * horizon / 2))
    assert found.scores['hold'].rmse_mm == pytest.approx(size / sqrt(2), rel=1e-9)  # of sums
    assert found.scores['hold'].max_mm < size + ROUNDING


def test_all_horizons_come_from_one_pass() -> None:
    rng = np.random.default_rng(1)
    markers = sequence(moving(np.arange(130) * DT) + 1e-4 * rng.standard_normal((130, 6, 3)))
    case, horizons, made = labelled_case(markers, config(), 'here'), [0.05, 0.1], []

    def counted(settings: Config) -> Kinematic:
        made.append(Kinematic(settings, 'constant_velocity', 1.0))
        return made[-1]

    together = compare(case, config(), horizons, {**methods(['ekf']), 'kf_cv': counted})
    alone = [compare(case, config(), [h], methods(['ekf']))[0] for h in horizons]
    assert len(made) == 1
    assert [found.horizon for found in together] == horizons
    assert [found.scores['ekf'] for found in together] == [f.scores['ekf'] for f in alone]
    assert [found.details['ekf'] for found in together] == [f.details['ekf'] for f in alone]


def test_long_dropouts_of_a_uniform_motion() -> None:
    # hidden j frames ago, a marker that is held is speed (h + j dt) off; the filters lose nothing
    markers = sequence(moving(np.arange(251) * DT))
    case = degraded(labelled_case(markers, config(), 'x'), Degradation(gone=2, gone_for=0.2))
    found = compare(case, config(), [0.1], methods(['ekf']))[0]
    errors = np.full((141, 6), 130.0)
    age = np.zeros(6)
    for k in range(241):
        age = np.where(case.markers.visible[k], 0, age + 1)
        if k >= 100:
            errors[k - 100] = 1300 * (0.1 + age * DT)
    assert errors.max() == pytest.approx(1300 * 0.3)
    np.testing.assert_allclose(1e3 * found.errors['hold'], errors, atol=ROUNDING)
    for name in ('kf_cv', 'kf_ca', 'ekf'):
        assert found.scores[name].max_mm < ROUNDING
        assert found.judged.share(name) == 1.0  # of hidden markers, too


def test_swaps_mislead_what_believes_labels() -> None:
    markers = sequence(moving(0.0 * np.arange(400)))
    case = degraded(labelled_case(markers, config(), 'x'), Degradation(swap=0.1))
    found = compare(case, config(), [0.1], methods(['ekf']))[0]
    offsets = np.linalg.norm(case.markers.positions - markers.positions, axis=2)
    assert 20 < (offsets[100:390] > 0).any(axis=1).sum() < 40
    np.testing.assert_allclose(found.errors['hold'], offsets[100:390], atol=1e-3 * ROUNDING)
    assert found.scores['ekf'].max_mm < 1.0  # it puts them right


@pytest.mark.parametrize('shuffle', [True, False])
def test_frames_out_of_order(shuffle: bool) -> None:
    late = np.random.default_rng(5).integers(-3_000_000, 3_000_000, 301)
    stamps = np.arange(301) * STEP + late
    order = np.arange(301)
    if shuffle:  # every tenth frame comes after the one that follows it
        for k in range(20, 299, 10):
            order[[k, k + 1]] = k + 1, k
    stamps = stamps[order]
    markers = sequence(moving(stamps / 1e9), stamps)
    settings = config(horizon=0.1)
    found = compare(labelled_case(markers, settings, 'x'), settings, [0.1], methods(['ekf']))[0]
    assert found.scores['hold'].rmse_mm == pytest.approx(130.0, abs=ROUNDING)
    for name in ('kf_cv', 'kf_ca', 'ekf'):
        assert found.scores[name].max_mm < ROUNDING
    counts = found.judged.answers['ekf'].counts
    assert counts['rewound'] == (28 if shuffle else 0)
    assert counts['updated'] == 300 - counts['rewound']
    assert (np.diff(found.targets) > 0).all()
    known = np.isin(found.targets - 100_000_000, stamps[order.argsort()][20:299:10])
    assert known.any() != shuffle  # what comes late is not predicted from


def test_frames_later_than_any_method_can_place() -> None:
    stamps = np.arange(300) * STEP
    stamps[250] = 0  # 2.5 s late, more than filter.max_backstep
    positions = moving(stamps / 1e9)
    positions[250] += 5.0
    found = evaluate(sequence(positions, stamps), config(), 0.1, makers=BASELINES)
    assert found.scores['hold'].max_mm == pytest.approx(130.0, abs=ROUNDING)


def walking(density: float, noise: float, frames: int) -> tuple[FloatArray, FloatArray]:
    """Do what a constant-velocity filter believes: the truth [m], and the measurement of it."""
    rng = np.random.default_rng(6)
    root = np.linalg.cholesky(density * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]))
    kicks = rng.standard_normal((frames, 3 * MARKERS, 2)) @ root.T
    speed = np.cumsum(kicks[..., 1], axis=0)
    before = np.vstack([np.zeros((1, 3 * MARKERS)), speed[:-1]])
    truth = np.cumsum(kicks[..., 0] + DT * before, axis=0).reshape(frames, MARKERS, 3)
    return truth, truth + noise * rng.standard_normal(truth.shape)


@pytest.mark.parametrize('factor', [0.25, 1.0, 4.0])
def test_a_wrong_measurement_noise_shows(factor: float) -> None:
    # A filter in its steady state believes M before and P after a measurement, and R of it. With
    # its gain K the errors really have the covariance E = (I - K H)(F E F' + Q)(I - K H)' + KRK'.
    density, noise, horizon, frames = 0.3, 1e-3, 0.05, 4000
    F, H = np.array([[1, DT], [0, 1]]), np.array([[1.0, 0.0]])

    def Q(dt: float) -> FloatArray:  # noqa: N802
        return density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])

    R = noise**2
    M = solve_discrete_are(F.T, H.T, Q(DT), [[factor**2 * R]])
    S = M[0, 0] + factor**2 * R
    K = M @ H.T / S
    keep = np.eye(2) - K @ H
    P = keep @ M
    E = solve_discrete_lyapunov(keep @ F, keep @ Q(DT) @ keep.T + R * K @ K.T)
    nis = ((F @ E @ F.T + Q(DT))[0, 0] + R) / S
    nees = E[0, 0] / P[0, 0]
    step = np.array([[1, horizon], [0, 1]])
    spread = [(step @ C @ step.T + Q(horizon))[0, 0] for C in (E, P)]
    within = [erf(k / sqrt(2 * spread[0] / spread[1])) for k in (1, 2, 3)]

    truth, seen = walking(density, noise, frames)
    settings = config(filter={'measurement_noise': factor * noise}, baseline={'cv_noise': density})
    found = evaluate(
        sequence(seen), settings, horizon, sequence(truth), {'kf_cv': BASELINES['kf_cv']}
    ).details['kf_cv']
    # 18 coordinates, of which what lies 10 frames apart is about independent: 7000 squares, whose
    # mean has a deviation of 1.7 %, and shares of at most 0.5 %; four of them
    assert found.nis == pytest.approx(nis, rel=0.07)
    assert found.nees == pytest.approx(nees, rel=0.07)
    assert found.coverage == pytest.approx(within, abs=0.02)
    right = factor == 1.0
    assert (abs(nis - 1) < 1e-9, abs(nees - 1) < 1e-9) == (right, right)
    assert (nis > 1.5 or nis < 0.5) != right


def test_nees_of_correlated_errors() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3)) * 1e-3
    errors = rng.standard_normal((40_000, 3)) @ root.T
    covariances = np.tile(root @ root.T, (40_000, 1, 1))
    found = normalised(errors, covariances)
    assert found.mean() == pytest.approx(1.0, abs=4 * sqrt(2 / 120_000))  # of chi-square
    e, P = errors[0], covariances[0]
    assert found[0] == pytest.approx(e @ np.linalg.inv(P) @ e / 3, rel=1e-9)
    errors[0], covariances[1], covariances[2] = np.nan, np.nan, 0.0
    assert np.isnan(normalised(errors[:4], covariances[:4])).tolist() == [True, True, True, False]


# --- ratios and several recordings -----------------------------------------------------------


def test_ratio_of_proportional_errors_is_sure() -> None:
    rng = np.random.default_rng(1)
    errors = rng.exponential(size=(200, 4))
    errors[rng.random(errors.shape) > 0.7] = np.nan
    found = ratio([(0.6 * errors, 10)], [(errors, 10)], rng)
    assert found.ratio == pytest.approx(0.6)
    assert found.ratio_95 == pytest.approx((0.6, 0.6))
    twice = ratio([(errors, 10)], [(0.6 * errors[:, ::-1], 10)], rng)  # only what is in both
    both = np.isfinite(errors) & np.isfinite(errors[:, ::-1])
    squares = [np.mean(values[both] ** 2) for values in (errors, 0.6 * errors[:, ::-1])]
    assert twice.ratio == pytest.approx(sqrt(squares[0] / squares[1]))
    still = ratio([(errors, 10)], [(0 * errors, 10)], rng)
    assert np.isnan([still.ratio, *still.ratio_95]).all()


def test_intervals_with_loops_over_two_recordings() -> None:
    rng = np.random.default_rng(2)
    mine = [(rng.exponential(size=(n, 3)), block) for n, block in ((60, 7), (100, 20))]
    its = [(rng.exponential(size=errors.shape), block) for errors, block in mine]
    drawn, by_rate = [], np.random.default_rng(7)
    starts = [by_rate.integers(len(e), size=(1000, -(-len(e) // b))) for e, b in mine]
    for k in range(1000):
        rows = [
            [(s + i) % len(e) for s in places[k] for i in range(b)][: len(e)]
            for (e, b), places in zip(mine, starts, strict=True)
        ]
        a, b = (
            np.concatenate([e[row].ravel() for (e, _), row in zip(of, rows, strict=True)])
            for of in (mine, its)
        )
        drawn.append((np.sqrt(np.mean(a**2)), np.sqrt(np.mean(a**2) / np.mean(b**2))))
    expected = np.percentile(drawn, [2.5, 97.5], axis=0)
    found = rms_interval(mine, np.random.default_rng(7))
    np.testing.assert_allclose(found, expected[:, 0], rtol=1e-12)  # sums
    found = ratio_interval(mine, its, np.random.default_rng(7))
    np.testing.assert_allclose(found, expected[:, 1], rtol=1e-12)
    short = [*mine, (np.ones((10, 3)), 5)]
    assert np.isnan(rms_interval(short, rng)).all()  # one of them is too short to be drawn from


def wavy(seconds: float, rate: float, settings: Config, name: str) -> Evaluation:
    time = np.arange(round(seconds / DT)) * DT
    positions = moving(0.0 * time)
    positions[..., 1] += 0.02 * np.sin(rate * time)[:, None]
    case = labelled_case(sequence(positions), settings, name)
    return compare(case, settings, [0.1], BASELINES)[0]


def test_pooled_is_all_errors_together() -> None:
    settings = config(anchors={'nodes': [0]})
    parts = [wavy(5.0, 9.0, settings, 'slow'), wavy(7.0, 20.0, settings, 'fast')]
    found = pooled(parts, settings)
    assert found.bag == 'all'
    assert len(found.targets) == sum(len(part.targets) for part in parts) == 390 + 590
    assert found.judged.lengths == (390, 590)
    for name in BASELINES:
        squares = [part.scores[name].rmse_mm ** 2 * len(part.targets) for part in parts]
        expected = sqrt(sum(squares) / len(found.targets))
        assert found.scores[name].rmse_mm == pytest.approx(expected)
        errors = [(1e3 * part.errors[name], 50) for part in parts]
        assert found.scores[name].rmse_95_mm == rms_interval(errors, np.random.default_rng(0))
        assert found.us_per_frame[name] > 0
    assert found.ratios[found.best or ''].ratio_95 == (1.0, 1.0)
    once = Judged.joined([parts[0].judged])
    np.testing.assert_array_equal(once.actual, parts[0].judged.actual)


# --- the baselines at their best -------------------------------------------------------------


def test_best_noise_is_that_of_the_motion() -> None:
    # of white noise on the acceleration the filter that knows its density is the best there is
    density, noise, horizons = 0.3, 1e-3, [0.05, 0.1]
    truth, seen = walking(density, noise, 600)
    far = config(filter={'measurement_noise': noise}, baseline={'cv_noise': 3e5, 'ca_noise': 1.0})
    case = labelled_case(sequence(seen), far, 'x', sequence(truth))
    found = compare(case, far, horizons, BASELINES, search=True)
    for evaluation in found:
        # in 5 s the flat bottom may be a little lower half a decade away
        assert density / 3.2 <= evaluation.noise['kf_cv'] <= density * 3.2
        told = evaluation.summary()['methods']
        assert told['kf_cv']['noise'] == evaluation.noise['kf_cv']
        assert 'noise' not in told['hold']
    best = found[0].scores['kf_cv'].rmse_free_mm
    assert best == _rmse(case, far, found[0].noise['kf_cv'], 0.05)
    for factor in (0.03, 0.5, 0.75, 1.0, 1.3, 2.0, 30.0):
        # a 16th of a decade away from the best the error is less than 0.1 % larger
        assert best <= 1.001 * _rmse(case, far, factor * density, 0.05)
    chosen = best_noise(case, far, [0.05])['kf_cv'][0]
    assert chosen.noise == found[0].noise['kf_cv']  # whatever the other horizons


def _rmse(case: Any, settings: Config, density: float, horizon: float) -> float:
    chosen = replace(settings, baseline=replace(settings.baseline, cv_noise=density))
    found = compare(case, chosen, [horizon], {'kf_cv': BASELINES['kf_cv']})[0]
    return found.scores['kf_cv'].rmse_free_mm
