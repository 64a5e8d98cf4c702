"""When lines are lit, against the order in which a projector lights them, line by line."""

import numpy as np
import pytest

from cloth_predict.config import ProjectorConfig
from cloth_predict.projection.scan import Scan

WIDTH, HEIGHT = 12, 8


def lit(mode, fps, blanking, lines):
    """Field and time [s] of each lighting of a line, in order: (line, field, time)."""
    fields = 2 if mode == 'interlaced' else 1
    found = []
    for field in range(fields):
        own = range(field, lines, fields)
        each = (1 - blanking) / (fps * lines)  # as many lines per second as without fields
        for k, line in enumerate(own):
            found.append((line, field, field / (fields * fps) + k * each))
    return found


@pytest.mark.parametrize('mode', ['progressive', 'interlaced'])
@pytest.mark.parametrize('blanking', [0.0, 0.1])
@pytest.mark.parametrize('direction', ['down', 'up', 'right', 'left'])
def test_every_line_has_its_time(mode, blanking, direction):
    config = ProjectorConfig(scan=mode, direction=direction, blanking=blanking, fps=50.0)
    scan = Scan.of(config, WIDTH, HEIGHT)
    lines = WIDTH if direction in ('right', 'left') else HEIGHT
    assert scan.lines == lines
    seen = set()
    for line, field, time in lit(mode, 50.0, blanking, lines):
        place = line if direction in ('down', 'right') else lines - 1 - line
        pixel = np.array([place, 3.0] if direction in ('right', 'left') else [3.0, place])
        assert scan.times(pixel, field) == pytest.approx(time, abs=1e-15)  # rounding
        assert [place in range(lines)[scan.lit_by(k)] for k in range(scan.fields)] == [
            k == field for k in range(scan.fields)
        ]
        assert scan.begins(field) <= time <= scan.ends(field)
        seen.add(line)
        if line == lines - 1:
            assert scan.ends(field) == pytest.approx(time, rel=1e-14)  # rounding
    assert seen == set(range(lines))
    assert len(seen) == lines


def test_the_last_line_ends_before_the_next_frame():
    scan = Scan('progressive', 'down', WIDTH, HEIGHT, 60.0)
    # one more line would be the first of the next frame
    assert scan.ends(0) + scan.line_time == pytest.approx(1 / 60, rel=1e-14)  # rounding
    dark = Scan('progressive', 'down', WIDTH, HEIGHT, 60.0, blanking=0.25)
    assert dark.ends(0) + dark.line_time == pytest.approx(0.75 / 60, rel=1e-14)  # rounding


def test_the_line_rate_of_the_paper():
    # Gomes 2016, section 6.5: 1080 lines at 24 fps are drawn at 25.9 kHz
    scan = Scan('progressive', 'down', 1920, 1080, 24.0)
    assert 1 / scan.line_time == pytest.approx(25.9e3, rel=1e-3)  # three digits are printed


@pytest.mark.parametrize(
    ('mode', 'fields', 'instants'),
    [('global', 1, [1 / 40]), ('colour_sequential', 3, [1 / 120, 3 / 120, 5 / 120])],
)
def test_an_instant_is_the_middle_of_its_light(mode, fields, instants):
    scan = Scan.of(ProjectorConfig(scan=mode, fps=20.0, colours=3), WIDTH, HEIGHT)
    assert scan.fields == fields
    assert scan.instant
    pixels = np.random.default_rng(1).uniform(-5, 15, (6, 2))
    for field, instant in enumerate(instants):
        np.testing.assert_allclose(scan.times(pixels, field), instant, rtol=1e-14)  # rounding
        assert scan.ends(field) == scan.begins(field)
    for field in range(fields):  # each lights every line
        assert range(HEIGHT)[scan.lit_by(field)] == range(HEIGHT)
    flash = Scan.of(ProjectorConfig(scan=mode, fps=20.0, colours=3, blanking=0.5), 4, 4)
    assert flash.begins(0) == pytest.approx(instants[0] / 2, rel=1e-14)  # rounding


def test_what_is_outside_has_the_time_of_the_edge():
    scan = Scan('progressive', 'down', WIDTH, HEIGHT, 60.0)
    times = scan.times(np.array([[3.0, -2.0], [3.0, 20.0], [np.nan, np.nan]]), 0)
    assert times[:2].tolist() == [scan.begins(0), scan.ends(0)]
    assert np.isnan(times[2])
