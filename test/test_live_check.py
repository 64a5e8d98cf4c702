"""The live check: the numbers of an evaluation, from one frame after the other."""

from __future__ import annotations

from math import isnan, nan
from pathlib import Path

import numpy as np
import pytest
from recordings import shipped

from cloth_predict.config import Config, load
from cloth_predict.evaluation.cases import labelled_case
from cloth_predict.evaluation.compare import compare
from cloth_predict.evaluation.judging import WARM_UP
from cloth_predict.evaluation.predictors import METHODS
from cloth_predict.tracking import live_check
from cloth_predict.tracking.live_check import ENOUGH, LiveCheck, Realised, warning
from cloth_predict.types import BoolArray, FloatArray, MarkerSequence, Surface

ROOT = Path(__file__).parents[1]
FRAME = 10_000_000  # ns
TWO = np.ones(2, bool)


def surface(stamp: int, position: FloatArray, sigma: FloatArray | float = 1e-3) -> Surface:
    variance = np.broadcast_to(np.square(sigma), len(position))
    none = np.zeros_like(position)
    return Surface(stamp, position, none, none, variance[:, None, None] * np.eye(3))


def moving(times: FloatArray) -> FloatArray:
    """Two markers that move evenly, 3 m/s and 5 m/s, shape (times, 2, 3)."""
    velocity = np.array([[2.0, -2.0, 1.0], [0.0, 3.0, 4.0]])
    return np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]) + times[:, None, None] * velocity


def follow(
    check: LiveCheck,
    frames: range,
    ahead: int,
    off: float = 0.0,
    hidden: set[tuple[int, int]] | None = None,
) -> None:
    """Give frames of `moving`, hidden by (frame, marker), and predictions `off` [m] along x."""
    for k in frames:
        visible = np.array([(k, marker) not in (hidden or ()) for marker in range(2)])
        position = np.where(visible[:, None], moving(np.array([1e-9 * FRAME * k]))[0], nan)
        check.measured(FRAME * k, position, visible)
        target = FRAME * k + ahead
        predicted = moving(np.array([1e-9 * target]))[0] + [off, 0.0, 0.0]
        check.predicted('a', surface(target, predicted))


# --- against the evaluation


@pytest.fixture(scope='module')
def towel() -> MarkerSequence:
    """2.4 s of the shipped recording; one frame in nine is not there, and many markers."""
    markers = shipped().markers
    keep = np.flatnonzero(np.arange(240) % 9 != 4)
    seen = np.random.default_rng(3).random((len(keep), 20)) > 0.1
    seen[0] = True
    visible = markers.visible[keep] & seen
    positions = np.where(visible[..., None], markers.positions[keep], nan)
    return MarkerSequence(markers.stamps[keep], markers.labels, positions, visible)


def watched(markers: MarkerSequence, config: Config, horizons: list[float]) -> LiveCheck:
    """Run the tracker over a recording, with its predictions checked after the warm-up."""
    predictor = METHODS['ekf'](config)
    check = LiveCheck(100.0, config.filter.measurement_noise, free_nodes(config))
    for k, stamp in enumerate(markers.stamps.tolist()):
        predictor.step(stamp, markers.positions[k], markers.visible[k])
        check.measured(stamp, markers.positions[k], markers.visible[k])
        for horizon in horizons:
            found = predictor.predict(horizon)  # from the first frame on, as evaluate does
            if stamp < markers.stamps[0] + 1e9 * WARM_UP:
                continue
            target = stamp + round(1e9 * horizon)
            check.predicted(f'{horizon}', surface(target, found.position, found.sigma))
    return check


def free_nodes(config: Config) -> BoolArray:
    free = np.ones(config.model.count, bool)
    free[list(config.anchors.nodes)] = False
    return free


def test_equal_to_the_evaluation(towel: MarkerSequence) -> None:
    config = load(ROOT / 'config' / 'towel_coarse.yaml')  # any filter will do
    horizons = [0.1, 0.037, 0.0]  # on a frame, between two frames, and at the frame itself
    reports = watched(towel, config, horizons).report()
    methods = {name: METHODS[name] for name in ('hold', 'ekf')}
    for expected in compare(labelled_case(towel, config, 'towel'), config, horizons, methods):
        found = reports[f'{expected.horizon}']
        assert found.count == len(expected.targets) > 100
        # 1e-9: only the order of the sums differs
        assert found.error_mm == pytest.approx(expected.scores['ekf'].rmse_mm, rel=1e-9)
        assert found.hold_mm == pytest.approx(expected.scores['hold'].rmse_mm, rel=1e-9)
        assert found.coverage == pytest.approx(expected.details['ekf'].coverage, rel=1e-9)
        if expected.horizon:
            gain = 1 - expected.scores['ekf'].rmse_mm / expected.scores['hold'].rmse_mm
            assert found.gain == pytest.approx(gain, rel=1e-9)


# --- closed forms


@pytest.mark.parametrize('ahead', [5 * FRAME, 5 * FRAME + 3_000_000, 400])
def test_even_motion(ahead: int) -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    follow(check, range(60), ahead, off=0.002)
    found = check.report()['a']
    assert found.count == 60 - -(-(ahead - 1000) // FRAME)
    # 1e-9 relative: interpolation of an even motion is exact; 400 ns is taken for no time at all
    assert found.error_mm == pytest.approx(2.0, rel=2e-3 if ahead == 400 else 1e-9)
    rms = 1e3 * np.sqrt((3.0**2 + 5.0**2) / 2)  # mm/s, of 3 m/s and 5 m/s
    if ahead > 400:
        assert found.hold_mm == pytest.approx(rms * 1e-9 * ahead, rel=1e-9)
        assert found.gain == pytest.approx(1 - 2.0 / found.hold_mm, rel=1e-9)
    # sigma is 1 mm: two of three coordinates are exact, and one is 2 sigma off but for rounding
    assert found.coverage[0] == pytest.approx(2 / 3)
    assert found.coverage[2] == 1.0


def test_noise_of_the_markers_counts_towards_sigma() -> None:
    check = LiveCheck(10.0, 2e-3, TWO)  # sqrt(1 + 4) mm = 2.24 mm > 2 mm
    follow(check, range(60), 5 * FRAME, off=0.002)
    assert check.report()['a'].coverage == (1.0, 1.0, 1.0)


def test_coverage_is_of_the_free_nodes() -> None:
    check = LiveCheck(10.0, 0.0, np.array([True, False]))
    for k in range(20):
        at = np.zeros((2, 3))
        check.measured(FRAME * k, at, TWO)
        sigma = np.array([1e-3, 1e-12])
        check.predicted('a', surface(FRAME * (k + 1), at + 0.5e-3, sigma))
    assert check.report()['a'].coverage == (1.0, 1.0, 1.0)
    driven = LiveCheck(10.0, 0.0, np.zeros(2, bool))
    follow(driven, range(9), FRAME)
    assert all(isnan(share) for share in driven.report()['a'].coverage)


def test_hidden_markers_are_not_judged_and_hold_keeps_what_was_seen() -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    # marker 1 is seen at frame 0 and at frame 10 only
    hidden = {(k, 1) for k in range(20) if k not in (0, 10)}
    follow(check, range(20), 4 * FRAME, hidden=hidden)
    found = check.report()['a']
    assert found.count == 16
    # marker 0 was seen 4 frames before each of its 16 targets; marker 1, judged once, 10 before
    squares = 16 * (3.0 * 0.04) ** 2 + (5.0 * 0.10) ** 2
    assert found.hold_mm == pytest.approx(1e3 * np.sqrt(squares / 17), rel=1e-9)
    assert found.error_mm == pytest.approx(0.0, abs=1e-9)  # mm; rounding of metres


def test_nothing_is_said_of_markers_never_seen() -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    follow(check, range(20), FRAME, hidden={(k, m) for k in range(20) for m in range(2)})
    found = check.report()['a']
    assert found.count == 0
    assert isnan(found.error_mm) and isnan(found.gain)  # noqa: PT018


def test_the_window_forgets() -> None:
    check = LiveCheck(1.0, 0.0, TWO)
    follow(check, range(200), FRAME, off=0.1)
    follow(check, range(200, 350), FRAME, off=0.003)
    found = check.report()['a']
    assert found.count == 101  # targets of the last second, both ends
    assert found.error_mm == pytest.approx(3.0, rel=1e-9)  # rounding of the interpolation


def test_a_gap_is_not_interpolated() -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    follow(check, range(20), FRAME // 2)
    follow(check, range(23, 30), FRAME // 2)  # frame 19 predicts into the gap
    assert check.report()['a'].count == 19 + 6


@pytest.mark.parametrize('back', [0, 19])
def test_time_that_runs_back_starts_anew(back: int) -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    follow(check, range(20), 5 * FRAME, off=0.5)
    follow(check, range(back, back + 20), 5 * FRAME, off=0.001)
    found = check.report()['a']
    assert found.count == 15
    assert found.error_mm == pytest.approx(1.0, rel=1e-9)  # rounding of the interpolation


def test_horizons_may_shrink_and_names_are_apart() -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    for k, ahead in enumerate([9, 2, 1, 3, 1, 1, 5, 1, 1, 1]):
        at = np.zeros((2, 3))
        check.measured(FRAME * k, at, TWO)
        check.predicted('a', surface(FRAME * (k + ahead), at + 0.001))
        check.predicted('b', surface(FRAME * (k + 1), at))
    report = check.report()
    assert (report['a'].count, report['b'].count) == (8, 9)  # the targets up to frame 9
    assert report['a'].error_mm == pytest.approx(np.sqrt(3))
    assert report['b'].error_mm == 0.0


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_check, 'PENDING', 50)
    monkeypatch.setattr(live_check, 'JUDGED', 70)
    check = LiveCheck(600.0, 0.0, TWO)
    follow(check, range(200), 10**12)
    assert len(check._pending['a']) == 50
    far = LiveCheck(600.0, 0.0, TWO)
    follow(far, range(200), FRAME)
    assert far.report()['a'].count == 70


def test_inputs_may_be_written_to_afterwards() -> None:
    check = LiveCheck(10.0, 0.0, TWO)
    position, visible = np.zeros((2, 3)), np.ones(2, bool)
    for k in range(5):
        position[:], visible[:] = 0.5 * k, True
        check.measured(FRAME * k, position, visible)
        check.predicted('a', surface(FRAME * k + FRAME // 2, np.full((2, 3), 0.5 * k + 0.25)))
        position[:], visible[:] = 7.0, False
    found = check.report()['a']
    assert (found.count, found.error_mm) == (4, 0.0)
    assert found.hold_mm == pytest.approx(250 * np.sqrt(3))


# --- what is said of it


GOOD = (0.68, 0.95, 0.99)


@pytest.mark.parametrize(
    ('found', 'words'),
    [
        (Realised(ENOUGH, 5.0, 30.0, GOOD), ''),
        (
            Realised(ENOUGH, 31.0, 30.0, GOOD),
            'are worse than the last measurement: 31.0 mm, not 30',
        ),
        (Realised(ENOUGH - 1, 31.0, 30.0, GOOD), ''),
        (
            Realised(ENOUGH, 5.0, 30.0, (0.4, 0.7, 0.9)),
            'sigma is too small: 70 % of the errors',
        ),
        (Realised(ENOUGH, 5.0, 30.0, (1.0, 1.0, 1.0)), ''),  # a surface that happens to be calm
        (Realised(ENOUGH, 1.0, 0.5, GOOD), ''),  # within the noise: 2 sqrt(3) 0.3 mm = 1.04 mm
        (Realised(ENOUGH, 1.1, 0.5, GOOD), 'worse than the last measurement'),
        (Realised(0, nan, nan, (nan, nan, nan)), ''),
        (Realised(ENOUGH, 5.0, 30.0, (nan, nan, nan)), ''),
    ],
)
def test_warning(found: Realised, words: str) -> None:
    text = warning(found, 3e-4)
    assert words in text
    assert bool(text) == bool(words)
