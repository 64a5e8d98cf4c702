"""The augmented view of sheets and bodies: its geometry, a picture of it, and the command."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import BAG, shipped
from swinging_body import FRAME, Swinging, settings

from cloth_predict.cli import main
from cloth_predict.config import load
from cloth_predict.formats.bag import Recording, write_recording
from cloth_predict.overlay import (
    ARROWS,
    ESTIMATE,
    FORCE,
    PREDICTION,
    Shown,
    arrow_scale,
    dashes,
    dashes_of_net,
    upwards,
)
from cloth_predict.tracker import Tracker
from cloth_predict.types import MarkerSequence
from cloth_predict.video.commands import repeats, shown_of
from cloth_predict.video.drawing import INK, bgr
from cloth_predict.video.files import frames
from cloth_predict.video.surface import augmented
from cloth_predict.video.view import BAND, SIZE, View, camera_for, level_axes

TOWEL = BAG.parents[1] / 'config' / 'towel.yaml'
FRAMES = 41
UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope='module')
def markers():
    """0.4 s of the shipped recording, from a time with wind on; its stamps begin with 0."""
    every, part = shipped().markers, slice(560, 560 + FRAMES)
    return MarkerSequence(
        every.stamps[part] - every.stamps[560],
        every.labels,
        every.positions[part],
        every.visible[part],
        every.frame_id,
    )


@pytest.fixture(scope='module')
def body():
    """What is shown of a body that swings."""
    tracker, moving = Tracker(settings()), Swinging()
    for k in range(20):
        points = moving.markers(1e-9 * k * FRAME)
        tracker.step(k * FRAME, np.zeros((300, 3)), np.zeros(300, bool), points)
    return shown_of(tracker)


@pytest.fixture(scope='module')
def towel_bag(markers, tmp_path_factory):
    path = tmp_path_factory.mktemp('bag') / 'towel'
    write_recording(path, Recording(markers))
    return path


@pytest.fixture(scope='module')
def tracker(markers):
    found = Tracker(load(TOWEL))
    for k, stamp in enumerate(markers.stamps.tolist()):
        found.step(stamp, markers.positions[k], markers.visible[k])
    return found


@pytest.fixture(scope='module')
def shown(tracker):
    return shown_of(tracker)


# --- geometry


def lengths(segments):
    return np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)


@pytest.mark.parametrize('length', [1e-3, 0.03, 0.4, 10.0])
def test_dashes_cover_half_of_each_segment_from_its_start_to_its_end(length):
    rng = np.random.default_rng(0)
    for segment in rng.normal(size=(10, 1, 2, 3)):
        found = dashes(segment, length)
        whole = lengths(segment)[0]
        assert lengths(found).sum() == pytest.approx(whole / 2)
        way = (segment[0, 1] - segment[0, 0]) / whole
        along = (found - segment[0, 0]) @ way
        np.testing.assert_allclose(found, segment[0, 0] + along[..., None] * way, atol=1e-12)
        gaps = along[1:, 0] - along[:-1, 1]
        # half a gap at either end, between them gaps as long as the dashes
        ends = np.array([along[0, 0], whole - along[-1, 1]])
        np.testing.assert_allclose(gaps, lengths(found)[1:], atol=1e-12)
        np.testing.assert_allclose(ends, lengths(found)[0] / 2, atol=1e-12)
        if length < whole / 2:  # else there is one
            assert 2 / 3 < lengths(found)[0] / length < 4 / 3  # rounded to a whole number


def test_dashes_of_many_segments_are_those_of_each():
    segments = np.random.default_rng(1).normal(size=(7, 2, 3))
    each = np.concatenate([dashes(segment[None], 0.1) for segment in segments])
    np.testing.assert_array_equal(dashes(segments, 0.1), each)


def test_a_net_has_three_dashes_an_edge_and_fewer_where_it_is_dense():
    def net(nodes):
        row = np.stack([np.linspace(0.0, 1.0, nodes), np.zeros(nodes), np.zeros(nodes)], axis=1)
        return np.stack([row[:-1], row[1:]], axis=1)

    assert len(dashes_of_net(net(5))) == 3 * 4
    assert len(dashes_of_net(net(101))) == 100
    assert dashes_of_net(np.zeros((0, 2, 3))).shape == (0, 2, 3)
    assert np.isfinite(dashes_of_net(np.zeros((4, 2, 3)))).all()


def test_an_arrow_of_the_weight_of_a_marker_is_20_cm_long():
    config = load(TOWEL)
    weight = config.model.mass / 20 * 9.81
    assert arrow_scale(config) * weight == pytest.approx(0.2)


def test_arrows_are_the_loads_on_one_scale(tracker, shown):
    loads = tracker.loads()
    tails, tips = shown.arrows[:, 0], shown.arrows[:, 1]
    np.testing.assert_array_equal(tails, tracker.estimate().position)
    np.testing.assert_allclose(tips - tails, shown.scale * loads, atol=1e-15)
    assert f'10 cm are {0.1 / shown.scale:.2g} N' in shown.told[-1]
    assert np.abs(loads[4:]).max() > 0


def test_what_is_told_names_the_horizon_and_sigma(tracker, shown):
    sigma = float(np.sqrt(np.mean(tracker.predict(0.1).sigma[4:] ** 2)))
    assert shown.ahead == 'prediction 100 ms ahead'
    assert f'sigma {1e3 * sigma:.3g} mm' in shown.health


def test_a_prediction_that_is_refused_is_not_shown(tracker):
    health = tracker.health()
    refused = Shown.of(tracker, None, 0.1, health)
    assert refused.dashed.shape == (0, 2, 3)
    assert refused.told[0] == 'no prediction 100 ms ahead'


def test_arrows_of_a_body_are_few_and_all_over_it(body):
    assert len(body.edges) == 3 * (300 - 2)  # of a closed surface: Euler
    assert len(body.arrows) <= ARROWS < 300
    towards = body.arrows[:, 0] - body.estimate.position.mean(axis=0)
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        assert (towards @ axis > 0.4 * np.abs(towards @ axis).max()).any()


# --- the view


@pytest.mark.parametrize('up', np.eye(3))
def test_azimuth_counts_from_one_horizontal_axis_to_the_other(up):
    first, second = level_axes(up)
    np.testing.assert_allclose(np.linalg.det([first, second, up]), 1.0)
    points = np.random.default_rng(2).normal(size=(500, 3))
    for view, back in (
        (View(0.0, 0.0), first),
        (View(90.0, 0.0), second),
        (View(45.0, 0.0), (first + second) / np.sqrt(2)),
        (View(0.0, 90.0), up),
    ):
        eye = camera_for(points, up, view).pinhole
        np.testing.assert_allclose(eye.rotation @ back, [0, 0, -1], atol=1e-12)
    # what is above is above in the picture
    eye = camera_for(points, up, View(20.0, 10.0)).pinhole
    middle = points.mean(axis=0)
    assert eye.project(middle + 0.1 * up)[1] < eye.project(middle)[1]


def test_gravity_that_is_not_along_an_axis_gives_level_axes():
    up = np.array([0.6, 0.8, 0.0])
    first, second = level_axes(up)
    np.testing.assert_allclose(np.stack([first, second]) @ up, 0.0, atol=1e-15)
    tilted = replace(load(TOWEL), model=replace(load(TOWEL).model, gravity=(-3.0, -4.0, 0.0)))
    np.testing.assert_allclose(upwards(tilted), up)


def test_a_camera_has_all_in_view_but_outliers():
    points = np.random.default_rng(3).uniform(-1, 1, (1000, 3)) * [0.5, 0.8, 0.1]
    points[:3] = 1e4
    pixels = camera_for(points, UP).pinhole.project(points[3:])
    inside = (pixels > 0).all(axis=1) & (pixels < [SIZE[0], SIZE[1] - BAND]).all(axis=1)
    assert inside.all()
    assert np.ptp(pixels[:, 1]) > 0.6 * SIZE[1]  # and it fills the picture


def test_a_sheet_is_seen_from_its_broad_side():
    points = np.random.default_rng(4).uniform(-1, 1, (1000, 3)) * [0.1, 0.8, 0.5]
    back = -camera_for(points, UP).pinhole.rotation[2]
    assert back[0] > np.cos(np.radians(45))  # 35 degrees aside, and 15 up
    assert back[1] == pytest.approx(np.sin(np.radians(15)))


def test_a_scale_is_that_in_the_middle_of_the_view():
    points = np.random.default_rng(5).uniform(-1, 1, (1000, 3))
    camera = camera_for(points, UP, View(0.0, 0.0))
    short = np.array([[-1e-3, 0.0, 0.0], [1e-3, 0.0, 0.0]])
    found = np.ptp(camera.pinhole.project(short)[:, 0]) / 2e-3
    assert found == pytest.approx(camera.scale, rel=0.02)  # the middle is that of the extent


# --- pictures


def near(picture, pixels, colour, reach=2):
    """Whether each pixel has one of this colour around it."""
    wanted, found = np.array(bgr(colour)), []
    for u, v in np.rint(pixels).astype(int):
        patch = picture[v - reach : v + reach + 1, u - reach : u + reach + 1].astype(int)
        found.append((np.abs(patch - wanted).max(axis=2) < 40).any())
    return np.array(found)


def test_edges_dashes_and_arrows_are_drawn_where_they_project_to(markers, shown):
    seen = markers.positions[markers.visible]
    camera = camera_for(seen, UP)
    picture = augmented(shown, np.zeros((0, 3)), 0.4, camera)
    project = camera.pinhole.project
    middle = shown.solid.mean(axis=1)
    assert near(picture, project(middle), ESTIMATE).all()
    long = lengths(project(shown.arrows)) > 20.0
    assert long.any()
    assert near(picture, project(shown.arrows[long].mean(axis=1)), FORCE).all()
    assert near(picture, project(shown.dashed.mean(axis=1)), PREDICTION).mean() > 0.8


def test_where_a_prediction_is_dashed_half_of_it_is_there(shown):
    camera = camera_for(shown.prediction.position, UP)
    whole = replace(shown, edges=shown.edges, pushed=shown.pushed[:0], arrows=shown.arrows[:0])
    off = replace(whole.estimate, position=whole.estimate.position + 100.0)
    picture = augmented(replace(whole, estimate=off), np.zeros((0, 3)), 0.0, camera)
    ends = shown.prediction.position[shown.edges]
    along = ends[:, :1] + np.linspace(0.02, 0.98, 200)[:, None] * (ends[:, 1:] - ends[:, :1])
    there = near(picture, camera.pinhole.project(along).reshape(-1, 2), PREDICTION, reach=0)
    assert 0.4 < there.mean() < 0.6  # ends are round: a pixel more


def test_the_back_of_a_body_is_faint(body):
    camera = camera_for(body.estimate.position, UP)
    away = body.estimate.position - camera.pinhole.origin
    behind = np.einsum('ni,ni->n', away, body.estimate.normal) > 0
    back = behind[body.edges].all(axis=1)
    assert 0.3 < back.mean() < 0.7
    for edges, there in ((body.edges[back], False), (body.edges[~back], True)):
        of_one_side = replace(
            body, edges=edges, prediction=None, arrows=body.arrows[:0], pushed=[]
        )
        picture = augmented(of_one_side, np.zeros((0, 3)), 0.0, camera)[:-BAND]
        assert (picture < 250).any()
        strong = np.abs(picture.astype(int) - bgr(ESTIMATE)).max(axis=2) < 40
        assert strong.any() == there


def test_without_a_surface_there_are_only_the_markers(markers):
    seen = markers.positions[0, markers.visible[0]]
    camera = camera_for(seen, UP)
    picture = augmented(None, seen, 0.0, camera)
    assert near(picture, camera.pinhole.project(seen), INK).all()
    assert np.ptp(picture.astype(int), axis=2).max() == 0  # nothing has a colour


def test_what_is_nowhere_is_not_drawn(shown, markers):
    camera = camera_for(markers.positions[markers.visible], UP)
    nowhere = np.full_like(shown.estimate.position, 1e30)
    nowhere[::2] = np.nan
    lost = replace(shown, estimate=replace(shown.estimate, position=nowhere), prediction=None)
    picture = augmented(replace(lost, arrows=shown.arrows[:0], pushed=[]), nowhere, 0.0, camera)
    assert (picture[: SIZE[1] - BAND] == 255).all()


# --- the command


def test_each_time_of_the_video_shows_the_latest_frame():
    ms = 10**6
    assert repeats(np.arange(11) * 10 * ms, 50.0, 1.0) == [1, 0] * 5 + [1]
    assert repeats(np.arange(3) * 40 * ms, 50.0, 1.0) == [2, 2, 1]
    # one that is late is not shown, and a gap no longer than the longest
    assert repeats(np.array([0, 20, 10, 40]) * ms, 50.0, 1.0) == [1, 1, 0, 1]
    assert repeats(np.array([0, 20, 90_000]) * ms, 50.0, 0.1) == [1, 5, 1]
    assert repeats(np.array([7]), 25.0, 1.0) == [1]


def written(path):
    return list(frames(path, 25.0))


def test_a_video_has_a_frame_for_each_time(towel_bag, tmp_path, capsys):
    path = tmp_path / 'out' / 'towel.mp4'
    assert main(['overlay', str(towel_bag), '-c', str(TOWEL), '-o', str(path)]) == 0
    assert capsys.readouterr().out == f'{path}: 11 frames\n'  # 0.4 s at 25 Hz
    found = written(path)
    assert len(found) == 11
    assert found[0].picture.shape == (SIZE[1], SIZE[0], 3)


def test_pictures_are_those_of_the_tracker(towel_bag, tmp_path, markers, shown):
    path = tmp_path / 'pictures'
    call = ['overlay', str(towel_bag), '-c', str(TOWEL), '-o', str(path), '--fps', '5']
    assert main([*call, '--view', '-30', '20']) == 0
    found = written(path)
    assert len(found) == 3
    camera = camera_for(markers.positions[markers.visible], UP, View(-30.0, 20.0))
    seen = markers.positions[-1, markers.visible[-1]]
    np.testing.assert_array_equal(found[-1].picture, augmented(shown, seen, 0.4, camera))


@pytest.mark.filterwarnings('always')  # as on the command line
def test_a_recording_without_a_surface_is_told(markers, tmp_path, capsys):
    few = tmp_path / 'few'
    hidden = markers.positions.copy()
    hidden[:, :4] = np.nan  # the hung ones
    visible = markers.visible.copy()
    visible[:, :4] = False
    write_recording(few, Recording(replace(markers, positions=hidden, visible=visible)))
    path = tmp_path / 'few.mp4'
    assert main(['overlay', str(few), '-c', str(TOWEL), '-o', str(path), '--fps', '5']) == 0
    told = f'cloth-predict: warning: {few}: no surface yet: 16 of 5 x 4'
    assert capsys.readouterr().err.startswith(told)
    assert len(written(path)) == 3


def failing(capsys, bag, output):
    assert main(['overlay', str(bag), '-c', str(TOWEL), '-o', str(output)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_cannot_be_is_one_line(towel_bag, markers, tmp_path, capsys):
    assert 'x.avi: a video is an .mp4 file' in failing(capsys, towel_bag, tmp_path / 'x.avi')
    there = tmp_path / 'there.mp4'
    there.touch()
    assert failing(capsys, towel_bag, there).endswith('there.mp4: exists; not overwritten')
    assert there.stat().st_size == 0
    assert 'absent: no such' in failing(capsys, tmp_path / 'absent', tmp_path / 'x.mp4')
    unseen = tmp_path / 'unseen'
    nan, no = np.full_like(markers.positions, np.nan), np.zeros_like(markers.visible)
    write_recording(unseen, Recording(replace(markers, positions=nan, visible=no)))
    line = failing(capsys, unseen, tmp_path / 'x.mp4')
    assert line.endswith(f'{unseen}: no marker is visible in any frame')
    assert not (tmp_path / 'x.mp4').exists()


@pytest.mark.parametrize(
    'wrong', [['--view', 'nan', '0'], ['--view', '10', '361'], ['--fps', '0'], ['--view', '10']]
)
def test_wrong_usage_ends_with_2(wrong, capsys):
    with pytest.raises(SystemExit) as ended:
        main(['overlay', 'bag', '-c', str(TOWEL), '-o', 'x.mp4', *wrong])
    assert ended.value.code == 2
    assert wrong[0] in capsys.readouterr().err
