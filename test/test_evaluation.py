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
from cloth_predict.evaluation import METHODS, Evaluation, Hold, evaluate, in_order, judge
from cloth_predict.metrics import Score, at_times, distances, rms, score
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

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
    return build({'model': model, **values}, 'test')


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
    np.testing.assert_allclose(found.predicted['kf_cv'] - found.actual, 0.0, atol=1e-3 * ROUNDING)


@pytest.mark.parametrize('horizon', [0.02, 0.1, 0.3])
@pytest.mark.parametrize('density', [0.1, 30.0])
def test_constant_acceleration(horizon: float, density: float) -> None:
    settings = config(baseline={'cv_noise': density})
    found = evaluate(moving(acceleration=ACCELERATION), settings, horizon, methods=KINEMATIC)
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
    found = evaluate(moving(), config(), horizon, methods=KINEMATIC)
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
    ('stamps', 'kept'),
    [
        ([0, 10, 20], [0, 1, 2]),
        ([0, 10, 10, 20], [0, 1, 3]),
        ([0, 10, 5, 7, 10, 11], [0, 1, 5]),
        ([30, 10, 20, 31], [0, 3]),
        ([5, 5, 5], [0]),
        ([7], [0]),
        ([-5, -7, 0], [0, 2]),
    ],
)
def test_in_order(stamps: list[int], kept: list[int]) -> None:
    positions = np.arange(3.0 * len(stamps)).reshape(-1, 1, 3)
    visible = np.arange(len(stamps))[:, None] % 2 == 0
    markers = MarkerSequence(np.array(stamps), ('a',), positions, visible, 'world')
    found = in_order(markers)
    assert found.stamps.tolist() == [stamps[k] for k in kept]
    assert found.positions.tolist() == positions[kept].tolist()
    assert found.visible.tolist() == visible[kept].tolist()
    assert (found.labels, found.frame_id) == (('a',), 'world')


# --- what is counted -------------------------------------------------------------------------


def test_driven_nodes_are_not_among_the_free() -> None:
    velocity = np.zeros((6, 3))
    velocity[:, 0] = [5, 1, 1, 1, 1, 3]
    anchors = {'nodes': [5, 0]}
    found = evaluate(moving(velocity=velocity), config(anchors=anchors), 0.1, methods=KINEMATIC)
    hold = found.scores['hold']
    assert hold.rmse_free_mm == pytest.approx(100.0, abs=ROUNDING)
    assert hold.rmse_mm == pytest.approx(100 * np.sqrt((25 + 9 + 4) / 6), abs=ROUNDING)
    assert hold.max_mm == pytest.approx(500.0, abs=ROUNDING)


class Sometimes:
    """Knows marker 2 never, and the others at every second frame; is always 1 m off in z."""

    def __init__(self, config: Config) -> None:
        self._odd = False

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> None:
        self._odd, self._now = stamp // STEP % 2 == 1, positions

    def positions(self, horizon: float) -> FloatArray:
        guess = self._now + np.array([0.0, 0.0, 1.0])
        guess[2] = np.nan
        return guess * (np.nan if self._odd else 1.0)


def test_every_method_is_judged_by_the_same_frames_and_markers() -> None:
    still = moving(velocity=np.zeros(3))
    methods = {'sometimes': Sometimes, **KINEMATIC}
    found = evaluate(still, config(), 0.1, methods=methods)
    assert found.targets.tolist() == (GRID[100:191:2] + 10 * STEP).tolist()
    for errors in found.errors.values():
        assert np.isnan(errors[:, 2]).all()
        assert np.isfinite(np.delete(errors, 2, axis=1)).all()
    all_equal(found.scores['sometimes'], 1000.0)
    all_equal(found.scores['hold'], 0.0)


def test_the_first_second_is_not_judged() -> None:
    positions = moving().positions.copy()
    positions[:100] += 5.0  # would be an error of metres
    jump = MarkerSequence(GRID, tuple('abcdef'), positions, np.ones((201, 6), bool))
    found = evaluate(jump, config(), 0.1, methods={'hold': Hold})
    assert found.targets.tolist() == (GRID[100:191] + 10 * STEP).tolist()
    assert found.targets[0] == 1_100_000_000
    all_equal(found.scores['hold'], 130.0)


def test_the_first_second_begins_with_the_recording() -> None:
    found = evaluate(
        moving(GRID + 1_700_000_000_000_000_000), config(), 0.1, methods={'hold': Hold}
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
    found = evaluate(measured, config(), 0.005, truth, methods=KINEMATIC)
    assert len(found.targets) == 100  # half a frame ahead of each after 1 s, the last is too late
    assert np.isfinite(found.errors['hold']).all()  # of markers that are hidden, too
    np.testing.assert_array_equal(found.actual, truth.positions[201:400:2])
    np.testing.assert_allclose(found.errors['kf_cv'], 0.001, atol=1e-3 * ROUNDING)


def test_late_markers_are_compared_from_when_they_are_seen() -> None:
    visible = np.ones((201, 6), bool)
    visible[:150, 3] = False
    found = evaluate(moving(visible=visible), config(), 0.1, methods=KINEMATIC)
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
        evaluate(moving(GRID[:frames]), config(), horizon, methods={'hold': Hold}, source='here')
    assert str(caught.value) == (
        f'here: no frame can be judged: the recording lasts {text} s, of which the first 1.0 s '
        f'are the warm-up and the last {horizon} s have no later measurement'
    )


def test_the_shortest_recording_that_can_be_judged() -> None:
    found = evaluate(moving(GRID[:111]), config(), 0.1, methods={'hold': Hold})
    assert found.targets.tolist() == [1_100_000_000]


def test_nothing_visible_after_the_first_second() -> None:
    visible = np.arange(201)[:, None].repeat(6, axis=1) < 100
    with pytest.raises(FormatError, match='no frame can be judged'):
        evaluate(moving(visible=visible), config(), 0.1, methods={'hold': Hold})


def test_judge_takes_predictions_of_any_origin() -> None:
    markers = moving(velocity=np.zeros(3))
    offset = np.zeros((201, 6, 3))
    offset[:, 1, 0], offset[150, 4] = 0.002, [0.02, 0.03, 0.06]
    offset[:, 5] = np.nan
    found = judge(
        markers, config(), 0.1, markers, {'it': markers.positions + offset}, {'it': 0.0201}
    )
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
    assert list(summary) == ['horizon_s', 'frames', 'methods']
    assert (summary['horizon_s'], summary['frames']) == (0.1, 91)
    assert list(summary['methods']) == list(METHODS)
    for name, numbers in summary['methods'].items():
        expected = ['rmse_mm', 'rmse_free_mm', 'p95_mm', 'max_mm', 'us_per_frame']
        assert list(numbers) == expected
        assert numbers['us_per_frame'] == found.us_per_frame[name] > 0
        assert Score(*(numbers[key] for key in expected[:4])) == found.scores[name]


def test_progress_counts_the_frames_of_every_method() -> None:
    done: list[int] = []
    evaluate(moving(GRID[:120]), config(), 0.1, methods=KINEMATIC, progress=done.append)
    assert sum(done) == 3 * 120


def test_two_runs_give_the_same_numbers() -> None:
    visible = np.random.default_rng(2).random((201, 6)) > 0.1
    visible[0] = True
    one, two = (
        evaluate(moving(visible=visible, acceleration=ACCELERATION), config(), 0.1)
        for _ in range(2)
    )
    for name in METHODS:
        np.testing.assert_array_equal(one.predicted[name], two.predicted[name])


def test_shapes_belong_together() -> None:
    found: Evaluation = evaluate(moving(), config(), 0.1, methods=KINEMATIC)
    assert found.actual.shape == (91, 6, 3)
    for name in KINEMATIC:
        assert found.predicted[name].shape == (91, 6, 3)
        assert found.errors[name].shape == (91, 6)
        np.testing.assert_allclose(
            found.errors[name], distances(found.predicted[name], found.actual)
        )


# --- numbers ---------------------------------------------------------------------------------


def test_score_by_hand() -> None:
    errors = np.array([[0.001, 0.002], [0.003, np.nan], [0.005, 0.007]])
    counted = np.array([[True, True], [True, False], [False, True]])
    found = score(errors, counted, np.array([True, False]))
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
    found = score(errors, counted, free)
    assert found.rmse_mm == pytest.approx((sum(e**2 for e in every) / len(every)) ** 0.5)
    assert found.rmse_free_mm == pytest.approx((sum(e**2 for e in of_free) / len(of_free)) ** 0.5)
    assert found.p95_mm == pytest.approx(
        every[low] + (place - low) * (every[low + 1] - every[low])
    )
    assert found.max_mm == pytest.approx(every[-1])


def test_score_of_nothing() -> None:
    none = score(np.ones((2, 2)), np.zeros((2, 2), bool), np.ones(2, bool))
    assert all(np.isnan(value) for value in vars(none).values())
    driven = score(np.ones((2, 1)), np.ones((2, 1), bool), np.zeros(1, bool))
    assert driven.rmse_mm == 1000.0
    assert np.isnan(driven.rmse_free_mm)
    assert np.isnan(rms(np.zeros(0)))


def test_distances_are_those_of_space() -> None:
    predicted = np.array([[[1.0, 2.0, 2.0], [0.0, 0.0, 0.0]]])
    assert distances(predicted, np.zeros((1, 2, 3))).tolist() == [[3.0, 0.0]]
    assert distances(predicted, predicted).tolist() == [[0.0, 0.0]]


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
