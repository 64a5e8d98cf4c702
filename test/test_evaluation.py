"""The comparison of predictors, on motions whose errors are known in closed form."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from cloth_predict.config import Config, build
from cloth_predict.errors import FormatError
from cloth_predict.evaluation.bootstrap import rms_interval
from cloth_predict.evaluation.cases import Reference, ahead, in_order
from cloth_predict.evaluation.compare import Evaluation, evaluate, summed
from cloth_predict.evaluation.judging import judge
from cloth_predict.evaluation.predictors import METHODS, Estimated, Hold, Predicted
from cloth_predict.evaluation.runs import Run
from cloth_predict.filters.linear import condition
from cloth_predict.metrics import (
    Score,
    SpeedBin,
    at_times,
    by_speed,
    coverage,
    distances,
    mean,
    rms,
    score,
    speeds,
)
from cloth_predict.tracker import Tracker
from cloth_predict.types import BoolArray, FloatArray, Gaussian, IntArray, MarkerSequence

STEP = 10_000_000  # ns
GRID = np.arange(201) * STEP  # 2 s at 100 Hz
VELOCITY = np.array([0.3, -0.4, 1.2])  # m/s; its length is 1.3
ACCELERATION = np.array([2.0, 1.0, -2.0])  # m/s^2; its length is 3
SHAPE = np.array([[x, y, 0.0] for y in (0.0, -0.1) for x in (0.0, 0.1, 0.2)])  # m, 2 x 3 nodes
KINEMATIC = {name: METHODS[name] for name in ('hold', 'kf_cv', 'kf_ca')}

# A position of about 3 m has 4e-16 m left in its last digit, and a filter's gains multiply it.
ROUNDING = 1e-8  # mm


def config(**values: Any) -> Config:
    """Six free nodes in no gravity, whose springs are at rest in the first frame."""
    model = {'rows': 2, 'cols': 3, 'gravity': [0, 0, 0], 'rest_length': 'measured'}
    certain = {'sigma_warn': 100, 'sigma_error': 100}  # m; half a second ahead nothing is certain
    return build({'model': model, 'limits': certain, **values}, 'test')


def moving(
    stamps: IntArray = GRID,
    velocity: FloatArray = VELOCITY,
    acceleration: FloatArray | float = 0.0,
    visible: BoolArray | None = None,
) -> MarkerSequence:
    """Move the shape; velocity and acceleration, shape (3,), or one for each node."""
    seconds = (stamps / 1e9)[:, None, None]
    positions = SHAPE + velocity * seconds + np.multiply(acceleration, seconds**2 / 2)
    shown = np.ones(positions.shape[:2], bool) if visible is None else visible
    positions = np.where(shown[..., None], positions, np.nan)
    return MarkerSequence(stamps, tuple('abcdef'), positions, shown)


def said(positions: FloatArray, sigma: float = np.nan, seconds: float = 1.0) -> Run:
    """Make a method's answers of these positions [m], all with the same sigma [m]."""
    shape = positions.shape[:2]
    unknown = np.full(shape, np.nan)
    return Run(positions, np.full(shape, sigma), unknown[:, 0], unknown, seconds)


def judged(
    markers: MarkerSequence, settings: Config, truth: MarkerSequence | None, runs: dict[str, Run]
) -> Evaluation:
    """Judge answers 0.1 s ahead."""
    noise = 0.0 if truth else settings.filter.measurement_noise
    found = judge(markers.stamps, 0.1, Reference(truth or markers, noise), runs)
    return summed(0.1, found, settings)


def all_equal(found: Score, millimetres: float, tolerance: float = ROUNDING) -> None:
    for value in (found.rmse_mm, found.rmse_free_mm, found.p95_mm, found.max_mm):
        assert value == pytest.approx(millimetres, abs=tolerance)


# --- motions with a known answer -------------------------------------------------------------


@pytest.mark.parametrize('horizon', [0.01, 0.1, 0.5])
def test_uniform_motion(horizon: float) -> None:
    found = evaluate(moving(), config(), horizon)
    assert list(found.scores) == ['hold', 'kf_cv', 'kf_ca', 'ekf']
    all_equal(found.scores['hold'], 1300 * horizon)
    for name in ('kf_cv', 'kf_ca', 'ekf'):
        all_equal(found.scores[name], 0.0)
    offset = found.judged.answers['kf_cv'].predicted - found.judged.actual
    np.testing.assert_allclose(offset, 0.0, atol=1e-3 * ROUNDING)


@pytest.mark.parametrize('horizon', [0.02, 0.1, 0.3])
@pytest.mark.parametrize('density', [0.1, 30.0])
def test_constant_acceleration(horizon: float, density: float) -> None:
    settings = config(baseline={'cv_noise': density})
    found = evaluate(moving(acceleration=ACCELERATION), settings, horizon, makers=KINEMATIC)
    # In its steady state a filter of gain K makes the error e = (I - K H)(F e + w), where w is
    # what constant velocity leaves out in one step; h ahead that is e_p + h e_v + a h^2 / 2.
    dt, sigma = 0.01, settings.filter.measurement_noise
    step, seen = np.array([[1, dt], [0, 1]]), np.array([[1.0, 0.0]])
    noise = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    cov = solve_discrete_are(step.T, seen.T, noise, np.array([[sigma**2]]))
    keep = np.eye(2) - cov @ seen.T @ seen / (cov[0, 0] + sigma**2)
    lag = np.linalg.solve(np.eye(2) - keep @ step, keep @ [dt**2 / 2, dt])
    expected = 3000 * (lag[0] + horizon * lag[1] + horizon**2 / 2)
    all_equal(found.scores['kf_cv'], expected)  # 1 s is 70 times the memory of the filter
    all_equal(found.scores['kf_ca'], 0.0)
    time = (found.targets / 1e9 - horizon)[:, None]
    moved = (VELOCITY + ACCELERATION * time) * horizon + ACCELERATION * horizon**2 / 2
    np.testing.assert_allclose(
        found.errors['hold'],
        np.linalg.norm(moved, axis=1)[:, None].repeat(6, axis=1),
        atol=1e-3 * ROUNDING,
    )


def test_dropouts() -> None:
    horizon = 10
    rng = np.random.default_rng(4)
    visible = rng.random((len(GRID), 6)) > 0.3
    visible[0] = True
    found = evaluate(moving(visible=visible), config(), horizon * STEP / 1e9)
    errors = np.full(visible.shape, np.nan)
    for k in range(100, len(GRID) - horizon):
        for marker in range(6):
            if visible[k + horizon, marker]:
                last = np.flatnonzero(visible[: k + 1, marker])[-1]
                errors[k, marker] = 1.3 * (k + horizon - last) * 0.01
    judged = np.isfinite(errors).any(axis=1)
    assert found.targets.tolist() == (GRID[judged] + horizon * STEP).tolist()
    np.testing.assert_allclose(found.errors['hold'], errors[judged], atol=1e-3 * ROUNDING)
    counted = 1e3 * errors[np.isfinite(errors)]
    assert found.scores['hold'].rmse_mm == pytest.approx(
        np.sqrt(np.mean(counted**2)), abs=ROUNDING
    )
    assert found.scores['hold'].max_mm == pytest.approx(counted.max(), abs=ROUNDING)
    for name in ('kf_cv', 'kf_ca', 'ekf'):
        assert found.scores[name].max_mm < ROUNDING


def test_stamps_with_jitter() -> None:
    late = np.random.default_rng(5).integers(-3_000_000, 3_000_000, len(GRID))
    late[[0, -1]] = 0
    found = evaluate(moving(GRID + late), config(), 0.1)
    all_equal(found.scores['hold'], 130.0)  # what is interpolated is straight
    for name in ('kf_cv', 'kf_ca', 'ekf'):
        all_equal(found.scores[name], 0.0)
    assert len(found.targets) > 80


@pytest.mark.parametrize('horizon', [0.0001, 0.0153, 0.1049])
def test_a_horizon_between_two_frames(horizon: float) -> None:
    found = evaluate(moving(), config(), horizon, makers=KINEMATIC)
    all_equal(found.scores['hold'], 1300 * horizon)
    all_equal(found.scores['kf_cv'], 0.0)
    assert (found.targets - round(horizon * 1e9)).tolist() == GRID[
        100 : len(found.targets) + 100
    ].tolist()
    assert found.targets[-1] <= GRID[-1] < found.targets[-1] + STEP


def test_late_frames_are_left_out() -> None:
    clean = moving()
    places = np.sort(np.random.default_rng(6).choice(np.arange(1, 200), 40, replace=False))
    stamps = np.insert(GRID, places, GRID[places - 1] - np.arange(40) % 3 * STEP)
    positions = np.insert(clean.positions, places, 99.0, axis=0)
    late = MarkerSequence(stamps, clean.labels, positions, np.ones(positions.shape[:2], bool))
    found, expected = (evaluate(m, config(), 0.1) for m in (late, clean))
    assert found.scores == expected.scores
    assert found.targets.tolist() == expected.targets.tolist()
    assert found.us_per_frame.keys() == expected.us_per_frame.keys()


@pytest.mark.parametrize(
    ('stamps', 'kept', 'first'),
    [
        ([0, 10, 20], [0, 1, 2], [0, 1, 2]),
        ([0, 10, 10, 20], [0, 1, 3], [0, 1, 3]),
        ([0, 10, 5, 7, 10, 11], [0, 2, 3, 1, 5], [0, 1, 5]),
        ([30, 10, 20, 31], [1, 2, 0, 3], [0, 3]),
        ([5, 5, 5], [0], [0]),
        ([7], [0], [0]),
        ([-5, -7, 0], [1, 0, 2], [0, 2]),
    ],
)
def test_in_order(stamps: list[int], kept: list[int], first: list[int]) -> None:
    positions = np.arange(3.0 * len(stamps)).reshape(-1, 1, 3)
    visible = np.arange(len(stamps))[:, None] % 2 == 0
    markers = MarkerSequence(np.array(stamps), ('a',), positions, visible, 'world')
    found = in_order(markers)
    assert found.stamps.tolist() == [stamps[k] for k in kept]
    assert found.positions.tolist() == positions[kept].tolist()
    assert found.visible.tolist() == visible[kept].tolist()
    assert (found.labels, found.frame_id) == (('a',), 'world')
    assert np.flatnonzero(ahead(markers.stamps)).tolist() == first


# --- what is counted -------------------------------------------------------------------------


def test_driven_nodes_are_not_among_the_free() -> None:
    velocity = np.zeros((6, 3))
    velocity[:, 0] = [5, 1, 1, 1, 1, 3]
    anchors = {'nodes': [5, 0]}
    found = evaluate(moving(velocity=velocity), config(anchors=anchors), 0.1, makers=KINEMATIC)
    hold = found.scores['hold']
    assert hold.rmse_free_mm == pytest.approx(100.0, abs=ROUNDING)
    assert hold.rmse_mm == pytest.approx(100 * np.sqrt((25 + 9 + 4) / 6), abs=ROUNDING)
    assert hold.max_mm == pytest.approx(500.0, abs=ROUNDING)


class Sometimes:
    """Knows marker 2 not at every fourth frame; is always 1 m off in z."""

    associates = False
    counts: dict[str, int] = {}  # noqa: RUF012
    reason = ''
    UNKNOWN: int | slice = 2

    def __init__(self, config: Config) -> None:
        self._odd = False

    def step(
        self, stamp: int, positions: FloatArray, visible: BoolArray, points: FloatArray
    ) -> float:
        self._odd, self._now = stamp // STEP % 4 == 1, positions
        return np.nan

    def predict(self, horizon: float) -> Predicted:
        guess = self._now + np.array([0.0, 0.0, 1.0])
        if self._odd:
            guess[self.UNKNOWN] = np.nan
        return Predicted(guess, np.full(6, np.nan))

    def estimate(self) -> Estimated:
        return Estimated.unknown(6)


class Seldom(Sometimes):
    """Knows nothing at every fourth frame."""

    UNKNOWN = slice(None)


def test_every_method_is_judged_by_the_same_frames_and_markers() -> None:
    still = moving(velocity=np.zeros(3))
    methods = {'sometimes': Sometimes, **KINEMATIC}
    found = evaluate(still, config(), 0.1, makers=methods)
    assert found.targets.tolist() == (GRID[100:191] + 10 * STEP).tolist()
    for errors in found.errors.values():
        assert np.isnan(errors[1::4, 2]).all()
        assert np.isnan(errors).sum() == 23  # and nothing else
    all_equal(found.scores['sometimes'], 1000.0)
    all_equal(found.scores['hold'], 0.0)
    assert found.judged.share('sometimes') == 1 - 23 / (91 * 6)
    assert found.summary()['methods']['sometimes']['predicted'] == 1 - 23 / (91 * 6)


def test_a_method_that_predicts_little_takes_nothing_from_the_others() -> None:
    still = moving(velocity=np.zeros(3))
    found = evaluate(still, config(), 0.1, makers={'seldom': Seldom, **KINEMATIC})
    alone = evaluate(still, config(), 0.1, makers=KINEMATIC)
    for name in KINEMATIC:
        assert found.scores[name] == alone.scores[name]
        assert found.judged.share(name) == 1.0
        assert found.judged.answers[name].complete
    seldom = found.judged.answers['seldom']
    assert (seldom.known, seldom.complete) == (68 * 6, False)
    assert np.flatnonzero(np.isnan(seldom.errors).all(axis=1)).tolist() == list(range(1, 91, 4))
    all_equal(found.scores['seldom'], 1000.0)


def test_a_method_that_never_predicts_has_no_numbers() -> None:
    nothing = said(np.full((201, 6, 3), np.nan))
    held = said(moving(velocity=np.zeros(3)).positions)
    found = judged(moving(velocity=np.zeros(3)), config(), None, {'hold': held, 'none': nothing})
    numbers = json.loads(json.dumps(found.summary()))['methods']['none']
    assert (numbers['predicted'], numbers['rmse_mm'], numbers['coverage']) == (0, None, None)
    assert numbers['ratio_95'] == [None, None]
    all_equal(found.scores['hold'], 0.0)


def test_the_first_second_is_not_judged() -> None:
    positions = moving().positions.copy()
    positions[:100] += 5.0  # would be an error of metres
    jump = MarkerSequence(GRID, tuple('abcdef'), positions, np.ones((201, 6), bool))
    found = evaluate(jump, config(), 0.1, makers={'hold': Hold})
    assert found.targets.tolist() == (GRID[100:191] + 10 * STEP).tolist()
    assert found.targets[0] == 1_100_000_000
    all_equal(found.scores['hold'], 130.0)


def test_the_first_second_begins_with_the_recording() -> None:
    found = evaluate(
        moving(GRID + 1_700_000_000_000_000_000), config(), 0.1, makers={'hold': Hold}
    )
    assert len(found.targets) == 91
    assert found.targets[0] == 1_700_000_001_100_000_000


def test_truth_is_the_reference() -> None:
    fine = np.arange(401) * STEP // 2
    truth = moving(fine)
    rng = np.random.default_rng(8)
    visible = rng.random((201, 6)) > 0.5
    visible[0] = True
    shifted = moving(visible=visible).positions + np.array([0.0, 0.0, 0.001])
    measured = MarkerSequence(GRID, truth.labels, shifted, visible)
    found = evaluate(measured, config(), 0.005, truth, makers=KINEMATIC)
    assert len(found.targets) == 100  # half a frame ahead of each after 1 s, the last is too late
    assert np.isfinite(found.errors['hold']).all()  # of markers that are hidden, too
    np.testing.assert_array_equal(found.judged.actual, truth.positions[201:400:2])
    np.testing.assert_allclose(found.errors['kf_cv'], 0.001, atol=1e-3 * ROUNDING)


def test_late_markers_are_compared_from_when_they_are_seen() -> None:
    visible = np.ones((201, 6), bool)
    visible[:150, 3] = False
    found = evaluate(moving(visible=visible), config(), 0.1, makers=KINEMATIC)
    seen = np.isfinite(found.errors['hold'])
    assert seen[:, [0, 1, 2, 4, 5]].all()
    assert np.flatnonzero(seen[:, 3]).tolist() == list(range(50, 91))


@pytest.mark.parametrize(
    ('frames', 'horizon', 'text'),
    [
        (1, 0.1, '0.00'),
        (50, 0.1, '0.49'),
        (105, 0.1, '1.04'),
        (201, 1.5, '2.00'),
        (201, 9, '2.00'),
    ],
)
def test_a_recording_that_is_too_short(frames: int, horizon: float, text: str) -> None:
    with pytest.raises(FormatError) as caught:
        evaluate(moving(GRID[:frames]), config(), horizon, makers={'hold': Hold}, source='here')
    assert str(caught.value) == (
        f'here: no frame can be judged: the recording lasts {text} s, of which the first 1.0 s '
        f'are the warm-up and the last {horizon} s have no later measurement'
    )


def test_the_shortest_recording_that_can_be_judged() -> None:
    found = evaluate(moving(GRID[:111]), config(), 0.1, makers={'hold': Hold})
    assert found.targets.tolist() == [1_100_000_000]


def test_nothing_visible_after_the_first_second() -> None:
    visible = np.arange(201)[:, None].repeat(6, axis=1) < 100
    with pytest.raises(FormatError, match='no frame can be judged'):
        evaluate(moving(visible=visible), config(), 0.1, makers={'hold': Hold})


def test_judge_takes_predictions_of_any_origin() -> None:
    markers = moving(velocity=np.zeros(3))
    offset = np.zeros((201, 6, 3))
    offset[:, 1, 0], offset[150, 4] = 0.002, [0.02, 0.03, 0.06]
    offset[:, 5] = np.nan
    run = said(markers.positions + offset, seconds=0.0201)
    found = judged(markers, config(), None, {'it': run})
    errors = np.zeros((91, 5))
    errors[:, 1], errors[50, 4] = 0.002, 0.07
    np.testing.assert_allclose(found.errors['it'][:, :5], errors, atol=1e-3 * ROUNDING)
    assert np.isnan(found.errors['it'][:, 5]).all()
    assert found.us_per_frame == {'it': pytest.approx(100.0)}
    assert found.scores['it'].max_mm == pytest.approx(70.0, abs=ROUNDING)
    expected = np.sqrt((91 * 4 + 4900) / (91 * 5))  # mm
    assert found.scores['it'].rmse_mm == pytest.approx(expected, abs=ROUNDING)


# --- the result ------------------------------------------------------------------------------


def test_the_summary_is_what_is_printed() -> None:
    found = evaluate(moving(), config(), 0.1)
    summary: Any = json.loads(json.dumps(found.summary()))
    assert list(summary) == ['horizon_s', 'frames', 'methods', 'best_kinematic']
    assert (summary['horizon_s'], summary['frames']) == (0.1, 91)
    assert list(summary['methods']) == list(METHODS)
    for name, numbers in summary['methods'].items():
        first = ['rmse_mm', 'rmse_free_mm', 'p95_mm', 'max_mm']
        others = ['rmse_95_mm', 'us_per_frame', 'coverage', 'nis', 'nees', 'by_speed']
        others += ['ratio', 'ratio_95', 'predicted', 'counts']
        assert list(numbers) == first + others
        assert numbers['us_per_frame'] == found.us_per_frame[name] > 0
        assert [numbers[key] for key in first] == list(vars(found.scores[name]).values())[:4]
        assert numbers['rmse_95_mm'] == [None, None]  # less than a second is judged
        assert (numbers['coverage'] is None) == (name == 'hold')
        assert (numbers['nis'] is None) == (name == 'hold')
        assert numbers['nees'] is None  # there is no truth
        assert [list(part) for part in numbers['by_speed']] == [['up_to_m_s', 'rmse_mm']] * 3


def test_progress_counts_the_frames_of_every_method() -> None:
    done: list[int] = []
    evaluate(moving(GRID[:120]), config(), 0.1, makers=KINEMATIC, progress=done.append)
    assert sum(done) == 3 * 120


def test_two_runs_give_the_same_numbers() -> None:
    visible = np.random.default_rng(2).random((201, 6)) > 0.1
    visible[0] = True
    one, two = (
        evaluate(moving(visible=visible, acceleration=ACCELERATION), config(), 0.1)
        for _ in range(2)
    )
    for name in METHODS:
        said_, again = (e.judged.answers[name].predicted for e in (one, two))
        np.testing.assert_array_equal(said_, again)
    same: list[Any] = [found.summary()['methods'] for found in (one, two)]
    for name in METHODS:
        without_time = [{**numbers[name], 'us_per_frame': 0} for numbers in same]
        assert without_time[0] == without_time[1]


def test_shapes_belong_together() -> None:
    found: Evaluation = evaluate(moving(), config(), 0.1, makers=KINEMATIC)
    actual = found.judged.actual
    assert actual.shape == (91, 6, 3)
    for name in KINEMATIC:
        predicted = found.judged.answers[name].predicted
        assert predicted.shape == (91, 6, 3)
        assert found.errors[name].shape == (91, 6)
        np.testing.assert_allclose(found.errors[name], distances(predicted, actual))


# --- numbers ---------------------------------------------------------------------------------


def test_score_by_hand() -> None:
    errors = np.array([[0.001, 0.002], [0.003, np.nan], [0.005, 0.007]])
    errors[2, 0] = np.nan
    found = score([(errors, 1)], np.array([True, False]), np.random.default_rng(0))
    # counted are 1, 2, 3, 7 mm; the 95th percentile lies at 2.85 of their 3 intervals
    assert found.rmse_mm == pytest.approx(np.sqrt((1 + 4 + 9 + 49) / 4))
    assert found.rmse_free_mm == pytest.approx(np.sqrt((1 + 9) / 2))
    assert found.p95_mm == pytest.approx(3 + 0.85 * 4)
    assert found.max_mm == pytest.approx(7.0)


@pytest.mark.parametrize('seed', range(3))
def test_score_with_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors, counted = rng.exponential(0.01, (30, 7)), rng.random((30, 7)) > 0.4
    free = rng.random(7) > 0.3
    chosen = [(1e3 * errors[k, i], free[i]) for k in range(30) for i in range(7) if counted[k, i]]
    every, of_free = sorted(e for e, _ in chosen), [e for e, is_free in chosen if is_free]
    place = 0.95 * (len(every) - 1)
    low = int(place)
    errors = np.where(counted, errors, np.nan)
    parts = [(errors[:20], 2), (errors[20:], 2)]
    found = score(parts, free, np.random.default_rng(seed))
    assert found.rmse_mm == pytest.approx((sum(e**2 for e in every) / len(every)) ** 0.5)
    assert found.rmse_free_mm == pytest.approx((sum(e**2 for e in of_free) / len(of_free)) ** 0.5)
    assert found.p95_mm == pytest.approx(
        every[low] + (place - low) * (every[low + 1] - every[low])
    )
    assert found.max_mm == pytest.approx(every[-1])


def test_score_of_nothing() -> None:
    rng = np.random.default_rng(0)
    none = score([(np.full((2, 2), np.nan), 1)], np.ones(2, bool), rng)
    assert all(np.isnan(value).all() for value in vars(none).values())
    driven = score([(np.ones((2, 1)), 1)], np.zeros(1, bool), rng)
    assert driven.rmse_mm == 1000.0
    assert np.isnan(driven.rmse_free_mm)
    assert np.isnan(rms(np.zeros(0)))
    assert np.isnan(mean(np.full(3, np.nan)))
    assert mean(np.array([1.0, np.nan, 4.0])) == 2.5


def test_distances_are_those_of_space() -> None:
    predicted = np.array([[[1.0, 2.0, 2.0], [0.0, 0.0, 0.0]]])
    assert distances(predicted, np.zeros((1, 2, 3))).tolist() == [[3.0, 0.0]]
    assert distances(predicted, predicted).tolist() == [[0.0, 0.0]]


# --- the interval ----------------------------------------------------------------------------


def half_width(interval: tuple[float, float]) -> float:
    return (interval[1] - interval[0]) / 2


@pytest.mark.parametrize(('block', 'tolerance'), [(1, 0.12), (20, 0.2)])
def test_interval_of_independent_errors(block: int, tolerance: float) -> None:
    # Each mean square of n normal errors has the deviation sqrt(2 / n), its root half of that.
    # Of 1000 draws a percentile is known to 4 %; 200 blocks know their own variance to 10 %.
    rng = np.random.default_rng(1)
    errors = 3.0 * rng.standard_normal((4000, 1))
    found = rms_interval([(errors, block)], rng)
    assert half_width(found) == pytest.approx(3 * 1.96 * np.sqrt(2 / 4000) / 2, rel=tolerance)
    assert sum(found) / 2 == pytest.approx(rms(errors), rel=0.005)


def test_interval_of_errors_that_last() -> None:
    # 1000 errors that each last 20 frames, and are those of all markers, are no more than 1000.
    rng = np.random.default_rng(2)
    errors = rng.standard_normal((1000, 1)).repeat(20, axis=0).repeat(3, axis=1)
    expected = 1.96 * np.sqrt(2 / 1000) / 2
    assert half_width(rms_interval([(errors, 200)], rng)) == pytest.approx(expected, rel=0.25)
    alone = half_width(rms_interval([(errors, 1)], rng))
    assert alone == pytest.approx(expected / np.sqrt(20), rel=0.15)  # too sure of itself


def test_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(300):
        low, high = rms_interval([(rng.standard_normal((400, 2)), 8)], rng)
        inside += low <= 1.0 <= high
    assert 0.90 < inside / 300 < 0.985  # three deviations of 300 draws, and 1 % for 50 blocks


@pytest.mark.parametrize(('frames', 'block'), [(60, 1), (61, 12), (62, 12), (40, 7)])
def test_interval_with_loops(frames: int, block: int) -> None:
    rng = np.random.default_rng(frames)
    errors = rng.exponential(size=(frames, 4))
    errors[rng.random(errors.shape) > 0.6] = np.nan
    errors[3] = np.nan  # a frame of nothing is no frame
    kept = errors[np.isfinite(errors).any(axis=1)]
    count = len(kept)
    starts = np.random.default_rng(7).integers(count, size=(1000, -(-count // block)))
    drawn = []
    for places in starts:
        rows = [(start + k) % count for start in places for k in range(block)][:count]
        drawn.append(np.sqrt(np.nanmean(kept[rows] ** 2)))
    found = rms_interval([(errors, block)], np.random.default_rng(7))
    np.testing.assert_allclose(found, np.percentile(drawn, [2.5, 97.5]), rtol=1e-12)  # sums


def test_interval_needs_five_blocks() -> None:
    errors = np.random.default_rng(0).random((50, 2))
    assert np.isnan(rms_interval([(errors[:49], 10)], np.random.default_rng(0))).all()
    assert np.isfinite(rms_interval([(errors, 10)], np.random.default_rng(0))).all()
    assert np.isnan(rms_interval([(np.full((50, 2), np.nan), 1)], np.random.default_rng(0))).all()


def test_interval_of_an_evaluation() -> None:
    stamps = np.arange(400) * STEP  # 3 s are judged, less the horizon
    motion = moving(stamps, acceleration=ACCELERATION)
    found = evaluate(motion, config(), 0.1, makers=KINEMATIC)
    for name, errors in found.errors.items():
        expected = rms_interval([(1e3 * errors, 50)], np.random.default_rng(0))  # 0.5 s
        assert found.scores[name].rmse_95_mm == expected
    low, high = found.scores['hold'].rmse_95_mm
    assert low < found.scores['hold'].rmse_mm < high


# --- what methods know of themselves ---------------------------------------------------------

NORMAL = (0.682689, 0.954500, 0.997300)
HALVED = (0.382925, 0.682689, 0.866386)  # within 0.5, 1 and 1.5 sigma
DOUBLED = (0.954500, 0.999937, 1.0)


def close(found: tuple[float, ...] | None, expected: tuple[float, ...], count: int) -> None:
    """Four deviations of a binomial, and one draw."""
    assert found is not None
    for share, p in zip(found, expected, strict=True):
        assert abs(share - p) <= 4 * np.sqrt(p * (1 - p) / count) + 1 / count


@pytest.mark.parametrize(('factor', 'expected'), [(1, NORMAL), (0.5, HALVED), (2, DOUBLED)])
def test_coverage_of_normal_errors(factor: float, expected: tuple[float, ...]) -> None:
    rng = np.random.default_rng(4)
    sigma = rng.uniform(0.001, 0.01, (500, 20))
    offsets = sigma[..., None] * rng.standard_normal((500, 20, 3))
    close(coverage(offsets, factor * sigma), expected, offsets.size)


def test_coverage_by_hand() -> None:
    offsets = np.array([[0.5, -1.5, 2.5], [np.nan, 0.0, 0.0], [9.0, 9.0, 9.0], [-1.0, 2.0, -3.0]])
    sigma = np.array([1.0, 1.0, np.nan, 1.0])
    assert coverage(offsets, sigma) == (2 / 6, 4 / 6, 1.0)
    assert coverage(offsets, np.full(4, np.nan)) is None


@pytest.mark.parametrize(('factor', 'expected'), [(1, NORMAL), (0.5, HALVED), (2, DOUBLED)])
@pytest.mark.parametrize('measured', [True, False])
def test_coverage_of_an_evaluation(
    measured: bool, factor: float, expected: tuple[float, ...]
) -> None:
    rng = np.random.default_rng(5)
    truth = moving(np.arange(1000) * STEP)
    sigma, noise, horizon = 0.004, 0.003, 10
    wrong = sigma * rng.standard_normal(truth.positions.shape)
    wrong[:, [0, 5]] = 1.0  # driven nodes are not asked
    run = said(np.roll(truth.positions, -horizon, axis=0) + wrong, factor * sigma)
    seen = truth.positions + noise * rng.standard_normal(truth.positions.shape)
    markers = MarkerSequence(truth.stamps, truth.labels, seen, truth.visible)
    settings = config(
        anchors={'nodes': [0, 5]}, filter={'measurement_noise': factor * noise if measured else 1}
    )
    reference = None if measured else truth
    found = judged(markers, settings, reference, {'it': run, 'blind': said(run.position)})
    close(found.details['it'].coverage, expected, 890 * 4 * 3)
    assert found.details['blind'].coverage is None
    assert found.details['blind'].by_speed == found.details['it'].by_speed


def test_sigma_of_kinematic_filters() -> None:
    # A marker that does what its filter believes: white noise on the acceleration.
    rng = np.random.default_rng(6)
    dt, density, frames = 0.01, 0.3, 6000
    root = np.linalg.cholesky(density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    kicks = rng.standard_normal((frames, 18, 2)) @ root.T
    speed = np.cumsum(kicks[..., 1], axis=0)
    moved = np.cumsum(kicks[..., 0] + dt * np.vstack([np.zeros((1, 18)), speed[:-1]]), axis=0)
    noisy = moved + 3e-4 * rng.standard_normal(moved.shape)
    stamps, shown = np.arange(frames) * STEP, np.ones((frames, 6), bool)
    truth, markers = (
        MarkerSequence(stamps, tuple('abcdef'), p.reshape(frames, 6, 3), shown)
        for p in (moved, noisy)
    )
    settings = config(filter={'measurement_noise': 3e-4}, baseline={'cv_noise': density})
    found = evaluate(markers, settings, 0.1, truth, {'kf_cv': METHODS['kf_cv']})
    # 108,000 errors, but over the 10 frames of a horizon they are nearly the same ones
    close(found.details['kf_cv'].coverage, NORMAL, 18 * frames // 20)


class RandomWalk:
    """The right filter of 18 coordinates that each walk at random, but for a factor on sigma."""

    associates = False
    counts: dict[str, int] = {}  # noqa: RUF012
    reason = ''

    def __init__(self, factor: float, walk: float, noise: float) -> None:
        self._belief = Gaussian(np.zeros(18), np.eye(18))
        self._walk, self._noise = (factor * walk) ** 2, (factor * noise) ** 2

    def step(
        self, stamp: int, positions: FloatArray, visible: BoolArray, points: FloatArray
    ) -> float:
        before = Gaussian(self._belief.mean, self._belief.cov + self._walk * np.eye(18))
        rows = np.flatnonzero(visible.repeat(3))
        residual = positions.ravel()[rows] - before.mean[rows]
        noise = np.full(len(rows), self._noise)
        self._belief, learnt = condition(before, rows, noise, residual)
        return learnt.nis / len(rows) if len(rows) else np.nan

    def predict(self, horizon: float) -> Predicted:
        variance = np.diagonal(self._belief.cov)[::3] + horizon / 0.01 * self._walk
        return Predicted(self._belief.mean.reshape(6, 3), np.sqrt(variance))

    def estimate(self) -> Estimated:
        cov = self._belief.marginals(np.arange(18).reshape(6, 3))
        return Estimated(self._belief.mean.reshape(6, 3), cov)


@pytest.mark.parametrize(('factor', 'expected'), [(1.0, NORMAL), (0.5, HALVED), (2.0, DOUBLED)])
def test_nis_and_coverage_of_a_linear_filter(factor: float, expected: tuple[float, ...]) -> None:
    rng = np.random.default_rng(7)
    walk, noise, frames = 0.002, 0.001, 2000
    truth = np.cumsum(walk * rng.standard_normal((frames, 6, 3)), axis=0)
    seen = truth + noise * rng.standard_normal(truth.shape)
    visible = rng.random((frames, 6)) > 0.2
    visible[300] = False  # nothing learnt is not an innovation of zero
    markers = MarkerSequence(np.arange(frames) * STEP, tuple('abcdef'), seen, visible)
    settings = config(filter={'measurement_noise': factor * noise})
    method = {'it': lambda _: RandomWalk(factor, walk, noise)}
    found = evaluate(markers, settings, 0.01, makers=method).details['it']
    # about 14 degrees of freedom in each of 1898 frames; four deviations of their chi-square
    assert found.nis * factor**2 == pytest.approx(1.0, abs=4 * np.sqrt(2 / (14 * 1898)))
    close(found.coverage, expected, 1898 * 14)


def test_nis_and_sigma_are_those_of_the_tracker() -> None:
    rng = np.random.default_rng(8)
    clean = moving()
    noisy = clean.positions + 3e-4 * rng.standard_normal(clean.positions.shape)
    markers = MarkerSequence(GRID, clean.labels, noisy, clean.visible)
    found = evaluate(markers, config(), 0.1).details
    tracker, method, learnt = Tracker(config()), METHODS['ekf'](config()), []
    assert np.isnan(method.predict(0.1).sigma).all()
    for k, stamp in enumerate(GRID.tolist()):
        innovation = tracker.step(stamp, noisy[k], clean.visible[k]).innovation
        learnt.append(np.nan if innovation is None else innovation.nis / 18)
        method.step(stamp, noisy[k], clean.visible[k])
    np.testing.assert_array_equal(method.predict(0.1).position, tracker.predict(0.1).position)
    np.testing.assert_array_equal(method.predict(0.1).sigma, tracker.predict(0.1).sigma)
    assert found['ekf'].nis == pytest.approx(np.mean(learnt[100:191]), rel=1e-12)  # a sum
    assert np.isnan(found['hold'].nis)


# --- errors by speed -------------------------------------------------------------------------


def test_errors_by_speed_of_uniform_motions() -> None:
    velocity = np.outer([3, 1, 6, 2, 5, 4], [0.6, 0.0, -0.8])  # m/s
    found = evaluate(moving(velocity=velocity), config(), 0.1, makers=KINEMATIC)
    parts = found.details['hold'].by_speed
    assert [part.up_to_m_s for part in parts] == pytest.approx([2.0, 4.0, 6.0])
    expected = [100 * np.sqrt((a**2 + b**2) / 2) for a, b in ((1, 2), (3, 4), (5, 6))]
    # rounding sorts equal speeds at random, so the last few of a third may be of its neighbour
    assert [part.rmse_mm for part in parts] == pytest.approx(expected, rel=1e-9)
    for part in found.details['kf_cv'].by_speed:
        assert part.rmse_mm < ROUNDING
    driven = config(anchors={'nodes': [0, 2, 3]})
    parts = evaluate(moving(velocity=velocity), driven, 0.1).details['hold'].by_speed
    assert [part.up_to_m_s for part in parts] == pytest.approx([1.0, 4.0, 5.0])
    assert [part.rmse_mm for part in parts] == pytest.approx([100.0, 400.0, 500.0])


def test_errors_by_speed_by_hand() -> None:
    errors = np.array([[0.001, 0.002, 0.003], [0.004, np.nan, 0.006]])
    speed = np.array([[5.0, 4.0, np.nan], [3.0, 2.0, 1.0]])
    slow, medium, fast = by_speed(errors, speed)
    assert slow.up_to_m_s == 3.0  # of four speeds, the slowest third is two
    assert slow.rmse_mm == pytest.approx(np.sqrt((36 + 16) / 2))
    assert (medium, fast) == (SpeedBin(4.0, 2.0), SpeedBin(5.0, 1.0))
    for part in by_speed(errors, np.full((2, 3), np.nan)):
        assert np.isnan([part.up_to_m_s, part.rmse_mm]).all()
    still, *faster = by_speed(errors, np.zeros((2, 3)))  # all alike: all are in the slowest third
    assert still.rmse_mm == pytest.approx(np.sqrt((1 + 4 + 9 + 16 + 36) / 5))
    assert np.isnan([part.rmse_mm for part in faster]).all()


def test_speeds_are_central_differences() -> None:
    visible = np.ones((201, 6), bool)
    visible[50, 2] = False
    motion = moving(acceleration=ACCELERATION, visible=visible)
    found = speeds(motion, GRID, STEP)
    expected = np.linalg.norm(VELOCITY + ACCELERATION * (GRID / 1e9)[:, None], axis=1)
    known = np.isfinite(found)
    assert np.argwhere(~known[1:-1]).tolist() == [[48, 2], [50, 2]]  # beside the hidden one
    assert not known[[0, -1]].any()
    np.testing.assert_allclose(  # exact for a parabola, but for rounding
        found[known], expected[:, None].repeat(6, axis=1)[known], rtol=1e-10
    )


# --- positions at other times ----------------------------------------------------------------


@pytest.fixture
def line() -> Callable[[list[int]], MarkerSequence]:
    """Make two markers whose coordinates are the stamp in µs, and its square."""

    def make(stamps: list[int]) -> MarkerSequence:
        time = np.array(stamps)[:, None, None] / 1e3
        positions = np.concatenate([time, time**2], axis=1) * np.ones(3)
        return MarkerSequence(
            np.array(stamps), ('a', 'b'), positions, np.ones(positions.shape[:2], bool)
        )

    return make


def test_times_of_frames_are_exact(line: Callable[[list[int]], MarkerSequence]) -> None:
    sequence = line([0, 10_000, 25_000, 30_000])
    positions, visible = at_times(sequence, sequence.stamps)
    np.testing.assert_array_equal(positions, sequence.positions)
    assert visible.all()
    positions, visible = at_times(sequence, np.array([25_000, 0]))  # in any order
    np.testing.assert_array_equal(positions, sequence.positions[[2, 0]])
    assert visible.all()


@pytest.mark.parametrize(
    ('time', 'expected'),
    [
        (14_999, (14.999, 100 + 0.4999 * 300)),
        (12_500, (12.5, 175.0)),
        (10_999, (10.0, 100.0)),  # within a microsecond of a frame
        (11_000, (10.0, 100.0)),
        (11_001, (11.001, 130.03)),
        (18_999, (18.999, 369.97)),
        (19_000, (20.0, 400.0)),
        (20_000, (20.0, 400.0)),
        (-1_000, (0.0, 0.0)),
        (-1_001, None),
        (-50_000, None),
        (31_000, (30.0, 900.0)),
        (31_001, None),
        (99_999, None),
    ],
)
def test_between_beside_and_beyond_frames(
    line: Callable[[list[int]], MarkerSequence],
    time: int,
    expected: tuple[float, float] | None,
) -> None:
    positions, visible = at_times(line([0, 10_000, 20_000, 30_000]), np.array([time]))
    assert visible.tolist() == [[expected is not None] * 2]
    if expected is not None:
        np.testing.assert_allclose(positions[0, :, 1], expected, rtol=1e-12)  # of two products


def test_gaps_of_more_than_two_intervals_stay_empty(
    line: Callable[[list[int]], MarkerSequence],
) -> None:
    sequence = line([0, 10_000, 20_000, 40_000, 50_000, 70_001, 80_001, 90_001])
    times = np.array([30_000, 60_000, 40_000, 70_001, 70_500])
    positions, visible = at_times(sequence, times)
    assert visible[:, 0].tolist() == [True, False, True, True, True]
    assert positions[0, :, 0].tolist() == [30.0, (400 + 1600) / 2]


def test_hidden_markers_are_not_interpolated(
    line: Callable[[list[int]], MarkerSequence],
) -> None:
    full = line([0, 10_000, 20_000])
    visible = np.array([[True, True], [False, True], [True, True]])
    positions = np.where(visible[..., None], full.positions, np.nan)
    sequence = MarkerSequence(full.stamps, full.labels, positions, visible)
    found, seen = at_times(sequence, np.array([0, 5_000, 10_000, 15_000, 20_000]))
    assert seen.tolist() == [[True, True], [False, True], [False, True], [False, True], [True] * 2]
    assert np.isnan(found[1:4, 0]).all()
    assert np.isfinite(found[seen]).all()


def test_a_single_frame(line: Callable[[list[int]], MarkerSequence]) -> None:
    _, visible = at_times(line([5_000]), np.array([0, 4_000, 5_000, 6_001]))
    assert visible[:, 0].tolist() == [False, True, True, False]


def test_no_times(line: Callable[[list[int]], MarkerSequence]) -> None:
    positions, visible = at_times(line([0, 1_000]), np.zeros(0, np.int64))
    assert (positions.shape, visible.shape) == ((0, 2, 3), (0, 2))
