"""What compensation buys: beams followed in closed form, and what the recordings must reach."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import beginning
from scipy.interpolate import RegularGridInterpolator

from cloth_predict import cli
from cloth_predict.config import Config, build, load
from cloth_predict.errors import ConfigError, FormatError
from cloth_predict.evaluation import viewer
from cloth_predict.evaluation.beam import Path as Track
from cloth_predict.evaluation.beam import TrueSurface, nearest
from cloth_predict.evaluation.bootstrap import RESAMPLES, quantile_interval
from cloth_predict.evaluation.cases import case_of, labelled_case
from cloth_predict.evaluation.projection import METHODS, Compensation, light, project
from cloth_predict.evaluation.projection_methods import Known, knowledge, thesis_times
from cloth_predict.evaluation.projection_report import Misregistration, summary, text
from cloth_predict.formats.bag import Recording, Truth, write_recording
from cloth_predict.formats.recording import read
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.projection.scanout import row_times
from cloth_predict.projection.warp import Warper
from cloth_predict.simulation.recordings import simulate
from cloth_predict.surface.topology import grid_triangles
from cloth_predict.tracker import Tracker
from cloth_predict.types import FloatArray, IntArray, MarkerSequence, Surface

ROOT = Path(__file__).parents[1]
STEP = 10_000_000  # ns
MM = 1e3


# --- a path in time ----------------------------------------------------------------------------


def cubic(time: FloatArray) -> FloatArray:
    """Two points on polynomials of the third degree [m], shape (times, 2, 3)."""
    t = np.asarray(time)[:, None]
    one = (
        np.array([0.1, 1.0, -0.2]) + [1.0, 0.0, 0.5] * t + [0, 3.0, 0] * t**2 + [2.0, 0, 1] * t**3
    )
    return np.stack([one, one[:, ::-1] + 0.3], axis=1)


def sequence(stamps: IntArray, positions: FloatArray, hidden: Any = ()) -> MarkerSequence:
    visible = np.ones(positions.shape[:2], bool)
    for frame, marker in hidden:
        visible[frame, marker] = False
    positions = np.where(visible[..., None], positions, np.nan)
    return MarkerSequence(
        stamps, tuple(f'm{k}' for k in range(visible.shape[1])), positions, visible
    )


def test_a_path_is_cubic_between_its_frames_and_unknown_in_gaps() -> None:
    stamps = 5 * 10**18 + np.arange(20) * STEP
    stamps[15:] += 3 * STEP
    time = 1e-9 * (stamps - stamps[0])
    path = Track.of(sequence(stamps, cubic(time), [(4, 0), (10, 1), (11, 1)]))
    at = np.array([0.0, 0.0123, 0.033, 0.0371, 0.0449, 0.095, 0.105, 0.115, 0.15, time[-1]])
    found, exact = path.at(at), cubic(at)
    known = np.ones((10, 2), bool)
    known[2:5, 0] = False  # on each side of frame 4
    known[5:8, 1] = False  # round frames 10 and 11
    known[8] = False  # 0.04 s without a frame
    np.testing.assert_array_equal(np.isfinite(found).all(axis=2), known)
    # a spline through a cubic is that cubic; rounding of a linear system and 1 m
    np.testing.assert_allclose(found[known], exact[known], atol=1e-12)
    each = path.each(at[[1, 4]])
    np.testing.assert_allclose(each, found[[1, 4], [0, 1]], atol=1e-15)  # rounding
    assert np.isnan(path.each(np.array([-0.001, time[-1] + 0.001]))).all()
    assert np.isnan(path.each(np.array([np.nan, 0.0]))[0]).all()


# --- a ray and triangles -----------------------------------------------------------------------


def test_the_nearest_triangle_equals_linear_systems_one_by_one() -> None:
    rng = np.random.default_rng(1)
    corners = rng.uniform(-1, 1, (40, 12, 3, 3)) + np.array([0, 0, 3])
    direction = rng.normal(0, 0.3, (40, 3)) + np.array([0, 0, 1])
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    origin = np.array([0.1, -0.2, 0.3])
    expected = np.full(40, np.inf)
    for ray in range(40):
        for a, b, c in corners[ray]:
            # origin + t d = a + u (b - a) + v (c - a)
            t, u, v = np.linalg.solve(np.column_stack([direction[ray], a - b, a - c]), a - origin)
            if t > 0 and u >= 0 and v >= 0 and u + v <= 1:
                expected[ray] = min(expected[ray], t)
    assert 10 < np.isfinite(expected).sum() < 40
    # rounding, made larger by triangles that are seen edge-on
    np.testing.assert_allclose(nearest(origin, direction, corners), expected, rtol=1e-9)
    assert np.isinf(nearest(origin, direction, np.full_like(corners, np.nan))).all()


# --- a rigid board that moves at a constant velocity -------------------------------------------

SPEED, AWAY, FOCAL = 1.0, 2.0, 2000.0  # m/s, m, px


def board(**projector: Any) -> Config:
    """Five rows and four columns of vertices, 0.1 m apart, before a projector 2 m away."""
    values = {
        'width': 1920,
        'height': 1080,
        'alpha': FOCAL,
        'beta': FOCAL,
        'u0': 960.0,
        'v0': 540.0,
        'rotation': [1.0, 0, 0, 0, -1.0, 0, 0, 0, -1.0],
        'translation': [0.0, 0.0, AWAY],
        'motion': 'constant_velocity',
        **projector,
    }
    return build({'model': {'rows': 5, 'cols': 4}, 'projector': values}, 'test')


def vertices() -> FloatArray:
    """Positions [m] when the middle of the board is before the projector, shape (20, 3)."""
    y, x = np.meshgrid([0.2, 0.1, 0.0, -0.1, -0.2], [-0.15, -0.05, 0.05, 0.15], indexing='ij')
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def crossing(
    config: Config, velocity: Any = (SPEED, 0.0, 0.0), late: float = 0.05, others: Any = ()
) -> Compensation:
    """Frames at which the board passes the projector, lit with what is exactly known of it."""
    velocity = np.array(velocity, float)
    stamps = np.arange(201) * STEP
    time = 1e-9 * stamps - 1.0
    rows, cols = 9, 8  # a mesh that reaches beyond the vertices, so that no light misses it
    y, x = np.meshgrid(np.linspace(0.8, -0.8, rows), np.linspace(-0.8, 0.8, cols), indexing='ij')
    mesh = np.stack([x, y, np.zeros_like(x)], axis=-1)
    carried = velocity * time[:, None]
    moving = sequence(stamps, vertices() + carried[:, None])
    case = labelled_case(moving, config, 'board')
    truth = Truth(stamps, mesh + carried[:, None, None], np.full((rows, cols), -1))
    surface = TrueSurface.of(case, truth, grid_triangles(5, 4))
    starts = np.array([990_000_000, 1_000_000_000])
    known = []
    for start in starts.tolist():
        there = vertices() + velocity * (1e-9 * start - 1.0)
        still = np.zeros_like(there)
        seen = Surface(start, there, still + velocity, still, np.zeros((20, 3, 3)))
        known.append(Known(start - round(late * 1e9), there - velocity * late, seen, None))
    return light('board', [*known, *others], starts, surface, config, late)


def lines(config: Config) -> FloatArray:
    """Line on which each vertex is [px] at the second frame's start, shape (20,)."""
    return 540.0 - FOCAL * vertices()[:, 1] / AWAY


@pytest.mark.parametrize('fps', [24.0, 60.0])
def test_errors_of_a_board_that_crosses_the_view(fps: float) -> None:
    config = board(fps=fps)
    found = crossing(config)
    drawn = lines(config) / (1080 * fps)  # s; motion across the lines does not change them
    rows = np.repeat(row_times(5, fps), 4)
    assert found.judged.all()
    assert not found.missed.any()
    expected = {
        'none': SPEED * (0.05 + drawn),
        'frame': SPEED * drawn,
        'rows': SPEED * np.abs(drawn - rows),
        'full': 0.0 * drawn,
    }
    for name, error in expected.items():
        k = METHODS.index(name)
        # m; the iteration to the draw time ends within 1e-3 lines, here 4e-8 s
        np.testing.assert_allclose(found.error[k, 1, 0], error, atol=1e-7)
        np.testing.assert_allclose(found.error_px[k, 1, 0], error * FOCAL / AWAY, atol=1e-4)
    np.testing.assert_allclose(found.dt[1, 0], drawn, atol=1e-9)  # s; where its iteration ends
    # the board does not fill the frame, 680 px of 1080: the thesis' times are off by that
    share = np.abs(drawn - rows).max() * fps
    assert share == pytest.approx(340 / 1080, abs=1e-9)  # rounding
    np.testing.assert_array_equal(found.age, 0.05)


@pytest.mark.parametrize(('direction', 'way'), [('down', 1), ('up', -1)])
def test_errors_of_a_board_that_moves_along_the_scan(direction: str, way: int) -> None:
    config = board(direction=direction)
    found = crossing(config, velocity=(0.0, -SPEED, 0.0))
    begin = lines(config) if way > 0 else 1079 - lines(config)
    beam = 1080 * 60.0  # lines/s
    running = way * SPEED * FOCAL / AWAY  # lines/s, along the beam
    # line + running t = beam t
    meet = begin / (beam - running)
    np.testing.assert_allclose(found.dt[1, 0], meet, atol=2e-9)  # s; where the iteration ends
    # still for a frame: its line stays, and the board is gone on when it is lit
    np.testing.assert_allclose(found.error[1, 1, 0], SPEED * begin / beam, atol=1e-12)  # rounding
    np.testing.assert_allclose(found.error[3], 0, atol=1e-7)  # m; 1e-3 lines are 2e-8 s


@pytest.mark.parametrize(
    ('scan', 'begins'),
    [
        ('interlaced', [0.0, 1 / 120]),
        ('colour_sequential', [1 / 360, 3 / 360, 5 / 360]),  # the middle of each third
        ('global', [1 / 120]),
    ],
)
def test_errors_of_each_field(scan: str, begins: list[float]) -> None:
    config = board(scan=scan)
    found = crossing(config)
    place = (lines(config) - np.arange(len(begins))[:, None]) / (1080 * 120)
    expected = np.array(begins)[:, None] + (place if scan == 'interlaced' else np.zeros(20))
    np.testing.assert_allclose(found.error[1, 1], SPEED * expected, atol=1e-12)  # rounding
    np.testing.assert_allclose(found.error[3], 0, atol=1e-7)  # m; 1e-3 lines are 8e-9 s
    told = summary(found)['methods']['frame']
    if len(begins) > 1:
        p95 = [MM * SPEED * np.percentile(np.tile(one, 2), 95) for one in expected]
        fields = [one['p95_mm'] for one in told['fields']]
        np.testing.assert_allclose(fields, p95, rtol=1e-9)  # rounding
        assert text(found).count('\n') == 3 + 4 * (1 + len(begins))
    else:
        assert 'fields' not in told


def test_what_the_beam_does_not_meet_is_not_judged() -> None:
    # at the second frame two columns are beyond the right edge of a frame of 960 + 2 px; the first
    # frame begins 10 ms earlier, and the board is drawn for as long as 14 ms
    config = board(width=1062, fps=60.0)
    found = crossing(config, velocity=(0.1, 0, 0))
    at_draw = vertices()[:, 0] + 0.1 * found.dt[1, 0]
    inside = 960 + FOCAL * at_draw / AWAY < 1061.5
    np.testing.assert_array_equal(found.judged[1, 0], inside)
    assert inside.sum() == 15
    assert found.missed.sum() == 0
    told = summary(found)
    assert told['in_view'] == pytest.approx(found.judged.mean(), abs=1e-15)  # rounding
    assert 'of the vertices were in view' in text(found)


def test_a_vertex_behind_the_surface_is_not_judged() -> None:
    config = board()
    stamps = np.arange(201) * STEP
    flat = vertices()
    flat[:8, 2] = -0.3  # two rows of vertices are behind the rest, and a square before some
    moving = sequence(stamps, np.repeat(flat[None], 201, axis=0))
    screen = np.array([[[-0.5, 0.5], [0.0, 0.5]], [[-0.5, 0.02], [0.0, 0.02]]])
    screen = np.append(screen, np.full((2, 2, 1), 0.1), axis=2)
    truth = Truth(stamps, np.repeat(screen[None], 201, axis=0), np.full((2, 2), -1))
    surface = TrueSurface.of(labelled_case(moving, config, 'x'), truth, grid_triangles(5, 4))
    pinhole = Pinhole.from_config(config.projector)
    scan = Scan.of(config.projector, 1920, 1080)
    drawn = surface.drawn(1.0, pinhole, scan, 0)
    # hidden is what is seen through the square: its shadow on the plane of the vertex
    scale = (AWAY - flat[:, 2]) / (AWAY - 0.1)
    x, y = flat[:, 0] / scale, flat[:, 1] / scale
    hidden = (x > -0.5) & (x < 0.0) & (y > 0.02) & (y < 0.5)
    np.testing.assert_array_equal(drawn.visible, ~hidden)
    assert hidden.sum() == 4


def test_light_beside_the_surface_is_as_far_as_its_ray() -> None:
    config = board(direction='right')
    stamps = np.arange(201) * STEP
    moving = sequence(stamps, np.repeat(vertices()[None], 201, axis=0))
    surface = TrueSurface.of(labelled_case(moving, config, 'x'), None, np.zeros((0, 3), int))
    pinhole = Pinhole.from_config(config.projector)
    pixels = pinhole.project(vertices()) + np.array([30.0, 40.0])
    error, px, missed = surface.landing(np.full(20, 1.0), pixels, np.arange(20), pinhole)
    origin, ray = pinhole.rays(pixels)
    way = vertices() - origin
    expected = np.sqrt((way**2).sum(axis=1) - (way * ray).sum(axis=1) ** 2)
    np.testing.assert_allclose(error, expected, atol=1e-8)  # m; root of a difference
    np.testing.assert_allclose(px, 50, atol=1e-9)  # px; rounding
    assert missed.all()


def test_a_frame_without_a_prediction_counts_for_nobody() -> None:
    config = board()
    one = crossing(config)
    known = [one.known[0], replace(one.known[1], surface=None)]
    found = light('board', known, one.starts, one.surface, config, 0.05)
    assert (len(found.starts), found.asked) == (1, 2)
    np.testing.assert_array_equal(found.error, one.error[:, :1])
    assert summary(found)['predicted'] == 0.5
    assert '1 of 2 frames had a prediction' in text(found)
    with pytest.raises(FormatError, match='board: there is a prediction for none of its 1 frames'):
        light('board', known[1:], one.starts[1:], one.surface, config, 0.05)


def test_rows_are_in_the_order_in_which_the_beam_meets_them() -> None:
    config = board()
    pixels = Pinhole.from_config(config.projector).project(vertices())
    scans = {
        way: Scan('progressive', way, 1920, 1080, 10.0) for way in ('down', 'up', 'right', 'left')
    }
    rows, cols = row_times(5, 10.0), row_times(4, 10.0)
    for way, expected in {
        'down': np.repeat(rows, 4),
        'up': np.repeat(rows[::-1], 4),
        'right': np.tile(cols, 5),
        'left': np.tile(cols[::-1], 5),
    }.items():
        np.testing.assert_array_equal(thesis_times(config.model, pixels, scans[way]), expected)
    # what is no grid fills the frame: its lines from 340 to 740 px, as much of 0.1 s
    mesh = replace(config.model, topology='delaunay', nodes=20)
    found = thesis_times(mesh, pixels, scans['down'])
    np.testing.assert_allclose(found, 0.1 * (pixels[:, 1] - 340) / 400, atol=1e-15)  # rounding


def test_what_is_known_when_a_frame_is_made() -> None:
    config, markers = swinging('implicit_euler')
    config = replace(config, projector=replace(config.projector, motion='model'))
    hidden = np.array(markers.visible)
    hidden[93:, 8] = False
    markers = replace(markers, visible=hidden)
    case = labelled_case(markers, config, 'x')
    starts = np.array([1_003_000_000, 1_103_000_000])
    known = list(knowledge(Tracker(config), case, starts, 0.05, lambda frames: None))
    tracker = Tracker(config)
    for k in range(96):  # 0.953 s are 95.3 frames
        tracker.step(k * STEP, markers.positions[k], markers.visible[k])
    assert known[0].stamp == 950_000_000
    ahead, after = tracker.predict(0.053), tracker.predict(0.153)
    for found, expected in ((known[0].surface, ahead), (known[0].end, after)):
        assert found.stamp == expected.stamp
        np.testing.assert_array_equal(found.position, expected.position)
    assert ahead.stamp == 1_003_000_000
    np.testing.assert_array_equal(known[0].seen[:8], markers.positions[95, :8])
    np.testing.assert_array_equal(known[0].seen[8], markers.positions[92, 8])
    assert known[1].stamp == 1_050_000_000
    # nothing is known of a surface that has not begun
    late = list(knowledge(Tracker(config), case, starts, 1.2, lambda frames: None))
    assert [one.surface for one in late] == [None, None]


# --- the checks of the thesis ------------------------------------------------------------------


def swinging(integrator: str) -> tuple[Config, MarkerSequence]:
    """A cloth of 3 x 3 nodes that falls and swings, predicted by one step of 0.1 s."""
    config = build(
        {
            'model': {'rows': 3, 'cols': 3, 'width': 0.2, 'height': 0.2, 'mass': 0.1,
                      'stiffness_structural': 5.0, 'stiffness_shear': 1.0,
                      'stiffness_flexion': 1.0},
            'anchors': {'nodes': [0, 1, 2]},
            'filter': {'integrator': integrator, 'predict_step': 0.1},
            'limits': {'sigma_error': 10.0},
            'projector': {'fps': 10.0, 'translation': [-0.1, 0.1, 2.0]},
        },
        'x',
    )  # fmt: skip
    stamps = np.arange(131) * STEP
    angle = 0.4 * np.sin(4 * 1e-9 * stamps)[:, None, None]
    down = np.repeat([0.0, 0.1, 0.2], 3)[None, :, None]
    across = np.tile([0.0, 0.1, 0.2], 3)[None, :, None] + 0 * angle
    parts = [across, -down * np.cos(angle), down * np.sin(angle)]
    return config, sequence(stamps, np.concatenate(parts, axis=2))


@pytest.mark.parametrize('integrator', ['euler', 'implicit_euler'])
def test_the_first_row_is_the_estimate_and_the_last_the_next_prediction(integrator: str) -> None:
    config, markers = swinging(integrator)
    found = project(labelled_case(markers, config, 'x'), None, config, 0.0)
    assert len(found.starts) == 3
    tracker = Tracker(config)
    for k in range(101):
        tracker.step(k * STEP, markers.positions[k], markers.visible[k])
    estimate, ahead = tracker.estimate(), tracker.predict(0.1)
    rows = found.shown(0).position[METHODS.index('rows'), 0]
    np.testing.assert_array_equal(rows[:3], estimate.position[:3])
    # a row in the middle is half of the way to the end of the frame
    half = estimate.position[3:6] + 0.05 * estimate.velocity[3:6]
    np.testing.assert_allclose(rows[3:6], half, atol=1e-15)  # rounding
    step = 0.1 * (ahead.velocity - estimate.velocity)[6:]
    assert np.abs(step).max() > 1e-3  # m; the velocity does change
    if integrator == 'euler':  # x + dt f(x): the velocity before the step
        step[:] = 0
    np.testing.assert_allclose(rows[6:] + step, ahead.position[6:], atol=1e-14)  # rounding


# --- intervals ---------------------------------------------------------------------------------


def test_the_interval_of_a_quantile_equals_drawing_block_by_block() -> None:
    rng = np.random.default_rng(3)
    parts = [(rng.exponential(1.0, (53, 4)), 5), (rng.exponential(2.0, (31, 4)), 6)]
    parts[0][0][7], parts[0][0][9, 1] = np.nan, np.nan
    drawn, own = [], np.random.default_rng(5)
    for errors, block in parts:
        kept = errors[np.isfinite(errors).any(axis=1)]
        blocks = -(-len(kept) // block)
        starts = own.integers(len(kept), size=(RESAMPLES, blocks))
        around = np.concatenate([kept, kept])
        runs = [[around[a : a + block] for a in row] for row in starts]
        drawn.append([np.concatenate(run)[: len(kept)].ravel() for run in runs])
    both = [np.concatenate(pair) for pair in zip(*drawn, strict=True)]
    values = [np.quantile(v[np.isfinite(v)], 0.95, method='inverted_cdf') for v in both]
    expected = np.percentile(values, [2.5, 97.5])
    found = quantile_interval(parts, 0.95, np.random.default_rng(5))
    np.testing.assert_array_equal(found, expected)
    short = [(np.ones((24, 2)), 5)]
    assert np.isnan(quantile_interval(short, 0.95, np.random.default_rng(5))).all()


def test_numbers_of_known_errors() -> None:
    config = board()
    found = crossing(config)
    error = np.linspace(0.0, 3.8e-3, 40).reshape(2, 1, 20)
    found = replace(found, error=np.broadcast_to(error, (4, 2, 1, 20)))
    told = Misregistration.of(found, 'full')
    assert told.max_mm == pytest.approx(3.8, rel=1e-12)  # rounding
    assert told.p50_mm == pytest.approx(1.9, rel=1e-12)  # rounding
    assert told.p95_mm == pytest.approx(0.95 * 3.8, rel=1e-12)  # rounding
    assert (told.under_jnd, told.count) == (0.5, 40)
    none = Misregistration.of(found, 'full', np.zeros(20, bool))
    assert none.count == 0
    assert np.isnan(none.p95_mm)


# --- the picture -------------------------------------------------------------------------------


@pytest.mark.parametrize(('direction', 'dense'), [('down', False), ('left', True)])
def test_the_viewer_sees_the_picture_where_it_belongs(direction: str, dense: bool) -> None:
    config = board(direction=direction)
    stamps = np.arange(201) * STEP
    carried = np.outer(1e-9 * stamps - 1.0, [SPEED, 0.0, 0.0])[:, None]
    moving = sequence(stamps, vertices() + carried)
    mesh = finer_grid(9, 7).reshape(-1, 3) + carried
    ids = np.full(63, -1)
    ids[[0, -1]] = 0, 19
    truth = Truth(stamps, mesh.reshape(201, 9, 7, 3), ids.reshape(9, 7)) if dense else None
    case = labelled_case(moving, config, 'x')
    surface = TrueSurface.of(case, truth, grid_triangles(5, 4))
    one = crossing(config)
    found = light('x', one.known, one.starts, surface, config, 0.05)
    warper = Warper.of(config, vertices())
    lit = viewer.lit_points(found, 1, warper.skin.texture)
    inner = (np.abs(lit.texture - 0.5) < 0.45).all(axis=1)
    right = viewer.looked_up(viewer.framebuffer(found, 1, 'full', warper), lit.pixels)
    # the board is 300 x 400 px: 0.1 px of the key lines and float32
    np.testing.assert_allclose(right[inner], lit.texture[inner], atol=5e-4)
    wrong = viewer.looked_up(viewer.framebuffer(found, 1, 'frame', warper), lit.pixels)
    dt = found.scan.times(lit.pixels, 0)
    late = (lit.texture[:, 0] + SPEED * dt / 0.3)[inner]  # the board is 0.3 m wide
    seen = late < 1
    # as above
    np.testing.assert_allclose(wrong[inner][seen, 0], late[seen], atol=5e-4)


def test_errors_between_the_vertices_of_a_board_and_of_a_bent_one() -> None:
    config = board()
    one = crossing(config)
    stamps = np.arange(201) * STEP
    time = 1e-9 * stamps - 1.0
    fine = finer_grid(9, 7)
    ids = np.full((9, 7), -1)
    ids[::2, ::2] = np.arange(20).reshape(5, 4)
    carried = np.outer(time, [SPEED, 0.0, 0.0])[:, None]
    case = labelled_case(sequence(stamps, vertices() + carried), config, 'x')
    for bent in (0.0, 0.01):
        mesh = fine.copy()
        mesh[1::2, :, 2] += bent  # rows that no marker is on stand out
        truth = Truth(stamps, (mesh.reshape(-1, 3) + carried).reshape(201, 9, 7, 3), ids)
        surface = TrueSurface.of(case, truth, grid_triangles(5, 4))
        assert surface.grid == (9, 7)
        found = light('x', one.known, one.starts, surface, config, 0.05).between
        assert found is not None
        assert found.shape == (4, 2, 63)
        y = (540.0 - FOCAL * mesh[..., 1] / (AWAY - mesh[..., 2])) / (1080 * 60)
        drawn = np.asarray(y).ravel()
        inner = mesh[..., 0].ravel() < 0.12  # elsewhere the board has left what is drawn
        if not bent:
            np.testing.assert_allclose(found[3, 1], 0, atol=1e-7)  # m; 1e-3 lines are 2e-8 s
            error = SPEED * drawn
            np.testing.assert_allclose(found[1, 1, inner], error[inner], atol=1e-12)  # rounding
        else:
            # a node gets what is drawn for the place of the flat board behind it, which belongs
            # to another place of the bent one
            way = (AWAY / (AWAY - mesh[..., 2]))[..., None]
            flat = (mesh[..., :2] * way).reshape(-1, 2)
            flat[:, 0] += SPEED * drawn * (way.ravel() - 1)  # and where it has moved by then
            rows, cols = fine[::-1, 0, 1], fine[0, :, 0]
            known = RegularGridInterpolator((rows, cols), mesh[::-1], bounds_error=False)
            expected = np.linalg.norm(known(flat[:, ::-1]) - mesh.reshape(-1, 3), axis=1)
            lit = np.isfinite(expected + found[3, 1])
            assert lit.sum() >= 43  # the nodes that stand out at the edges get no light
            assert expected[lit].max() > 8e-4  # m
            np.testing.assert_allclose(found[3, 1, lit], expected[lit], atol=2e-7)  # m; as above
    assert summary(crossing(board()))['methods']['full']['surface']['p95_mm'] is None


def finer_grid(rows: int, cols: int) -> FloatArray:
    """Positions [m] of a finer mesh of the board, shape (rows, cols, 3)."""
    y, x = np.meshgrid(np.linspace(0.2, -0.2, rows), np.linspace(-0.15, 0.15, cols), indexing='ij')
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


# --- recordings --------------------------------------------------------------------------------


def test_the_beginning_of_the_shipped_recording_by_the_command(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    bag, config, out = tmp_path / 'bag', ROOT / 'config/towel.yaml', tmp_path / 'out'
    write_recording(bag, beginning(361))  # intervals need 2.5 s after the warm-up
    arguments = ['project', bag, '-c', config, '--json', '-o', out]
    assert cli.main([str(argument) for argument in arguments]) == 0
    told = json.loads(capsys.readouterr().out)
    assert set(told['methods']) == set(METHODS)
    assert (told['fps'], told['delay_s'], told['frames']) == (60.0, 0.05, 156)
    assert told['age_s'] == pytest.approx(0.0533, abs=1e-4)  # the markers come every 10 ms
    assert (told['predicted'], told['in_view']) == (1.0, 1.0)
    p95 = {name: told['methods'][name]['p95_mm'] for name in METHODS}
    assert p95['full'] <= 0.35 * p95['none']  # 0.15
    assert p95['full'] < p95['frame'] < p95['none']
    for method in told['methods'].values():
        assert method['p95_95_mm'][0] < method['p95_mm'] < method['p95_95_mm'][1]
        assert method['free']['p95_mm'] > method['p95_mm']  # the bar stands still
        assert method['free']['count'] == 0.8 * method['count']
    names = {'config.yaml', 'table.txt', 'projection.json', 'rows.png', 'errors.png', 'viewer.png'}
    assert {path.name for path in out.iterdir()} == names
    assert json.loads((out / 'projection.json').read_text()) == told
    assert load(out / 'config.yaml') == load(config)


@pytest.fixture(scope='module')
def crossed() -> Recording:
    return simulate('crossing', 1, 2.0, lambda seconds: None)


@pytest.mark.parametrize('fps', [24.0, 60.0])
def test_a_towel_that_crosses_the_view(crossed: Recording, fps: float) -> None:
    config = load(ROOT / 'config/crossing.yaml')
    config = replace(config, projector=replace(config.projector, fps=fps))
    found = project(case_of(crossed, config, 'crossing'), crossed.truth, config, 0.05)
    p95 = {name: Misregistration.of(found, name).p95_mm for name in METHODS}
    assert p95['rows'] <= 0.6 * p95['frame']  # 0.1 and 0.2
    assert p95['full'] <= 0.6 * p95['frame']


@pytest.mark.parametrize('take', [4, 5, 6])
def test_the_rows_of_a_real_rope(real: Any, take: int) -> None:
    config = load(ROOT / 'config/rope.yaml')
    recording = read(real(f'rope/rope_take{take}.csv'))
    found = project(case_of(recording, config, 'rope'), None, config, 0.0)
    assert (found.scan.fps, found.scan.direction) == (10.0, 'right')
    assert found.judged.all()
    p95 = {name: Misregistration.of(found, name).p95_mm for name in METHODS}
    assert p95['rows'] < 0.7 * p95['none']  # 0.55, 0.45 and 0.61
    assert p95['full'] < 0.2 * p95['none']  # 0.09, 0.16 and 0.12
    p50 = {name: Misregistration.of(found, name).p50_mm for name in METHODS}
    assert p50['rows'] < p50['none']


# --- errors ------------------------------------------------------------------------------------


def test_what_cannot_be_judged_is_an_error() -> None:
    config = board()
    stamps = np.arange(102) * STEP
    still = sequence(stamps, np.repeat(vertices()[None], 102, axis=0))
    case = labelled_case(still, config, 'take')
    with pytest.raises(FormatError, match=r'take: no frame .* lasts 1\.01 s, .* takes 0\.0167 s'):
        project(case, None, config, 0.05)
    with pytest.raises(ConfigError, match=r'the delay is -0\.1 s'):
        project(case, None, config, -0.1)
    away = board(translation=[5.0, 0.0, 2.0])
    one = crossing(board())
    with pytest.raises(FormatError, match=r'board: the surface is outside .* projector\.rotation'):
        light('board', one.known, one.starts, one.surface, away, 0.05)


@pytest.mark.parametrize(
    'line', ['--fps 0', '--fps -1', '--fps 1e9', '--fps nan', '--delay -0.1', '--delay inf', 'x']
)
def test_wrong_usage(capsys: pytest.CaptureFixture[str], line: str) -> None:
    with pytest.raises(SystemExit, match='2'):
        cli.main(['project', 'x', '-c', 'x', *line.split()])
    out, err = capsys.readouterr()
    assert out == ''
    assert 'error: ' in err.splitlines()[-1]


def test_a_surface_outside_the_view_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, parameters: Any
) -> None:
    stamps = np.arange(120) * STEP
    still = sequence(stamps, np.repeat(vertices()[None], 120, axis=0))
    write_recording(tmp_path / 'bag', Recording(still))
    model = {'rows': 5, 'cols': 4, 'rest_length': 'measured', 'gravity': [0, 0, 0]}
    path = parameters(model=model, projector={'translation': [0.0, 0.0, -2.0]})
    assert cli.main(['project', str(tmp_path / 'bag'), '-c', str(path)]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f'cloth-predict: {tmp_path / "bag"}: the surface is outside the frame')
    assert line.count('\n') == 1
