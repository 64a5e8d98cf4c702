"""Draw times against closed forms and a beam that is followed line by line; key lines likewise."""

import numpy as np
import pytest

from cloth_predict.config import ProjectorConfig
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.scan import Scan
from cloth_predict.projection.scanout import draw, key_rows, row_times
from cloth_predict.types import Surface

FRAME = {'width': 1920, 'height': 1080, 'u0': 960.0, 'v0': 540.0}
# 2 m from it a pixel is 1 mm: x goes to the right and y down, as pixels do
BEFORE = {'rotation': tuple(np.eye(3).ravel()), 'translation': (0.0, 0.0, 2.0)}
DEVICE = {**FRAME, **BEFORE, 'alpha': 2000.0, 'beta': 2000.0}
LENS = (-0.12, 0.05, 0.002, -0.001, 0.01)


def projector(**changes):
    config = ProjectorConfig(**{**DEVICE, **changes})
    pinhole = Pinhole.from_config(config)
    return pinhole, Scan.of(config, pinhole.width, pinhole.height)


def some(seed, nodes=40, speed=3.0, acceleration=60.0):
    """Vertices all over the frame in fast motion of any direction."""
    rng = np.random.default_rng(seed)
    position = rng.uniform([-0.9, -0.5, -0.2], [0.9, 0.5, 0.2], (nodes, 3))
    return Motion.constant_acceleration(
        position,
        rng.normal(0, speed, (nodes, 3)),
        rng.normal(0, acceleration, (nodes, 3)),
    )


# --- the scheme of the paper


def test_row_times_of_the_paper():
    # section 6.5: 5 rows at 24 fps, eq. 6.22: 1 / (24 x 4) s per row
    times = row_times(5, 24.0)
    np.testing.assert_allclose(times, [0, 0.0104, 0.0208, 0.03125, 0.0417], atol=5e-5)  # 4 digits
    np.testing.assert_allclose(np.diff(times), 1 / 96, rtol=1e-14)  # rounding
    # at 10 fps the last row is drawn when the next frame of the filter comes, 0.1 s later
    assert row_times(5, 10.0)[-1] == pytest.approx(0.1, rel=1e-15)  # rounding
    assert row_times(1, 60.0).tolist() == [0.0]


# --- motion


def test_a_motion_is_its_polynomial():
    rng = np.random.default_rng(2)
    p, v, a = rng.normal(size=(3, 5, 3))
    dt = rng.uniform(0, 0.1, 5)
    motions = {
        'constant_velocity': p + v * dt[:, None],
        'constant_acceleration': p + v * dt[:, None] + a * dt[:, None] ** 2 / 2,
    }
    surface = Surface(0, p, v, a, np.zeros((5, 3, 3)))
    for kind, expected in motions.items():
        np.testing.assert_allclose(Motion.of(kind, surface).at(dt), expected, rtol=1e-14)
    still = Motion.still(p)
    np.testing.assert_array_equal(still.at(dt), p)
    assert still.at(dt[:, None]).shape == (5, 5, 3)


def test_the_model_goes_through_both_ends():
    rng = np.random.default_rng(3)
    p, v, q, w = rng.normal(size=(4, 5, 3))
    begin = Surface(10**9, p, v, np.zeros((5, 3)), np.zeros((5, 3, 3)))
    end = Surface(10**9 + 40_000_000, q, w, np.zeros((5, 3)), np.zeros((5, 3, 3)))
    motion, eps = Motion.of('model', begin, end), 1e-6
    for at, position, velocity in ((0.0, p, v), (0.04, q, w)):
        np.testing.assert_allclose(motion.at(at), position, rtol=1e-12, atol=1e-12)  # rounding
        slope = (motion.at(at + eps) - motion.at(at - eps)) / (2 * eps)
        # central difference: rounding of 1e-16 / 1e-6, and eps^2 times the third derivative
        np.testing.assert_allclose(slope, velocity, atol=1e-6)


def test_a_motion_from_a_later_start_is_the_same():
    rng = np.random.default_rng(4)
    motion = Motion(rng.normal(size=(4, 6, 3)))
    dt = rng.uniform(-1, 1, 6)
    np.testing.assert_allclose(motion.shifted(0.3).at(dt), motion.at(dt + 0.3), rtol=1e-12)


# --- draw times


@pytest.mark.parametrize('speed', [-1.0, 0.0, 1.0, 20.0, -200.0])
def test_the_draw_time_of_a_uniform_motion_is_its_closed_form(speed):
    """Line v + s t is lit at t = line_time (v + s t): t = line_time v / (1 - line_time s)."""
    pinhole, scan = projector()
    position = np.array([[0.1, y, 0.0] for y in (-0.5, -0.2, 0.0, 0.1)])
    velocity = np.full((4, 3), [0.5, speed, 0.0])
    found = draw(Motion.constant_velocity(position, velocity), pinhole, scan)
    line = 540 + 1000 * position[:, 1]
    expected = scan.line_time * line / (1 - scan.line_time * 1000 * speed)
    # the search ends within 1e-3 lines
    np.testing.assert_allclose(found.dt, expected, atol=1e-3 * scan.line_time)
    assert found.converged.all()
    np.testing.assert_allclose(found.position, position + velocity * found.dt[:, None], atol=1e-12)
    np.testing.assert_allclose(found.pixels, pinhole.project(found.position), atol=1e-9)


def test_a_surface_faster_than_the_beam_does_not_converge():
    pinhole, scan = projector()
    beam = 1e-3 / scan.line_time  # m/s: a line is 1 mm here, 64.8 m/s
    share = np.array([1.05, 0.95, 0.7, 0.4])
    position = np.tile([0.0, 0.1, 0.0], (4, 1))
    velocity = np.outer(share, [0.0, beam, 0.0])
    found = draw(Motion.constant_velocity(position, velocity), pinhole, scan)
    # line 640 is 640 / (1 - share) when the beam meets it: never, or 12 frames on
    assert found.converged.tolist() == [False, False, True, True]
    # drawn with the line on which it is at the start
    np.testing.assert_allclose(found.dt[:2], 640 * scan.line_time, rtol=1e-12)  # rounding
    assert found.dt[2] == scan.ends(0)  # met below the frame: with its last line
    assert found.dt[3] == pytest.approx(640 / 0.6 * scan.line_time, rel=1e-6)  # 1e-3 of 1067 lines


@pytest.mark.parametrize('mode', ['progressive', 'interlaced'])
@pytest.mark.parametrize('direction', ['down', 'up', 'right', 'left'])
@pytest.mark.parametrize('distortion', [(), LENS])
def test_the_beam_meets_each_vertex_where_it_is_drawn(mode, direction, distortion):
    """Follow the beam line by line: it passes each vertex between two lines, once."""
    pinhole, scan = projector(scan=mode, direction=direction, distortion=distortion, fps=24.0)
    motion = some(5)
    for field in range(scan.fields):
        found = draw(motion, pinhole, scan, field)
        assert found.converged.all()
        lines = np.arange(scan.lines)
        times = scan.line_times(lines, field)
        ahead = scan.along(pinhole.project(motion.at(times[:, None]))) - lines[:, None]
        passed = (ahead[:-1] > 0) & (ahead[1:] <= 0)
        met = passed.sum(axis=0) == 1
        assert met.sum() > 25  # the others leave the frame
        before = times[passed.argmax(axis=0)]
        late = (found.dt - before)[met] / scan.line_time
        # within the step from the line before to the one after it
        assert (late >= -1e-3).all()
        assert (late <= 1 + 1e-3).all()


@pytest.mark.parametrize('mode', ['global', 'colour_sequential'])
def test_an_instant_draws_all_at_once(mode):
    pinhole, scan = projector(scan=mode)
    motion = some(6)
    for field in range(scan.fields):
        found = draw(motion, pinhole, scan, field)
        assert (found.dt == scan.begins(field)).all()
        np.testing.assert_array_equal(found.position, motion.at(scan.begins(field)))


def test_what_is_behind_the_projector_has_no_pixel():
    pinhole, scan = projector()
    position = np.array([[0.0, 0.0, -3.0], [0.0, 0.1, 0.0]])
    found = draw(Motion.constant_velocity(position, np.ones((2, 3))), pinhole, scan)
    assert np.isnan(found.pixels[0]).all()
    assert found.dt[0] == 0.0
    assert found.dt[1] == pytest.approx(640 * scan.line_time, rel=0.05)  # it moves a little
    assert np.isfinite(found.pixels[1]).all()


# --- key lines


@pytest.mark.parametrize('bound', [1.0, 0.1, 0.01])
@pytest.mark.parametrize(
    'changes',
    [
        {'fps': 60.0},
        {'fps': 10.0},
        {'fps': 24.0, 'direction': 'left'},
        {'fps': 24.0, 'scan': 'interlaced', 'distortion': LENS},
    ],
)
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_no_line_between_key_lines_errs_by_more_than_the_bound(bound, changes, seed):
    """All lines by brute force: those between two key lines by linear interpolation."""
    pinhole, scan = projector(**changes)
    motion = some(seed, speed=1.5, acceleration=30.0)
    for field in range(scan.fields):
        keys = key_rows(motion, pinhole, scan, field, bound)
        order = np.argsort(keys.lines)
        lines = np.arange(scan.lines)
        as_lit = lines if scan.direction in ('down', 'right') else lines[::-1]
        dt = scan.line_times(as_lit, field)
        exact = pinhole.project(motion.at(dt[:, None]))
        for node in range(exact.shape[1]):
            for k in range(2):
                drawn = np.interp(lines, keys.lines[order], keys.pixels[order, node, k])
                exact[:, node, k] -= drawn
        worst = np.linalg.norm(exact, axis=-1).max()
        assert worst <= bound
        if len(keys.lines) > 3:  # and no more key lines than that needs
            assert worst > 0.3 * bound
        np.testing.assert_allclose(keys.dt, scan.line_times(as_lit[keys.lines], field))


def test_key_lines_end_at_the_edges_of_the_frame():
    pinhole, scan = projector(fps=10.0)
    for direction, edges in (('down', [0, 1079]), ('left', [1919, 0])):
        _, scan = projector(fps=10.0, direction=direction)
        keys = key_rows(some(1), pinhole, scan, 0, 0.1)
        assert keys.lines[[0, -1]].tolist() == edges
        assert (np.diff(keys.dt) > 0).all()


def test_a_bound_that_no_number_of_key_lines_meets_gives_every_line():
    pinhole, scan = projector(fps=1.0, height=20, v0=10.0)
    keys = key_rows(some(1, acceleration=3000.0), pinhole, scan, 0, 1e-3)
    assert keys.lines.tolist() == list(range(20))


def test_an_instant_has_one_key_line():
    pinhole, scan = projector(scan='global')
    keys = key_rows(some(1), pinhole, scan, 0, 0.1)
    assert keys.lines.tolist() == [0]
    assert keys.dt.tolist() == [scan.begins(0)]
