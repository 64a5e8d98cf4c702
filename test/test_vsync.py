"""When frames begin: whole numbers of nanoseconds, phases that are heard, and clocks in steps."""

from __future__ import annotations

from decimal import Decimal, getcontext
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cloth_predict.config import Config, ProjectorConfig, build
from cloth_predict.errors import ConfigError
from cloth_predict.nodes._clock import Ticks
from cloth_predict.projection.vsync import HEARD, HeardVsync, Vsync, moved_on
from cloth_predict.tracking.horizons import BACKLOG, FRESH, LATEST, Backlog, FrameRequests

getcontext().prec = 60
NOW = 1_790_000_000_123_456_789  # ns; a float of this size resolves 256 ns
MS = 10**6
FPS = st.floats(1.0, 1000.0)
TIME = st.integers(-(2 * 10**18), 2 * 10**18)


# --- the grid of vsyncs


@given(TIME, TIME, FPS)
def test_the_next_vsync_is_the_first_of_the_grid_that_is_later(
    phase: int, time: int, fps: float
) -> None:
    found = Vsync(phase, fps).after(time)
    period = Decimal(10**9) / Decimal(fps)
    k = round((Decimal(found - phase)) / period)
    # a vsync is rounded down to a nanosecond; both numbers have 60 digits
    assert abs(phase + k * period - Decimal(found)) <= 1
    assert time < found <= time + period + 1


def test_a_year_of_frames_does_not_drift() -> None:
    fps, frames = 59.94, 60 * 365 * 86400
    vsync, at = Vsync(NOW, fps), NOW
    for _ in range(1000):
        at = vsync.after(at)
    assert at == NOW + int(1000 * 10**9 / Fraction(fps))
    far = NOW + int(frames * 10**9 / Fraction(fps))
    assert vsync.after(far - 1) == far


def test_a_frame_to_come_is_kept_and_a_past_one_moved_on_by_whole_periods() -> None:
    assert moved_on(NOW + 1, NOW, 60.0) == NOW + 1
    assert moved_on(NOW, NOW, 50.0) == NOW + 20 * MS
    assert moved_on(NOW - 50 * MS, NOW, 50.0) == NOW + 10 * MS


# --- vsyncs that are heard


def heard(stamps: list[int], fps: float = 60.0) -> HeardVsync:
    found = HeardVsync(fps, 0)
    for stamp in stamps:
        found.hear(int(stamp))
    return found


def off_grid(found: HeardVsync, fps: float, phase: int) -> float:
    """How far [ns] the phase is from the grid through `phase`, the nearest way round."""
    period = 1e9 / fps
    return (found.vsync.phase - phase + period / 2) % period - period / 2


def test_before_the_first_vsync_is_heard_the_configured_phase_holds() -> None:
    assert HeardVsync(60.0, 123).vsync == Vsync(123, 60.0)


def test_the_phase_is_heard_through_jitter_and_gaps() -> None:
    rng = np.random.default_rng(4)
    beats = np.flatnonzero(rng.random(200) < 0.6)  # four of ten are missed
    jitter = rng.normal(0, 0.5e6, len(beats))
    found = heard((NOW + beats * 1e9 / 60 + jitter).astype(np.int64).tolist())
    # the median of 15 has a standard error of 1.25 sigma / sqrt(15) = 0.16 ms; 3 of them
    assert abs(off_grid(found, 60.0, NOW)) < 0.5e6
    assert found.fits


def test_one_vsync_that_is_very_late_moves_nothing() -> None:
    beats = [NOW + k * 20 * MS for k in range(HEARD - 1)]
    found = heard([*beats, beats[-1] + 27 * MS], fps=50.0)
    assert off_grid(found, 50.0, NOW) == pytest.approx(0.0, abs=2)  # ns, of rounding


def test_vsyncs_at_the_edge_of_a_period_do_not_cancel_out() -> None:
    beats = [NOW + k * 20 * MS + (9 * MS if k % 2 else -9 * MS) for k in range(HEARD)]
    assert heard(beats, fps=50.0).fits  # 18 ms apart one way round, but 2 ms the other


def test_a_jump_back_starts_anew() -> None:
    found = heard([NOW + k * 20 * MS for k in range(HEARD)] + [5 * MS], fps=50.0)
    assert found.vsync == Vsync(5 * MS, 50.0)


@pytest.mark.parametrize(('fps', 'fits'), [(60.0, True), (59.94, True), (47.0, False)])
def test_a_rate_that_is_not_the_projectors_is_told(fps: float, fits: bool) -> None:
    assert heard([NOW + round(k * 1e9 / fps) for k in range(30)]).fits == fits


# --- a clock that stands still between ticks


def ticking(stamps: list[int], steady: list[float]) -> Ticks:
    ticks = Ticks()
    for stamp, at in zip(stamps, steady, strict=True):
        ticks.tick(stamp, at)
    return ticks


def test_there_is_no_time_before_the_first_tick_and_it_stands_at_that() -> None:
    assert Ticks().now(1.0) is None
    assert ticking([5], [1.0]).now(9.0) == 5


@pytest.mark.parametrize('rate', [0.5, 1.0, 3.0])
def test_time_goes_on_between_ticks_at_their_rate_and_not_beyond_the_next(rate: float) -> None:
    steady = (10.0 + np.arange(20) * 0.01 / rate).tolist()
    ticks = ticking([NOW + k * 10 * MS for k in range(20)], steady)
    last = NOW + 190 * MS
    assert ticks.rate == pytest.approx(rate)
    # 1 us: a steady time in double precision, and a rate from differences of it
    assert ticks.now(steady[-1] + 0.004 / rate) == pytest.approx(last + 4 * MS, abs=1000)
    assert ticks.now(steady[-1] + 5.0) == pytest.approx(last + 10 * MS, abs=1)
    assert not ticks.stands(steady[-1] + 0.004 / rate)
    assert ticks.stands(steady[-1] + 5.0)


def test_a_clock_that_is_set_back_starts_anew() -> None:
    assert ticking([NOW, NOW + 10 * MS, 7], [1.0, 1.01, 1.02]).now(1.5) == 7


# --- the frame that is asked for

VSYNC = Config(
    horizon=0.1, horizon_mode='vsync', projector=ProjectorConfig(fps=50.0, delay=0.02, lead=0.004)
)


def asked(start: int, took: float = 0.0) -> FrameRequests:
    requests = FrameRequests(VSYNC)
    requests.ask(start)
    for _ in range(20):
        requests.add(took)
    return requests


def test_before_a_frame_is_asked_for_the_horizon_is_the_configured_one() -> None:
    assert FrameRequests(VSYNC).horizon(NOW, 0.0) == 0.1


def test_the_horizon_lands_on_the_frame_that_is_asked_for() -> None:
    horizon = asked(NOW + 123_456_789).horizon(NOW, 0.001)
    assert round(1e9 * horizon) == 123_456_789


def test_a_frame_that_is_made_before_the_prediction_is_there_is_not_aimed_at() -> None:
    # made at its start less delay and lead: 24 ms; there at 10 + 5 ms after the capture
    assert asked(NOW + 40 * MS, took=0.005).horizon(NOW, 0.010) == pytest.approx(0.040)
    assert asked(NOW + 38 * MS, took=0.005).horizon(NOW, 0.010) == pytest.approx(0.058)
    assert asked(NOW - 42 * MS, took=0.005).horizon(NOW, 0.010) == pytest.approx(0.058)


def test_where_the_clocks_tell_no_age_the_first_frame_after_the_capture_is_aimed_at() -> None:
    assert asked(NOW + 1 * MS).horizon(NOW, 1e9) == pytest.approx(0.001)
    assert asked(NOW - 1 * MS).horizon(NOW, 1e9) == pytest.approx(0.019)


@pytest.mark.parametrize('off', [1e9, LATEST + 0.1, -LATEST - 0.1])
def test_a_frame_out_of_reach_leaves_the_horizon_and_is_told(off: float) -> None:
    requests = asked(NOW + round(1e9 * off))
    assert requests.horizon(NOW, 0.001) == 0.1
    assert f'is {off:.3g} s after the markers' in requests.warning
    requests.ask(NOW + 30 * MS)
    requests.horizon(NOW, 0.001)
    assert requests.warning == ''


def predicted_from(backlog: Backlog, ages: list[float]) -> list[bool]:
    return [not backlog.leaves_out(age) for age in ages]


def test_the_longer_frames_wait_the_more_of_them_are_left_out() -> None:
    backlog = Backlog(VSYNC)
    assert predicted_from(backlog, [0.002, 1e9, BACKLOG]) == [True, True, True]
    late = BACKLOG + 0.003
    assert predicted_from(backlog, 4 * [late]) == [False, True, False, True]
    assert predicted_from(backlog, 6 * [late + BACKLOG]) == 2 * [False, False, True]
    assert predicted_from(backlog, 4 * [0.04]) == [False, True, False, True]
    assert predicted_from(backlog, [FRESH, 0.04, 0.04]) == [True, True, True]


@pytest.mark.parametrize(('horizon', 'patience'), [(0.2, 0.1), (0.01, BACKLOG)])
def test_with_a_fixed_horizon_predictions_come_before_their_time(
    horizon: float, patience: float
) -> None:
    backlog = Backlog(build({'horizon': horizon}, 'test'))
    assert predicted_from(backlog, [0.0, *4 * [patience - 0.001]]) == 5 * [True]
    assert predicted_from(backlog, 4 * [patience + 0.001]) == [False, True, False, True]


def test_a_node_that_is_too_slow_for_all_predictions_still_makes_most() -> None:
    backlog, free, ages, made = Backlog(build({'horizon': 0.1}, 'test')), 0.0, [], 0
    for k in range(1000):  # frames each 10 ms, a step takes 5 ms and a prediction 6 ms
        free = max(free, 0.01 * k)
        ages.append(free - 0.01 * k)
        left_out = backlog.leaves_out(ages[-1])
        made += not left_out
        free += 0.005 if left_out else 0.011
    assert max(ages) < 0.06  # it would be a second with all of them
    assert made > 750


def test_a_lead_of_a_whole_frame_is_refused() -> None:
    values = {'horizon_mode': 'vsync', 'projector': {'fps': 100.0, 'lead': 0.01}}
    with pytest.raises(ConfigError, match=r'test: projector\.lead: 0\.01 s is not less than'):
        build(values, 'test')
    build(values | {'horizon_mode': 'fixed'}, 'test')
