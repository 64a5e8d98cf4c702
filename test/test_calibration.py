"""Calibration of a projector: known projectors, OpenCV, and how often sigma is right."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.cli import main
from cloth_predict.config import ProjectorConfig
from cloth_predict.errors import ClothPredictError
from cloth_predict.projection.calibration import calibrate
from cloth_predict.projection.calibration_report import complaints
from cloth_predict.projection.linear_transform import linear_transform
from cloth_predict.projection.pinhole import Pinhole

FRAME = (1280, 720)
NOISE = 0.3  # px
LENS = (-0.21, 0.06, 0.0012, -0.0021, -0.008)
TURNED = Rotation.from_rotvec([2.9, 0.2, -0.3]).as_matrix()


def points(count=40, seed=0):
    """Points before the default projector, over its frame and 1 m of depth."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.4, 0.7, -0.5], [0.9, 1.5, 0.5], (count, 3))


def projector(**values):
    return Pinhole.from_config(ProjectorConfig(**values))


def noisy(pinhole, at, seed=1):
    return pinhole.project(at) + np.random.default_rng(seed).normal(0, NOISE, (len(at), 2))


@pytest.mark.parametrize('throw', ['front', 'rear', 'ceiling', 'ceiling_rear'])
@pytest.mark.parametrize(
    ('lens', 'fitted', 'gamma'),
    [((), 0, 0.0), ((), 0, 4.0), ((-0.2, 0.05, 0, 0), 2, 0.0), (LENS[:4], 4, 4.0), (LENS, 5, 0.0)],
    ids=str,
)
def test_pairs_without_noise_give_the_projector_back(lens, fitted, gamma, throw):
    truth = projector(distortion=lens, gamma=gamma, throw=throw)
    at = points()
    found = calibrate(at, truth.project(at), *FRAME, throw, fitted, gamma != 0)
    assert found.max < 1e-7  # px, where least squares end
    assert found.converged
    assert not found.suspects
    mine = found.pinhole
    np.testing.assert_allclose(mine.intrinsic, truth.intrinsic, atol=1e-4)  # px, the same
    np.testing.assert_allclose(mine.rotation, truth.rotation, atol=1e-7)  # the same
    np.testing.assert_allclose(mine.translation, truth.translation, atol=1e-7)  # the same
    elsewhere = points(seed=2)
    # px: the lens is known where there were pairs
    np.testing.assert_allclose(mine.project(elsewhere), truth.project(elsewhere), atol=1e-3)


@pytest.mark.parametrize('fitted', [0, 2, 4, 5])
def test_parameters_and_sigmas_equal_those_of_opencv(fitted):
    lens = np.pad(LENS[:fitted], (0, 8 - fitted))
    truth = replace(projector(), distortion=lens)
    at = points().astype(np.float32)  # OpenCV takes no others
    seen = noisy(truth, at.astype(float)).astype(np.float32)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    flags |= cv2.CALIB_FIX_K3 if fitted < 5 else 0
    flags |= cv2.CALIB_ZERO_TANGENT_DIST if fitted < 4 else 0
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 if fitted < 2 else 0
    rms, matrix, bent, _, shifts, sigma, sigma_pose, _ = cv2.calibrateCameraExtended(
        [at], [seen[:, None]], FRAME, truth.intrinsic, np.zeros(5), flags=flags,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15),
    )  # fmt: skip
    found = calibrate(at.astype(float), seen.astype(float), *FRAME, distortion=fitted)
    assert found.rms == pytest.approx(rms, abs=1e-5)  # it returns less digits
    names = ('alpha', 'beta', 'u0', 'v0', 'k1', 'k2', 'p1', 'p2', 'k3')[: 4 + fitted]
    theirs = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *bent.ravel()]
    mine, spread = (dict(zip(found.names, found_of, strict=True)) for found_of in
                    (found.values, found.sigma))  # fmt: skip
    for name, value, its_sigma in zip(names, theirs, sigma.ravel(), strict=False):
        # its search ends at a thousandth of a sigma
        assert mine[name] == pytest.approx(value, abs=1e-3 * its_sigma), name
        assert spread[name] == pytest.approx(its_sigma, rel=1e-4), name
    np.testing.assert_allclose(found.pinhole.translation, shifts[0].ravel(), atol=1e-5)  # the same
    np.testing.assert_allclose(found.sigma[-3:], sigma_pose.ravel()[3:6], rtol=1e-4)  # the same


def test_sigma_is_the_spread_of_repeated_calibrations():
    runs = 60
    truth = projector(
        distortion=(-0.2, 0.05, 0, 0), gamma=3.0, rotation=tuple(TURNED.ravel()),
        translation=(-0.1, 1.0, 2.3),
    )  # fmt: skip
    middle = -TURNED.T @ [-0.1, 1.0, 2.3] + 2.2 * TURNED[2]
    at = points() - points().mean(axis=0) + middle
    assert truth.inside(truth.project(at)).all()
    scaled = []
    for run in range(runs):
        found = calibrate(at, noisy(truth, at, 100 + run), *FRAME, 'front', 2, True)
        turn = Rotation.from_matrix(found.pinhole.rotation @ TURNED.T).as_rotvec()
        expected = [1400, 1400, 3, 640, 360, -0.2, 0.05, 0, 0, 0, -0.1, 1.0, 2.3]
        values = np.concatenate([found.values[:-6], turn, found.values[-3:]])
        scaled.append((values - expected) / found.sigma)
    scaled = np.array(scaled)
    within = np.mean(np.abs(scaled) < 3)
    # Student's t with 67 degrees of freedom: 99.6 %; 13 parameters that hang together
    assert 0.98 < within <= 1
    # the spread of 60 draws is known to 9 %: three times that; the mean to 0.13
    np.testing.assert_allclose(scaled.std(axis=0), 1, atol=0.27)
    np.testing.assert_allclose(scaled.mean(axis=0), 0, atol=0.4)  # three times that


@pytest.mark.parametrize(
    'mistype',
    [
        lambda at, seen: seen.__setitem__((7, 0), seen[7, 0] / 10),
        lambda at, seen: seen.__setitem__(7, seen[7, ::-1].copy()),
        lambda at, seen: seen.__setitem__((7, 1), seen[7, 1] + 5),
        lambda at, seen: at.__setitem__((7, 1), at[7, 1] + 0.1),
        lambda at, seen: at.__setitem__((7, 0), at[7, 0] * 10),
    ],
    ids=['u / 10', 'u and v', 'v + 5', 'y + 0.1', 'x * 10'],
)
@pytest.mark.parametrize('fitted', [0, 2, 5])
def test_a_mistyped_pair_is_found(fitted, mistype):
    lens = LENS[:fitted] if fitted != 2 else (*LENS[:2], 0.0, 0.0)
    at = points()
    seen = noisy(projector(distortion=lens), at)
    assert calibrate(at, seen, *FRAME, distortion=fitted).suspects == []
    mistype(at, seen)
    suspects = calibrate(at, seen, *FRAME, distortion=fitted).suspects
    far = at[7, 0] < -1  # such a point pulls so hard that others are suspect, too
    assert 7 in suspects if far else suspects == [7]


def test_a_mistyped_pair_does_not_make_the_picture_count_as_mirrored():
    at = points(14, seed=3)
    seen = noisy(projector(), at)
    seen[3] = [110, 170]
    with pytest.raises(ClothPredictError, match='mirrored'):
        linear_transform(at, seen)
    assert calibrate(at, seen, *FRAME).suspects == [3]


def test_what_the_pairs_do_not_tell_is_named():
    at = points()
    whole = calibrate(at, noisy(projector(), at), *FRAME)
    assert list(whole.undetermined()) == []
    shallow = at * [1, 1, 0.02]  # 2 cm of depth: near or with a long lens?
    found = calibrate(shallow, noisy(projector(), shallow), *FRAME)
    assert {'alpha', 'beta', 'translation_z'} <= set(found.undetermined())
    # far from the edge of the frame a lens of five coefficients is not seen
    small = at.mean(axis=0) + 0.1 * (at - at.mean(axis=0))
    blind = calibrate(small, noisy(projector(), small), *FRAME, distortion=5)
    assert 'k3' in blind.undetermined()
    assert not blind.converged
    assert any('came to no end' in line for line in complaints(blind, tuple(range(40))))


def test_pairs_that_determine_no_projector_are_refused():
    at = points()
    seen = projector().project(at)
    with pytest.raises(ClothPredictError, match=r'5 pairs, but 10 parameters .* need 6'):
        calibrate(at[:5], seen[:5], *FRAME)
    with pytest.raises(ClothPredictError, match=r'8 pairs, but 16 parameters .* need 9'):
        calibrate(at[:8], seen[:8], *FRAME, 'front', 5, True)
    flat = at * [1, 1, 0]
    with pytest.raises(ClothPredictError, match='in a plane'):
        calibrate(flat @ TURNED, projector().project(flat), *FRAME)
    with pytest.raises(ClothPredictError, match='mirrored'):
        calibrate(at, seen, *FRAME, 'rear')
    few = np.repeat(at[:5], 8, axis=0)
    with pytest.raises(ClothPredictError, match='too few different'):
        calibrate(few, projector().project(few), *FRAME)


# --- the command


@pytest.fixture
def pairs(tmp_path):
    """Write a table of pairs and give its path."""

    def write(at, seen, header='x,y,z,u,v'):
        path = tmp_path / 'pairs.csv'
        np.savetxt(path, np.hstack([at, seen]), delimiter=',', header=header, comments='')
        return path

    return write


def call(path, *options):
    output = path.with_name('calibration.yaml')
    frame = ('--width', '1280', '--height', '720')
    return main(['calibrate-projector', str(path), *frame, '-o', str(output), *options]), output


def test_the_command_writes_what_the_nodes_and_opencv_read(pairs, capsys):
    at = points()
    seen = noisy(projector(distortion=LENS[:4], throw='rear'), at)
    path = pairs(at, seen)
    status, output = call(path, '--distortion', '4', '--throw', 'rear')
    assert status == 0
    printed = capsys.readouterr().out
    known = calibrate(at, seen, *FRAME, 'rear', 4)
    assert f'RMS {known.rms:.3g} px, max {known.max:.3g} px' in printed
    assert 'projector.throw: rear' in printed
    rows = [line.split() for line in printed.splitlines()[1:]]
    shown = {row[0]: row[1:] for row in rows if row and row[0] in known.names}
    assert shown['alpha'] == [f'{known.values[0]:.5g}', f'{known.sigma[0]:.2g}', 'px']
    assert set(shown) == set(known.names)
    loaded = projector(calibration=str(output), throw='rear')
    # 17 digits of the pairs' 18 lead to the same but for rounding
    np.testing.assert_allclose(loaded.project(at), known.pinhole.project(at), atol=1e-6)
    storage = cv2.FileStorage(str(output), cv2.FILE_STORAGE_READ)
    turn = cv2.Rodrigues(storage.getNode('R').mat())[0]
    matrix, lens = (storage.getNode(name).mat() for name in
                    ('camera_matrix', 'distortion_coefficients'))  # fmt: skip
    by_opencv, _ = cv2.projectPoints(at, turn, storage.getNode('T').mat(), matrix, lens)
    mirrored = [1279, 0] + by_opencv[:, 0] * [-1, 1]  # the throw is no part of the file
    np.testing.assert_allclose(mirrored, loaded.project(at), atol=1e-8)  # rounding of 1e3 px


@pytest.mark.filterwarnings('always')  # as on the command line
def test_the_command_names_the_line_of_a_mistyped_pair(pairs, capsys):
    at = points()
    seen = noisy(projector(), at)
    seen[4, 0] += 25
    status, _ = call(pairs(at, seen), '--json')
    printed, complaint = capsys.readouterr()
    found = json.loads(printed)
    assert status == 0
    assert 'pairs.csv: line 6: seems mistyped: it is off by 24.6 px' in complaint
    assert (found['pairs'], found['worst_line'], found['mistyped_lines']) == (40, 6, [6])
    assert set(found['parameters']) == set(calibrate(at, seen, *FRAME).names)
    assert found['parameters']['translation_z'].keys() == {'value', 'sigma', 'unit'}
    assert 25 / 40**0.5 * 0.8 < found['rms_px'] < 25 / 40**0.5 < found['max_px'] < 25


@pytest.mark.parametrize(
    ('line', 'text', 'message'),
    [
        (1, 'x,y,z,u', 'pairs.csv:1: column v missing'),
        (1, 'x,y,z,u,u', 'pairs.csv:1: column u twice'),
        (3, '0.1,0.9,zero,600,300', "pairs.csv:3: column z: 'zero' is not a number"),
        (3, '0.1,0.9,,600,300', "pairs.csv:3: column z: '' is not a number"),
        (4, 'nan,0.9,0,600,300', 'pairs.csv:4: column x: nan is not finite'),
        (4, '0.1,0.9,0,inf,300', 'pairs.csv:4: column u: inf is not finite'),
        (5, '0.1,0.9,0,600', 'pairs.csv:5: 4 cells, the first line has 5'),
        (6, '0.1,0.9,0,600,720', 'pairs.csv:6: pixel 600, 720 is outside the frame of 1280 x'),
    ],
)
def test_an_error_names_file_line_and_column(pairs, capsys, line, text, message):
    at = points()
    path = pairs(at, projector().project(at))
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text('\n'.join(lines))
    status, output = call(path)
    assert status == 1
    assert message in capsys.readouterr().err
    assert not output.exists()


def test_columns_in_any_order_and_others_beside_them(pairs):
    at, seen = points(), projector().project(points())
    path = pairs(np.column_stack([seen, np.arange(40), at[:, 2]]), at[:, :2], 'U,V,n, z ,x,y')
    path.write_text('\ufeff' + path.read_text().replace('\n', '\n\n', 1))  # as spreadsheets do
    status, output = call(path)
    assert status == 0
    found = projector(calibration=str(output))
    np.testing.assert_allclose(found.project(at), seen, atol=1e-6)  # px, where least squares end


def test_files_that_are_no_pairs(pairs, tmp_path, capsys):
    empty = tmp_path / 'empty.csv'
    empty.write_text('\n')
    for path, message in (
        (empty, 'empty.csv: empty file'),
        (tmp_path / 'gone.csv', 'gone.csv: cannot be read: No such file'),
        (pairs(points(4), projector().project(points(4))), 'pairs.csv: 4 pairs, but 10'),
    ):
        assert call(path)[0] == 1
        assert message in capsys.readouterr().err
    table = pairs(points(), projector().project(points()))
    frame = ('--width', '1280', '--height', '720')
    assert main(['calibrate-projector', str(table), *frame, '-o', str(table)]) == 1
    assert 'is the recording itself' in capsys.readouterr().err
