"""A sliding bar from pixels: calibration, pictures, detection, faults, and the whole chain."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from references import central_differences

from cloth_predict.cli import main
from cloth_predict.config.ruler import RulerConfig
from cloth_predict.config.ruler_video import CameraConfig, RulerVideoConfig, build_ruler_video
from cloth_predict.errors import ConfigError, FormatError, FrameError
from cloth_predict.overlay import ESTIMATE, PREDICTION
from cloth_predict.simulation.ruler import ANNEX_A, measured, slide
from cloth_predict.tracking.ruler import RulerTracker
from cloth_predict.video import overlay
from cloth_predict.video.calibration import Calibration
from cloth_predict.video.commands import film, follow
from cloth_predict.video.detector import BarDetector
from cloth_predict.video.drawing import bgr
from cloth_predict.video.files import Frame, Writer, frames
from cloth_predict.video.following import VideoFollower
from cloth_predict.video.generator import BAR, TABLE, Filming, camera_for, covered, table
from cloth_predict.video.generator import film as filmed
from cloth_predict.video.opencv import cv2
from cloth_predict.video.watching import Watcher

SIZE = (480, 270)
CAMERA = CameraConfig(scale=0.008, origin=(240.0, 135.0))
# a table seen from the side: its far edge is shorter than its near one
SLANTED = CameraConfig(
    pixels=(100.0, 40.0, 380.0, 50.0, 460.0, 250.0, 20.0, 240.0),
    metres=(-1.5, 1.0, 1.5, 1.0, 1.5, -1.0, -1.5, -1.0),
)


def picture(pose, camera=CAMERA, noise=0.0, length=1.0, seed=0):
    """The table with a bar at a pose."""
    cover = covered(np.array(pose), length, 0.04, Calibration.from_config(camera), SIZE)
    shown = table(SIZE) + cover[..., None] * (np.array(BAR) - TABLE)
    shown += noise * np.random.default_rng(seed).standard_normal(shown.shape)
    return np.clip(np.rint(shown), 0, 255).astype(np.uint8)


def video(poses, numbers=None):
    """Frames of a bar at poses; None is the table without it."""
    numbers = range(len(poses)) if numbers is None else numbers
    empty = np.rint(table(SIZE)).astype(np.uint8)
    shown = [empty if pose is None else picture(pose) for pose in poses]
    return [Frame(n, 20_000_000 * n, one) for n, one in zip(numbers, shown, strict=True)]


def faults(shown, camera=CAMERA):
    watcher = Watcher(BarDetector(camera))
    return [fault for frame in shown for fault in watcher.see(frame).faults]


def moving(count):
    return [(-0.5 + 0.03 * k, 0.1, 0.2 + 0.05 * k) for k in range(count)]


# --- calibration


def test_two_points_are_a_scale_and_a_turn():
    scaled = Calibration.by_scale(0.004, np.array([100.0, 50.0]))
    pixels = np.array([[100.0, 50.0], [350.0, 50.0]])
    points = scaled.to_metres(pixels)
    np.testing.assert_allclose(points, [[0.0, 0.0], [1.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(scaled.to_metres(np.array([100.0, 0.0])), [0.0, 0.2], atol=1e-15)
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])  # a quarter
    other = Calibration.by_two_points(pixels, points @ turn + [0.3, 0.7])
    some = np.random.default_rng(0).uniform(0, 400, (20, 2))
    np.testing.assert_allclose(
        other.to_metres(some), scaled.to_metres(some) @ turn + [0.3, 0.7], atol=1e-13
    )


def test_homography_goes_through_its_points_and_back():
    view = Calibration.from_config(SLANTED)
    pixels, metres = (np.reshape(p, (4, 2)) for p in (SLANTED.pixels, SLANTED.metres))
    np.testing.assert_allclose(view.to_metres(pixels), metres, atol=1e-12)
    np.testing.assert_allclose(view.to_pixels(metres), pixels, atol=1e-9)
    at = np.array([200.0, 100.0])
    np.testing.assert_allclose(
        view.slopes(at), central_differences(view.to_metres, at, 1e-3), atol=1e-9
    )


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'pixels': [0, 0, 1, 1]}, 'camera.metres: 0 numbers, but camera.pixels has 4'),
        ({'pixels': [0] * 6, 'metres': [0] * 6}, 'camera.pixels: 6 numbers'),
        ({'scael': 1.0}, 'did you mean camera.scale'),
        ({'scale': -1.0}, 'camera.scale: -1.0 is out of range'),
    ],
)
def test_wrong_camera_is_named(values, words):
    with pytest.raises(ConfigError, match=words):
        build_ruler_video({'camera': values}, 'x.yaml')


@pytest.mark.parametrize('corners', [(0, 0, 0, 0), (0, 0, 1, 1, 2, 2, 3, 3)])
def test_points_that_fix_no_view_are_refused(corners):
    with pytest.raises(ConfigError, match=r'camera\.pixels, camera\.metres'):
        Calibration.from_config(CameraConfig(pixels=corners, metres=corners))


# --- pictures


@pytest.mark.parametrize('angle', [0.0, 0.4, 1.3, 2.9, -1.0])
def test_picture_covers_the_bar(angle):
    """Area and centre of what is covered are those of the bar."""
    length, width = 125 * CAMERA.scale, 5 * CAMERA.scale
    view, pose = Calibration.from_config(CAMERA), np.array([0.1234, 0.0567, angle])
    cover = covered(pose, length, width, view, SIZE).astype(float)
    v, u = np.nonzero(cover)
    points = view.to_metres(np.column_stack([u, v]).astype(float))
    # 1 / 32 pixel is how finely OpenCV knows where it reads
    assert cover.sum() == pytest.approx(125 * 5, rel=1e-3)
    centre = cover[v, u] @ points / cover.sum()
    np.testing.assert_allclose(centre, pose[:2], atol=CAMERA.scale / 32)


def test_blur_is_the_mean_over_the_exposure():
    motion = slide(ANNEX_A[3], 1e-9)
    camera = camera_for(motion, 1.0, SIZE)
    ink = []
    for blur in (0.0, 1.0):
        how = Filming(size=SIZE, noise=0.0, blur=blur)
        shots = filmed(motion, 1.0, camera, how, np.random.default_rng(0))
        sharp = [next(shots) for _ in range(6)][-1].picture[24:].astype(float)
        differs = np.abs(sharp - table(SIZE)[24:]).max(axis=2)
        ink.append((differs.sum(), (differs > 2).sum()))
    assert ink[1][0] == pytest.approx(ink[0][0], rel=0.05)  # as much of the bar, over
    assert ink[1][1] > 1.5 * ink[0][1]  # more pixels


# --- detection


@pytest.mark.parametrize('camera', [CAMERA, SLANTED], ids=['above', 'slanted'])
def test_bar_is_found_to_a_part_of_a_pixel(camera):
    detector, pixel = BarDetector(camera), 0.011  # [m], of the slanted camera, far away
    rng = np.random.default_rng(1)
    for seed in range(8):
        pose = rng.uniform([-0.6, -0.3, -1.5], [0.6, 0.3, 1.5])
        x, y, length, angle = detector.find(picture(pose, camera, noise=3.0, seed=seed))
        # 0.05 px by the noise, up to 0.08 px by light that is not a plane
        assert np.hypot(x - pose[0], y - pose[1]) < 0.25 * pixel
        assert abs(length - 1.0) < 0.5 * pixel
        assert abs(np.sin(angle - pose[2])) < 0.1 * pixel / 0.5


def test_picture_of_the_table_serves_as_background(tmp_path):
    """Stripes as dark as the bar are no bar."""
    empty = np.rint(table(SIZE)).astype(np.uint8)
    empty[20:30, 10:400] = BAR
    assert cv2.imwrite(str(tmp_path / 'table.png'), empty)
    shown = picture((0.1, -0.2, 0.5))
    shown[20:30, 10:400] = BAR
    camera = replace(CAMERA, background=str(tmp_path / 'table.png'))
    np.testing.assert_allclose(
        BarDetector(camera).find(shown), [0.1, -0.2, 1.0, 0.5], atol=0.5 * CAMERA.scale
    )
    assert abs(BarDetector(CAMERA).find(shown)[1] + 0.2) > 0.5  # the stripe
    with pytest.raises(ConfigError, match='not of the size'):
        BarDetector(camera).find(shown[::2])
    with pytest.raises(FormatError, match='no such file'):
        BarDetector(replace(CAMERA, background='absent.png'))


def test_what_is_no_bar_is_not_taken_for_one():
    detector, shown = BarDetector(CAMERA), np.rint(table(SIZE)).astype(np.uint8)
    shown[100:130, 100:130] = 0
    with pytest.raises(FrameError, match='is not long'):
        detector.find(shown)
    with pytest.raises(ConfigError, match=r'camera\.region'):
        BarDetector(replace(CAMERA, region=(0, 0, 1000, 10))).find(shown)


# --- faults of a video


def test_good_video_has_none():
    assert faults(video(moving(6))) == []


def test_frames_without_a_bar_are_said_once():
    poses = moving(8)
    poses[3:6] = [None] * 3
    assert faults(video(poses)) == ['frame 3: no bar']


def test_bar_that_leaves_is_said():
    poses = [(1.0 + 0.1 * k, 0.0, 0.3) for k in range(10)]
    assert faults(video(poses)) == ['frame 5: the bar is not wholly in view']


def test_frozen_picture_is_said_and_not_measured():
    shown = video(moving(8))
    shown[4:6] = [replace(frame, picture=shown[3].picture) for frame in shown[4:6]]
    assert faults(shown) == [
        'frame 4: the picture of the frame before again, though the bar moves'
    ]
    watcher = Watcher(BarDetector(CAMERA))
    seen = [watcher.see(frame).z is not None for frame in shown]
    assert seen == [True] * 4 + [False] * 2 + [True] * 2


def test_frozen_picture_is_known_after_compression(tmp_path):
    shown = video(moving(8))
    shown[4:6] = [replace(frame, picture=shown[3].picture) for frame in shown[4:6]]
    with Writer(tmp_path / 'frozen.mp4', 50.0) as writer:
        for frame in shown:
            writer.write(frame.picture)
    assert faults(frames(tmp_path / 'frozen.mp4', 50.0)) == [
        'frame 4: the picture of the frame before again, though the bar moves'
    ]


def test_bar_at_rest_is_not_frozen():
    assert faults(video([(0.0, 0.0, 0.3)] * 4)) == []


def test_dropped_frames_are_said():
    numbers = [0, 1, 2, 5, 6, 8, 9]
    assert faults(video(moving(7), numbers)) == [
        'frames 3 to 4 are missing',
        'frame 7 is missing',
    ]


# --- files


def test_folder_keeps_pictures_and_numbers(tmp_path):
    shown = video(moving(4))
    with Writer(tmp_path / 'film', 25.0) as writer:
        for frame in shown:
            writer.write(frame.picture)
    (tmp_path / 'film' / '000002.png').unlink()
    found = list(frames(tmp_path / 'film', 25.0))
    assert [(f.number, f.stamp) for f in found] == [(0, 0), (1, 40_000_000), (3, 120_000_000)]
    for frame in found:
        np.testing.assert_array_equal(frame.picture, shown[frame.number].picture)


def test_film_keeps_pictures_nearly_and_stamps(tmp_path):
    shown = video(moving(5))
    with Writer(tmp_path / 'film.mp4', 50.0) as writer:
        for frame in shown:
            writer.write(frame.picture)
    found = list(frames(tmp_path / 'film.mp4', 1.0))
    assert [(f.number, f.stamp) for f in found] == [(f.number, f.stamp) for f in shown]
    for one, other in zip(found, shown, strict=True):
        assert np.abs(one.picture.astype(float) - other.picture).mean() < 3  # of 255


@pytest.mark.parametrize('content', [None, b'', b'no video at all' * 100])
def test_no_video_is_one_line(tmp_path, content, capfd, parameters):
    path = tmp_path / 'x.mp4'
    if content is not None:
        path.write_bytes(content)
    arguments = ['ruler', str(path), '-c', str(parameters()), '-o', str(tmp_path / 'out')]
    assert main(arguments) == 1
    assert [str(path) in line for line in capfd.readouterr().err.splitlines()] == [True]


def test_files_that_are_no_frames_are_named(tmp_path):
    with pytest.raises(FormatError, match='no PNG file'):
        list(frames(tmp_path, 50.0))
    (tmp_path / 'name.png').touch()
    with pytest.raises(FormatError, match='does not end in a number'):
        list(frames(tmp_path, 50.0))
    with pytest.raises(FormatError, match=r'is an \.mp4 file'):
        Writer(tmp_path / 'x.avi', 50.0)


@pytest.mark.parametrize(
    'call',
    [
        "from cloth_predict.cli import main; sys.exit(main(['film', '-o', 'absent/x.mp4']))",
        "from cloth_predict.cli import main; sys.exit(main('overlay b -c c -o x.mp4'.split()))",
        'from cloth_predict.nodes.start import ruler_node; sys.exit(ruler_node())',
    ],
    ids=['film', 'overlay', 'node'],
)
def test_without_opencv_one_line_says_what_to_install(call):
    if 'node' in call:
        pytest.importorskip('rclpy')
    ended = subprocess.run(
        [sys.executable, '-c', f"import sys; sys.modules['cv2'] = None; {call}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    (line,) = ended.stderr.splitlines()
    assert "pip install 'cloth_predict[video]'" in line


# --- the chain


@pytest.fixture(scope='module')
def filmed_shot(tmp_path_factory):
    """Scenario 5 as a video with its parameter file."""
    path = tmp_path_factory.mktemp('film') / 'five.mp4'
    film(path, '5', Filming(size=SIZE), 0)
    return path


def errors(steps, motion, config, mu):
    """Error of mu [1] at the end, of the stop at half of the run [m, rad]."""
    tracker, half = RulerTracker(config), None
    for stamp, z in steps:
        tracker.step(stamp, z)
        if half is None and stamp >= 0.5e9 * motion.duration:
            half = tracker.stop().mean - motion.at(np.array([motion.duration]))[0, :3]
    return tracker.belief.mean[-1] - mu, np.hypot(*half[:2]), half[2]


def test_errors_from_pixels_are_within_twice_those_from_data():
    """From data: RMS of six noises of 1 mm and half a degree."""
    shot, config = ANNEX_A[5], RulerConfig(g=10.0)
    motion = slide(shot, 1e-9)
    camera, rng = camera_for(motion, 1.0, SIZE), np.random.default_rng(0)
    watcher = Watcher(BarDetector(camera))
    shown = filmed(motion, 1.0, camera, Filming(size=SIZE), rng)
    seen = [(frame.stamp, watcher.see(frame).z) for frame in shown]
    pixels = errors(seen, motion, config, shot.ruler.mu)
    states, given = motion.at(np.array([stamp for stamp, _ in seen]) / 1e9), []
    for seed in range(6):
        z = measured(states, 1.0, np.random.default_rng(seed))
        steps = [(stamp, one) for (stamp, _), one in zip(seen, z, strict=True)]
        given.append(errors(steps, motion, config, shot.ruler.mu))
    assert (np.abs(pixels) <= 2 * np.sqrt(np.mean(np.square(given), axis=0))).all()


def test_command_identifies_and_writes(filmed_shot, tmp_path, capsys):
    config = filmed_shot.with_suffix('.yaml')
    assert main(['ruler', str(filmed_shot), '-c', str(config), '-o', str(tmp_path), '--json']) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((tmp_path / 'ruler.json').read_text())
    assert told['identified']['mu']['value'] == pytest.approx(0.3, rel=0.02)
    end = slide(ANNEX_A[5], 1e-9)
    np.testing.assert_allclose(
        told['last_stop']['pose'][:2], end.at(np.array([end.duration]))[0, :2], atol=0.01
    )
    assert told['last_stop']['time'] == pytest.approx(end.duration, abs=0.1)
    assert told['stop']['told_at'] < end.duration
    assert told['faults'] == []
    assert len(list(frames(tmp_path / 'overlay.mp4', 1.0))) == told['frames']
    assert '| mu |' in (tmp_path / 'ruler.md').read_text()


def test_what_came_before_a_fault_is_kept(filmed_shot, tmp_path):
    """A folder whose last picture is cut in the middle."""
    config = replace(RulerVideoConfig(), camera=CAMERA)
    with Writer(tmp_path / 'film', 50.0) as writer:
        for frame in video(moving(12)):
            writer.write(frame.picture)
    last = tmp_path / 'film' / '000011.png'
    last.write_bytes(b'cut')
    report = follow(tmp_path / 'film', config, tmp_path / 'o.mp4', lambda _: None)
    assert report.frames == 11
    assert report.faults == [f'{last}: no picture']
    shutil.rmtree(tmp_path / 'film')
    with Writer(tmp_path / 'film', 50.0) as writer:
        for frame in video([None] * 3):
            writer.write(frame.picture)
    with pytest.raises(FormatError, match='nothing to follow in 3 frames: frame 0: no bar'):
        follow(tmp_path / 'film', config, tmp_path / 'o.mp4', lambda _: None)


def test_bar_that_never_moves_tells_no_friction(tmp_path):
    config = replace(RulerVideoConfig(), camera=CAMERA)
    rng = np.random.default_rng(0)
    with Writer(tmp_path / 'film', 50.0) as writer:
        for k in range(15):
            writer.write(picture((0.1, 0.0, 0.4), noise=2.0, seed=int(rng.integers(1000)) + k))
    report = follow(tmp_path / 'film', config, tmp_path / 'o.mp4', lambda _: None)
    assert report.faults == ['the bar lies still and has not slid: no friction can be told']


# --- the augmented view


def test_overlay_has_edges_dashes_and_friction(filmed_shot):
    motion = slide(ANNEX_A[5], 1e-9)
    camera = camera_for(motion, 1.0, SIZE)
    follower = VideoFollower(
        replace(RulerVideoConfig(), camera=camera, ruler=RulerConfig(g=10.0, stop_angle=0.1))
    )
    for frame in frames(filmed_shot, 50.0):
        seen = follower.see(frame)
        if seen.certain_rest and seen.rest.time > 0.1 + frame.stamp / 1e9:
            break
    drawn = overlay.augmented(seen, follower.detector.calibration)

    def along(pose):
        """Colours along one edge of a bar at a pose."""
        corners = overlay.outline(pose, float(seen.ruler.L))
        way = corners[0] + np.linspace(0.05, 0.95, 100)[:, None] * (corners[3] - corners[0])
        u, v = np.rint(follower.detector.calibration.to_pixels(way)).astype(int).T
        return drawn[v, u].astype(float)

    def share(colours, wanted):
        return (np.abs(colours - wanted).max(axis=1) < 60).mean()

    assert share(along(seen.state[:3]), bgr(ESTIMATE)) > 0.8
    assert 0.25 < share(along(seen.rest.stop.mean), bgr(PREDICTION)) < 0.75
    tails, tips = overlay.friction_arrows(seen).transpose(1, 0, 2)
    later = motion.at(np.array([frame.stamp / 1e9, frame.stamp / 1e9 + 1e-4]))
    at = seen.ruler.contacts(later)
    moved = np.diff(at, axis=0)[0]
    cosines = [
        (tip - tail) @ [way.real, way.imag] / (np.linalg.norm(tip - tail) * abs(way))
        for tail, tip, way in zip(tails, tips, moved, strict=True)
    ]
    np.testing.assert_allclose(cosines, -1.0, atol=1e-2)  # friction is against the motion


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'mu': 5.0}, r'mu: 5 is not within ruler\.mu_low and ruler\.mu_high, 0\.001 and 1\.5'),
        ({'contact_low': 0.7}, r'contact_low: 0\.7 is above ruler\.contact_high, 0\.5'),
    ],
)
def test_a_first_guess_out_of_its_bounds_is_named(changes, words):
    with pytest.raises(ConfigError, match=rf'^x: ruler\.{words}$'):
        build_ruler_video({'ruler': changes}, 'x')


def test_a_film_keeps_a_parameter_file_that_is_not_its_own(tmp_path, capsys):
    own = tmp_path / 'towel.yaml'
    own.write_text('mine')
    arguments = ['film', '-o', str(tmp_path / 'towel.mp4'), '--shot', '5', '--size', '64', '48']
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert error == f'cloth-predict: {own}: exists and was not made by `film`; not overwritten\n'
    assert own.read_text() == 'mine'
    own.unlink()
    assert main(arguments) == main(arguments) == 0
