"""What is shown of the predictions: which one serves, what is not safe, and how a hold ends."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cloth_predict.config import Config, ProjectorConfig
from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import SCANLINE, SURFACE, WARPED, encode_surface, fields_of
from cloth_predict.formats.prediction import (
    Prediction,
    UnsafeError,
    decode_prediction,
    encode_prediction,
)
from cloth_predict.projection.budget import FRAMES, STAGES, Budget
from cloth_predict.projection.frames import Frames, Shown
from cloth_predict.projection.guard import approached
from cloth_predict.projection.visibility import Flag
from cloth_predict.types import FloatArray, Surface

MS = 10**6
NOW = 1_790_000_000_000_000_000
CENTRE = np.array([0.255, 1.1, 0.0])  # 2.2 m before the projector of the defaults
GRID = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 4), np.linspace(0.2, -0.2, 5)), -1)
FLAT = CENTRE + np.column_stack([GRID.reshape(-1, 2), np.zeros(20)])
STEP = 1400 / 2.2  # px per metre across, at the focal length of the defaults


def config(**changes: object) -> Config:
    return Config(horizon_mode='vsync', projector=ProjectorConfig(**changes))  # type: ignore[arg-type]


def prediction(
    stamp: int = NOW, off: FloatArray | float = 0.0, speed: float = 0.0, sigma: float = 0.001
) -> Prediction:
    """A flat surface that is `off` [m] from the middle and moves across at `speed` [m/s]."""
    velocity = np.zeros((20, 3))
    velocity[:, 0] = speed
    covariance = np.broadcast_to(sigma**2 * np.eye(3), (20, 3, 3))
    surface = Surface(stamp, FLAT + off, velocity, np.zeros((20, 3)), covariance)
    return Prediction(surface, None, 0.05, 0.001, 0.004)


def across(metres: float) -> FloatArray:
    return np.array([metres, 0.0, 0.0])


def made(frames: Frames, start: int, one: Prediction, age: float = 0.0) -> Shown:
    shown = frames.make(start, one, age)
    assert shown is not None
    return shown


# --- which prediction serves


def test_a_prediction_before_the_frame_is_counted_and_not_kept() -> None:
    frames = Frames(config())
    assert not frames.offer(prediction(NOW - 1001), NOW)
    assert frames.offer(prediction(NOW - 1000), NOW)  # a microsecond is rounding
    assert frames.counts['late'] == 1


def test_the_newest_prediction_of_the_frame_itself_serves_it() -> None:
    frames = Frames(config())
    for stamp, off in ((NOW + 17 * MS, 0.01), (NOW, 0.02), (NOW, 0.03)):
        frames.offer(prediction(stamp, across(off)), NOW)
    chosen = frames.choose(NOW)
    assert chosen is not None
    np.testing.assert_array_equal(chosen.surface.position, FLAT + across(0.03))


def test_without_one_of_its_own_a_frame_is_made_of_the_last_one_moved_on() -> None:
    frames = Frames(config(motion='constant_velocity'))
    frames.offer(prediction(NOW, speed=1.0), NOW)
    for later in (0, 20, 40):
        chosen = frames.choose(NOW + later * MS)
        assert chosen is not None
        shown = made(frames, NOW + later * MS, chosen)
        dt = shown.vertices['dt'].ravel()
        expected = FLAT[:, 0] + 1e-3 * later + dt
        # float32 of positions below 1 m, and of a dt below 0.02 s at 1 m/s
        np.testing.assert_allclose(shown.vertices['x'].ravel(), expected, atol=1e-7)


def test_a_prediction_far_from_the_frame_does_not_serve() -> None:
    frames = Frames(config(max_age=0.1))
    frames.offer(prediction(NOW), NOW)
    assert frames.choose(NOW + 101 * MS) is None


# --- what is not safe


@pytest.mark.parametrize(
    ('one', 'age', 'words'),
    [
        (prediction(sigma=0.06), 0.0, 'sigma of vertex 0 is 60 mm, above projector.max_sigma'),
        (prediction(sigma=np.nan), 0.0, 'sigma of vertex 0 is nan mm'),
        (prediction(), 0.26, r'markers of the latest prediction are 0.26 s old'),
        (None, 0.0, 'no prediction serves the frame'),
        (prediction(speed=np.inf), 0.0, 'a vertex is not finite when it is drawn'),
    ],
)
@pytest.mark.parametrize('fallback', ['hold', 'blank'])
@pytest.mark.filterwarnings('ignore::RuntimeWarning')  # of an infinite speed
def test_what_is_not_safe_is_held_or_blanked(
    one: Prediction | None, age: float, words: str, fallback: str
) -> None:
    frames = Frames(config(fallback=fallback))
    assert frames.make(NOW, one, age) is None  # nothing was ever safe
    first = made(frames, NOW, prediction(off=across(0.1)))
    assert frames.flaw == ''
    shown = frames.make(NOW + 17 * MS, one, age)
    assert shown is not None
    assert words in frames.flaw
    assert shown.start == NOW + 17 * MS
    if fallback == 'hold':
        np.testing.assert_array_equal(shown.vertices, first.vertices)
        np.testing.assert_array_equal(shown.scanlines, first.scanlines)
    else:
        assert (shown.vertices.shape, shown.vertices.dtype) == ((1, 0), WARPED)
        assert (shown.scanlines.shape, shown.scanlines.dtype) == ((1, 0), SCANLINE)
    assert frames.counts == {'held' if fallback == 'hold' else 'blanked': 1}


def test_a_surface_outside_the_frame_gives_an_empty_message() -> None:
    frames = Frames(config())
    shown = made(frames, NOW, prediction(off=across(5.0)))
    assert shown.vertices.size == shown.scanlines.size == 0
    assert frames.empty
    assert frames.flags == {f.name.lower(): 20 * (f is Flag.OUTSIDE) for f in Flag if f.name}
    behind = made(frames, NOW + 1, prediction(off=np.array([0.0, 0.0, 3.0])))
    assert behind.vertices.size == 0
    assert frames.flags['behind'] == 20
    assert made(frames, NOW + 2, prediction()).vertices.shape == (5, 4)
    assert not frames.empty


# --- the end of a hold


def pixels(shown: Shown) -> FloatArray:
    return np.column_stack([shown.vertices[name].ravel() for name in 'uv']).astype(float)


@pytest.mark.parametrize('scan', ['progressive', 'interlaced', 'global'])
def test_after_a_hold_no_pixel_moves_faster_than_it_may(scan: str) -> None:
    frames = Frames(config(max_speed=1200.0, fps=60.0, scan=scan))
    before = pixels(made(frames, NOW, prediction()))
    made(frames, NOW + 17 * MS, prediction(sigma=1.0))
    goal = pixels(made(Frames(config(scan=scan)), NOW, prediction(off=across(0.1))))
    start, steps = NOW + 34 * MS, []
    for k in range(10):
        shown = made(frames, start + round(k * 1e9 / 60), prediction(off=across(0.1)))
        steps.append(np.hypot(*(pixels(shown) - before).T))
        before = pixels(shown)
        assert frames.catching_up == (k < 3)
        # the place and the time are those of the prediction
        np.testing.assert_allclose(shown.vertices['x'].ravel()[:20], FLAT[:, 0] + 0.1, atol=1e-7)
    # 0.1 m are 63.6 px: 20 px per frame and vertex, four times; float32 resolves 6e-5 px
    np.testing.assert_allclose(np.max(steps, axis=1)[:3], 20.0, atol=1e-3)
    assert np.max(steps, axis=1)[3] == pytest.approx(0.1 * STEP - 60.0, abs=1e-3)
    assert np.max(steps[4:]) == 0.0
    np.testing.assert_array_equal(before, goal)


def test_the_step_after_a_long_gap_is_that_of_one_frame() -> None:
    frames = Frames(config(max_speed=1200.0, fps=60.0))
    before = pixels(made(frames, NOW, prediction()))
    frames.fall_back(NOW + 17 * MS, 'no prediction')
    shown = made(frames, NOW + 10**10, prediction(off=across(0.1)))
    assert np.hypot(*(pixels(shown) - before).T).max() == pytest.approx(20.0, abs=1e-3)  # float32


def test_the_key_lines_come_back_with_their_vertices() -> None:
    frames = Frames(config())
    one = made(frames, NOW, prediction()).warped
    two = made(frames, NOW, prediction(off=across(0.1), speed=2.0)).warped
    assert one is not None
    assert two is not None
    shown, share = approached(one, two, 7.0)
    assert share < 1
    off = shown.drawn[0].pixels - two.drawn[0].pixels
    # the difference of two numbers of some 1000 px in double precision
    np.testing.assert_allclose(
        shown.keys[0].pixels - two.keys[0].pixels,
        np.broadcast_to(off, two.keys[0].pixels.shape),
        atol=1e-9,
    )


def test_a_vertex_from_behind_the_projector_moves_at_once_and_holds_nobody_up() -> None:
    away = np.zeros((20, 3))
    away[3, 2] = 3.0
    frames = Frames(config(max_speed=1e-3))
    shown = made(frames, NOW, prediction(off=away))
    assert np.isnan(pixels(shown)[3]).all()
    made(frames, NOW + MS, prediction(sigma=1.0))
    goal = pixels(made(Frames(config()), NOW, prediction(off=across(0.1))))
    shown = made(frames, NOW + 2 * MS, prediction(off=across(0.1)))
    moved = np.hypot(*(pixels(shown) - goal).T)
    assert moved[3] == 0
    assert moved[4] > 60  # of 63.6 px


def test_after_black_the_picture_is_there_at_once() -> None:
    frames = Frames(config(fallback='blank', max_speed=1.0))
    made(frames, NOW, prediction())
    frames.fall_back(NOW + 17 * MS, 'no prediction')
    goal = made(Frames(config()), NOW, prediction(off=across(0.1)))
    shown = made(frames, NOW + 34 * MS, prediction(off=across(0.1)))
    np.testing.assert_array_equal(shown.vertices, goal.vertices)


# --- the live message


def message(points: np.ndarray) -> SimpleNamespace:
    fields = [
        SimpleNamespace(name=n, offset=o, datatype=t, count=c)
        for n, o, t, c in fields_of(points.dtype)
    ]
    height, width = points.shape
    return SimpleNamespace(
        fields=fields, height=height, width=width, point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * width, is_bigendian=False, data=points.tobytes(),
    )  # fmt: skip


def test_a_prediction_comes_back_from_its_message() -> None:
    one = prediction(off=across(0.1), speed=2.0)
    end = replace(one.surface, position=FLAT + 1, velocity=FLAT + 2)
    one = replace(one, end=end, horizon=0.0625)
    points = encode_prediction(one, 5, 4)
    found = decode_prediction(message(points), NOW, (5, 4), 1 / 60)
    assert found.end is not None
    for given, back in ((one.surface, found.surface), (end, found.end)):
        np.testing.assert_allclose(back.position, given.position, atol=1e-7)  # float32 of 1 m
        np.testing.assert_allclose(back.velocity, given.velocity, atol=3e-7)  # of 3 m/s
    assert found.end.stamp == NOW + 16_666_667
    np.testing.assert_allclose(found.surface.sigma, 0.001, rtol=1e-6)  # float32
    assert found.capture == NOW - 62_500_000
    assert (found.received, found.filtered) == pytest.approx((0.001, 0.004))
    surface = encode_surface(one.surface, 5, 4)
    np.testing.assert_array_equal(points[list(SURFACE.names or ())], surface)


def test_a_prediction_of_the_surface_alone_is_read_as_well() -> None:
    points = encode_surface(prediction().surface, 5, 4)
    found = decode_prediction(message(points), NOW, (5, 4), 1 / 60)
    assert (found.end, found.capture) == (None, None)


@pytest.mark.parametrize('name', ['x', 'vy', 'az', 'vz_end'])
def test_a_number_that_is_not_finite_is_not_safe(name: str) -> None:
    one = prediction()
    points = encode_prediction(replace(one, end=one.surface), 5, 4)
    points[name][2, 3] = np.nan
    with pytest.raises(UnsafeError, match='not finite'):
        decode_prediction(message(points), NOW, (5, 4), 1 / 60)


def test_a_surface_of_another_form_is_refused() -> None:
    points = encode_prediction(prediction(), 5, 4)
    with pytest.raises(FrameError, match=r'a surface of \(4, 5\) nodes, expected \(5, 4\)'):
        decode_prediction(message(points.reshape(4, 5)), NOW, (5, 4), 1 / 60)
    with pytest.raises(FrameError, match="no field 'z'"):
        decode_prediction(message(points[['x', 'y']].copy()), NOW, (5, 4), 1 / 60)


# --- the budget


def test_the_stages_of_the_budget_add_up() -> None:
    rng, budget = np.random.default_rng(2), Budget()
    stages = rng.gamma(2.0, 0.005, (FRAMES, len(STAGES)))
    budget.add([9.0, 9.1, 9.2])  # another number of stages
    budget.add([0, 0, 0, 0, 0, np.nan])
    budget.add([0, 0, 1e9, 1e9, 1e9, 1e9])  # another clock
    assert set(budget.values().values()) == {'unknown'}
    for row in stages:
        budget.add([0.0, *np.cumsum(row)])
    found = budget.values()
    for k, name in enumerate([*STAGES, 'total']):
        values = stages[:, k] if name in STAGES else stages.sum(axis=1)
        for end, percent in (('ms', 50), ('p99_ms', 99)):
            expected = 1e3 * np.percentile(values, percent)
            assert float(found[f'{name}_{end}']) == pytest.approx(expected, abs=0.0051)  # rounded
