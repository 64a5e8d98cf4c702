"""A video of a sliding bar kept as its model: its ends, what is expected of them, the commands."""

import json

import numpy as np
import pytest

from cloth_predict.cli import main
from cloth_predict.config.ruler import RulerConfig
from cloth_predict.encoding.bar import ENDS, BarExpectation, bar_between, ends_of
from cloth_predict.encoding.interpolation import through
from cloth_predict.encoding.smoothed_bar import smoothed_bar
from cloth_predict.formats.bag import read_clouds
from cloth_predict.formats.recording import read
from cloth_predict.simulation.ruler import ANNEX_A, slide
from cloth_predict.tracking.ruler_assembly import joint_model
from cloth_predict.types import MarkerSequence

STEP = 1e-3
FRAME = 20_000_000


@pytest.fixture(scope='module')
def film(tmp_path_factory):
    """Film of scenario 5 and its parameter file."""
    video = tmp_path_factory.mktemp('film') / 'bar.mp4'
    assert main(['film', '-o', str(video), '--shot', '5', '--size', '640', '360']) == 0
    return video, video.with_suffix('.yaml')


@pytest.fixture(scope='module')
def encoded(film, tmp_path_factory):
    small = tmp_path_factory.mktemp('encoded') / 'small.mcap'
    video, config = map(str, film)
    arguments = ['encode', video, '-c', config, '-o', str(small), '--max-error-mm', '0.5']
    assert main(arguments) == 0
    return small


def bars(version=5, frames=50):
    """Bars z of a scenario of annex A at 50 Hz, shape (frames, 4)."""
    shot = ANNEX_A[version]
    states = slide(shot).at(np.arange(frames) / 50)
    length = np.full(frames, float(shot.ruler.L))
    return np.column_stack([states[:, :2], length, states[:, 2]])


def told(expectation, z, first=0):
    """Let it take bars, and return how far each was from what was expected [m], (frames,)."""
    errors, both = [], np.ones(2, bool)
    for k, bar in enumerate(z, first):
        multiples = np.rint(ends_of(bar) / STEP).astype(np.int64)
        expected = expectation.at(k * FRAME)
        errors.append(STEP * np.abs(expected - multiples).max())
        expectation.take(k * FRAME, multiples, both)
    return np.array(errors)


def test_a_bar_is_what_lies_between_its_ends():
    for angle in (-3.0, -1.0, 0.0, 0.5, 2.0):
        z = np.array([0.3, -0.2, 1.1, angle])
        np.testing.assert_allclose(bar_between(ends_of(z)), z, atol=1e-15)


def test_what_is_expected_of_ends_gets_exact_as_the_bar_is_known():
    z = bars()
    errors = told(BarExpectation(RulerConfig(g=10.0), STEP), z)
    assert errors[0] > 0.1  # nothing is known
    assert errors[40:].max() < STEP  # rounding
    going_on = STEP * np.abs(np.diff(np.rint([ends_of(bar) / STEP for bar in z]), 2, axis=0))
    assert errors[30:].mean() < 0.5 * going_on[28:].max(axis=(1, 2)).mean()  # as it moved before


def test_ends_stay_apart_where_the_angle_is_known_but_for_half_turns():
    z = bars()
    turned = z + np.array([0.0, 0.0, 0.0, np.pi])  # the same bar with the other end first
    expectation = BarExpectation(RulerConfig(g=10.0), STEP)
    told(expectation, z[:30])
    errors = told(expectation, turned[30:40], 30)
    assert errors[0] > 0.5  # the ends have changed places
    assert errors[2:].max() < 5 * STEP


def test_hidden_ends_are_carried_on():
    z = bars()
    expectation = BarExpectation(RulerConfig(g=10.0), STEP)
    told(expectation, z[:30])
    for k in (30, 31):
        step = expectation.take(k * FRAME, np.zeros((2, 3), np.int64), np.zeros(2, bool))
        assert step.outcome == 'hidden'
        assert np.isnan(step.positions).all()
    assert told(expectation, z[32:34], 32).max() < 5 * STEP


def test_states_of_the_ends_are_those_of_the_joint_state():
    z = bars(3, 60)
    config = RulerConfig(g=10.0)
    expectation = BarExpectation(config, STEP)
    told(expectation, z)
    found, ends = expectation.estimate(), [ends_of(b) for b in z]
    assert np.abs(found.position - ends[-1]).max() < 3e-3
    # velocity and acceleration by differences of the truth
    fine = slide(ANNEX_A[3]).at(59 / 50 + np.array([-1e-3, 0.0, 1e-3]))
    around = [ends_of(np.array([*x[:2], z[0, 2], x[2]])) for x in fine]
    velocity, acceleration = (
        (around[2] - around[0]) / 2e-3,
        (around[0] - 2 * around[1] + around[2]) / 1e-6,
    )
    assert np.abs(found.velocity - velocity).max() < 0.05 * np.abs(velocity).max()
    assert np.abs(found.acceleration - acceleration).max() < 0.1 * np.abs(acceleration).max()
    # covariance by differences of the ends
    belief = expectation._tracker.belief
    names = joint_model(config)
    assert len(belief.mean) == names.dim_x
    moved = np.stack(
        [
            (ends_of(belief.mean[:4] + d) - ends_of(belief.mean[:4] - d)) / 2e-6
            for d in 1e-6 * np.eye(4)
        ],
        axis=-1,
    )
    expected = moved @ belief.cov[:4, :4] @ moved.transpose(0, 2, 1)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-15)


def test_a_film_is_kept_in_less_than_the_paper_says(film, encoded, tmp_path, capsys):
    video, config = film
    arguments = ['encode', str(video), '-c', str(config), '--max-error-mm', '0.5', '--json']
    assert main([*arguments, '-o', str(tmp_path / 'again.mcap')]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['bytes'] == encoded.stat().st_size
    assert found['video_bytes'] == video.stat().st_size
    assert found['pictures_bytes'] == found['frames'] * 640 * 360 * 3
    assert found['bytes'] < 0.02 * found['pictures_bytes']  # Goeller et al. 2015, 4.2: 2 to 3 %
    assert found['bytes'] < 0.5 * found['bag_bytes'] + 4000  # what does not grow with the length


def test_ends_are_rebuilt_within_the_bound_with_their_states(film, encoded, tmp_path):
    from cloth_predict.config.ruler_video import load_ruler_video
    from cloth_predict.video.ends import ends_in

    assert main(['decode', str(encoded), '-o', str(tmp_path / 'bag'), '--states']) == 0
    rebuilt = read(tmp_path / 'bag').markers
    seen, faults, _ = ends_in(film[0], load_ruler_video(film[1]))
    assert not faults
    assert rebuilt.labels == seen.labels
    np.testing.assert_array_equal(rebuilt.stamps, seen.stamps)
    assert np.linalg.norm(rebuilt.positions - seen.positions, axis=-1).max() <= 5e-4
    states = list(read_clouds(tmp_path / 'bag', 'cloth/estimate'))
    assert len(states) == len(seen)


@pytest.mark.parametrize(('version', 'every'), [(3, 4), (4, 2)])
def test_ends_between_frames_are_known_twice_as_well_as_by_splines(version, every):
    z, rng = bars(version, 80), np.random.default_rng(version)
    stamps = (np.arange(80) * FRAME).astype(np.int64)
    true = np.array([ends_of(bar) for bar in z])
    noise = rng.normal(0.0, [1e-3, 1e-3, 1e-3, np.radians(0.5)], z.shape)
    seen = np.array([ends_of(bar) for bar in z + noise])[::every]
    given = MarkerSequence(stamps[::every], ENDS, seen, np.ones(seen.shape[:2], bool))
    withheld = (np.arange(80) % every != 0) & (stamps < given.stamps[-1])
    errors = [
        np.sqrt(np.square(found[withheld] - true[withheld]).sum(axis=-1).mean())
        for found in (
            smoothed_bar(given, RulerConfig(g=10.0), stamps),
            through(given, stamps, 'cubic'),
        )
    ]
    assert errors[0] < 0.5 * errors[1]


def test_between_two_motions_there_is_no_bar():
    first, second = bars(4, 30), bars(5, 30)
    z = np.concatenate([first, second + np.array([5.0, 0.0, 0.0, 0.0])])
    stamps = (np.arange(60) * FRAME).astype(np.int64)
    ends = np.array([ends_of(bar) for bar in z])
    markers = MarkerSequence(stamps, ENDS, ends, np.ones((60, 2), bool))
    times = np.arange(0, 59 * FRAME, FRAME // 2)
    found = smoothed_bar(markers, RulerConfig(g=10.0), times)
    unknown = np.isnan(found[..., 0]).all(axis=1)
    assert unknown.any()
    # the bar that jumped is not believed for some frames (`patience`), and then taken anew
    assert times[unknown].min() > stamps[29]
    assert times[unknown].max() < stamps[37]
    late = ~unknown & (times % FRAME == 0)
    off = found[late] - ends[times[late] // FRAME]
    assert np.abs(off).max() < 0.01


def test_a_film_is_rebuilt_at_another_rate(film, encoded, tmp_path):
    arguments = ['decode', str(encoded), '-o', str(tmp_path / 'bag'), '--rate', '240']
    assert main([*arguments, '-c', str(film[1])]) == 0
    rebuilt = read(tmp_path / 'bag').markers
    assert np.diff(rebuilt.stamps).max() <= 4_166_667
    assert rebuilt.visible.all()
    rest = rebuilt.positions[rebuilt.stamps > rebuilt.stamps[-1] - 200_000_000]
    assert np.ptp(rest, axis=0).max() < 1e-6  # the bar lies still at the end


def test_what_cannot_be_encoded_of_a_film_is_said(tmp_path, capsys):
    empty = tmp_path / 'empty'
    assert main(['film', '-o', str(empty), '--shot', '5', '--size', '64', '48']) == 0
    arguments = ['encode', str(empty), '-c', str(empty.with_suffix('.yaml'))]
    assert main([*arguments, '-o', str(tmp_path / 'y.mcap')]) == 1
    assert f'{empty}: no bar in ' in capsys.readouterr().err
    assert not (tmp_path / 'y.mcap').exists()


@pytest.mark.filterwarnings('always')  # as on the command line
def test_frames_before_a_fault_of_the_video_are_kept(tmp_path, capsys):
    folder = tmp_path / 'png'
    assert main(['film', '-o', str(folder), '--shot', '5', '--size', '480', '270']) == 0
    pictures = sorted(folder.glob('*.png'))
    pictures[30].write_bytes(b'no picture')
    arguments = ['encode', str(folder), '-c', str(folder.with_suffix('.yaml')), '--json']
    capsys.readouterr()
    assert main([*arguments, '-o', str(tmp_path / 'small.mcap')]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)['frames'] == 30
    assert told.err == f'cloth-predict: warning: {pictures[30]}: no picture\n'
