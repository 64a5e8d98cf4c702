"""What is drawn in a frame, packed for a renderer."""

from dataclasses import replace

import numpy as np
import pytest

from cloth_predict.config import Config, ModelConfig, ProjectorConfig
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.visibility import Flag
from cloth_predict.projection.warp import Warper

SEEN = ProjectorConfig(
    rotation=tuple(np.eye(3).ravel()), translation=(0.0, 0.0, 2.0), u0=640.0, v0=360.0
)
CONFIG = Config(model=ModelConfig(rows=3, cols=4), projector=SEEN)


@pytest.fixture
def sheet():
    """Positions [m] of 3 x 4 vertices in the middle of the frame."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 4), np.linspace(-0.3, 0.3, 3))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(12)])


def warped(sheet, velocity=(0.0, 0.0, 0.0), **changes):
    config = replace(CONFIG, projector=replace(SEEN, **changes))
    warper = Warper.of(config, sheet)
    found = warper.warp(Motion.constant_velocity(sheet, np.tile(velocity, (len(sheet), 1))))
    return warper, found


@pytest.mark.parametrize(('scan', 'fields'), [('progressive', 1), ('interlaced', 2)])
def test_vertices_are_where_they_are_drawn(sheet, scan, fields):
    warper, found = warped(sheet, (1.0, 0.3, 0.0), scan=scan)
    vertices = warper.vertices(found)
    assert vertices.shape == (3 * fields, 4)
    for field, part in enumerate(np.split(vertices, fields)):
        assert (part['field'] == field).all()
        dt = part['dt'].astype(float)
        # 1e-6: float32 of 1 m; 1e-4: of 1000 px; 1e-8 s: of 17 ms, and 1e-3 lines of 23 us
        drawn = sheet.reshape(3, 4, 3) + dt[..., None] * [1.0, 0.3, 0.0]
        shown = np.stack([part[axis] for axis in 'xyz'], axis=-1)
        np.testing.assert_allclose(shown, drawn, atol=1e-6)
        pixels = 640 + 700 * drawn[..., 0], 360 + 700 * drawn[..., 1]
        np.testing.assert_allclose(part['u'], pixels[0], atol=1e-3)
        np.testing.assert_allclose(part['v'], pixels[1], atol=1e-3)
        both = np.stack([part['u'], part['v']], -1)
        np.testing.assert_allclose(dt, warper.scan.times(both, field), atol=1e-7)
        assert part['s'][0].tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
        assert part['t'][:, 0].tolist() == [0, 0.5, 1]
        assert (part['flags'] == 0).all()


def test_key_lines_say_which_they_are(sheet):
    warper, found = warped(sheet, (1.0, 0.3, 0.0), scan='interlaced')
    scanlines = warper.scanlines(found)
    assert scanlines.shape[1] == 12
    assert scanlines['field'][:, 0].tolist() == sorted(scanlines['field'][:, 0])
    for field in range(2):
        part = scanlines[scanlines['field'][:, 0] == field]
        assert part['line'][[0, -1], 0].tolist() == [0, 719]
        expected = warper.scan.line_times(part['line'][:, 0].astype(int), field)
        np.testing.assert_allclose(part['dt'][:, 0], expected, atol=1e-8)  # float32 of 17 ms
        drawn = 640 + 700 * (sheet[:, 0] + part['dt'].astype(float))
        np.testing.assert_allclose(part['u'], drawn, atol=1e-3)  # float32 of 1000 px, of 17 ms


@pytest.mark.parametrize(
    ('change', 'flag', 'nodes'),
    [
        (lambda p: p[5].__setitem__(2, -2.5), Flag.BEHIND, [5]),
        (lambda p: p[:4].__setitem__((slice(None), 1), -0.6), Flag.OUTSIDE, [0, 1, 2, 3]),
        (lambda p: p.__setitem__(slice(None), p * [-1, 1, 1]), Flag.BACK_FACING, range(12)),
        (
            lambda p: p[:4].__setitem__(slice(None), p[4:8] + np.array([0.05, 0.1, 0.5])),
            Flag.OCCLUDED,
            [0],
        ),
    ],
)
def test_flags_tell_what_is_not_lit(sheet, change, flag, nodes):
    change(sheet)
    found = warped(sheet)[1].flags[0]
    has = np.flatnonzero(found & flag)
    assert set(nodes) <= set(has.tolist())
    if flag in (Flag.BEHIND, Flag.OUTSIDE):
        assert has.tolist() == list(nodes)


def test_what_outruns_the_beam_is_flagged(sheet):
    found = warped(sheet, (0.0, 100.0, 0.0))[1]  # 70,000 px/s; the beam does 43,200
    assert (found.flags[0] & Flag.UNCONVERGED).all()


def test_a_frame_is_empty_where_no_vertex_is_within_it(sheet):
    assert not warped(sheet)[1].empty
    assert warped(sheet + np.array([5.0, 0.0, 0.0]))[1].empty
    assert warped(sheet - np.array([0.0, 0.0, 5.0]))[1].empty
    # it comes in while the second field is drawn
    assert not warped(sheet - np.array([1.2, 0.0, 0.0]), (40.0, 0.0, 0.0), scan='interlaced')[
        1
    ].empty
