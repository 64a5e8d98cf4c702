"""Bodies from the command line: a bag predicted, and the line that says what is wrong."""

import numpy as np
import pytest
from swinging_body import FRAME, SETTINGS, SHAPE, SIGMA, Swinging, settings

from cloth_predict import cli
from cloth_predict.config import nest
from cloth_predict.formats.bag import Recording, read_clouds, write_recording
from cloth_predict.formats.pointcloud import NORMAL, SURFACE, decode
from cloth_predict.tracker import Tracker
from cloth_predict.types import MarkerSequence

FRAMES = 12
BODY = Swinging()


def recorded(path, positions, name='Unlabeled {}'):
    """Write a bag of markers, shape (frames, markers, 3)."""
    labels = tuple(name.format(k) for k in range(positions.shape[1]))
    visible = np.isfinite(positions).all(axis=2)
    stamps = FRAME * np.arange(len(positions))
    write_recording(path, Recording(MarkerSequence(stamps, labels, positions, visible)))
    return path


@pytest.fixture
def markers():
    rng = np.random.default_rng(0)
    exact = np.array([BODY.markers(k * FRAME / 1e9) for k in range(FRAMES)])
    return exact + rng.normal(0.0, SIGMA, exact.shape)


@pytest.fixture
def command(tmp_path, parameters, capsys):
    """Run a command on a bag with changed parameters; gives its code and what it printed."""

    def run(name, bag, *more, **changes):
        values = {**SETTINGS, **{k.replace('__', '.'): v for k, v in changes.items()}}
        code = cli.main([name, str(bag), '-c', str(parameters(**nest(values))), *more])
        return code, *capsys.readouterr()

    return run


def test_a_bag_without_labels_is_predicted(tmp_path, command, markers):
    bag, copy = recorded(tmp_path / 'bag', markers), tmp_path / 'predicted'
    code, out, err = command('predict', bag, '-o', str(copy), limits__sigma_error=1.0)
    assert (code, err) == (0, '')
    assert f'{FRAMES - 1} frames updated' in out
    clouds = read_clouds(copy, 'cloth/prediction')
    assert [stamp for stamp, _ in clouds] == (FRAME * np.arange(FRAMES) + 10**8).tolist()
    points = decode(clouds[-1][1], (*SURFACE.names, *NORMAL))
    assert points.shape == (1, 300)
    tracker = Tracker(settings(limits__sigma_error=1.0))
    none = np.full((300, 3), np.nan), np.zeros(300, bool)
    for k, seen in enumerate(markers.astype(np.float32).astype(float)):
        tracker.step(FRAME * k, *none, seen)
    expected = tracker.predict(0.1)
    for names, values in (('xyz', expected.position), (NORMAL, expected.normal)):
        for axis, name in enumerate(names):
            np.testing.assert_array_equal(points[0][name], values[:, axis].astype(np.float32))


def test_labels_may_be_fewer_than_the_nodes(tmp_path, command, markers):
    bag = recorded(tmp_path / 'bag', markers, 'm{}')
    code, out, err = command('predict', bag, '-o', str(tmp_path / 'x'), limits__sigma_error=1.0)
    assert (code, err) == (0, '')
    assert f'{FRAMES - 1} frames updated' in out


@pytest.mark.parametrize(
    ('changes', 'told'),
    [
        ({'body__initial': [0.2, 1.2, *SHAPE[2:].tolist()]},
         'body.initial: superquadric: a1 is 1.2, expected a number from 0.001 to 1'),
        ({'body__initial': [*SHAPE[:5].tolist(), -0.5, *SHAPE[6:].tolist()]},
         'body.initial: superquadric: e2 is -0.5, expected a number from 0 to 2'),
        ({'body__initial': [*SHAPE[:10].tolist(), 0.0]},
         'body.initial: superquadric: b3 is 0, expected a number from 0.001 to 1'),
        ({'body__fixed': ['bend']},
         "body.fixed: 'bend' is no global parameter; they are a0, a1, a2, a3, e1, e2, t1, t2, b1, "
         'b2, b3'),
    ],
)  # fmt: skip
def test_a_parameter_out_of_its_range(tmp_path, command, markers, changes, told):
    bag = recorded(tmp_path / 'bag', markers)
    code, out, err = command('predict', bag, '-o', str(tmp_path / 'x'), **changes)
    assert (code, out, err) == (1, '', f'cloth-predict: {told}\n')


@pytest.mark.parametrize(
    ('points', 'told'),
    [
        (lambda m: m[:, :7], '7 markers, fewer than the 11 global parameters of a body'),
        (lambda m: m[:1, :15] * [0.0, 0.0, 1.0], 'all 15 points lie on a line'),
    ],
)
def test_points_that_are_no_body(tmp_path, command, markers, points, told):
    bag = recorded(tmp_path / 'bag', points(markers))
    code, out, err = command('predict', bag, '-o', str(tmp_path / 'x'))
    assert (code, out) == (1, '')
    assert err.startswith(f'cloth-predict: {bag}: no surface yet: {told}')
    assert err.count('\n') == 1
    assert not (tmp_path / 'x').exists()


def test_the_light_on_a_body_is_not_judged(tmp_path, command, markers):
    bag = recorded(tmp_path / 'bag', markers)
    code, out, err = command('project', bag)
    assert (code, out) == (1, '')
    assert err.startswith('cloth-predict: model.kind superquadric: where light lands is judged')
    assert err.count('\n') == 1
