"""Calibration files: written by OpenCV and as it, by ROS, and wrong ones."""

from dataclasses import replace
from textwrap import dedent

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import ProjectorConfig
from cloth_predict.errors import FormatError
from cloth_predict.formats.calibration_file import (
    DeviceCalibration,
    read_calibration,
    write_calibration,
)
from cloth_predict.projection.pinhole import Pinhole

INTRINSIC = np.array([[1501.25, 2.5, 620.5], [0, 1399.0, 350.1], [0, 0, 1]])
ROTATION = Rotation.from_rotvec([0.3, 2.8, -0.2]).as_matrix()
TRANSLATION = np.array([0.1, -0.2, 2.5])
LENS = np.array([-0.2, 0.05, 0.001, -0.002, 1e-17])

# as OpenCV 4 writes it, and what OpenCV 5 does otherwise
OPENCV_4 = """\
    %YAML:1.0
    ---
    calibration_time: "Wed Nov 25 10:00:00 2026"
    image_width: 1024
    image_height: 768
    flags: 2
    camera_matrix: !!opencv-matrix
       rows: 3
       cols: 3
       dt: d
       data: [ 1400., 0., 5.1150000000000000e+02, 0., 1401., 383., 0., 0.,
           1. ]
    distortion_coefficients: !!opencv-matrix
       rows: 5
       cols: 1
       dt: d
       data: [ -0.20000000000000001, 5.0000000000000003e-02, 1.0000000000000000e-03, -0.002,
           1.0000000000000001e-17 ]
    tvec: !!opencv-matrix
       rows: 3
       cols: 1
       dt: d
       data: [ 1., 2., 3. ]
    rvec: !!opencv-matrix
       rows: 3
       cols: 1
       dt: d
       data: [ 0., 0., 1.5707963267948966 ]
    """
OPENCV_5 = OPENCV_4.replace('%YAML:1.0', '%YAML 1.2')
for name in ('tvec', 'rvec'):
    OPENCV_5 = OPENCV_5.replace(
        f'{name}: !!opencv-matrix\n       rows: 3\n       cols: 1\n',
        f'{name}: !!opencv-nd-matrix\n       sizes: [ 3 ]\n',
    )
CAMERA_INFO = """\
    image_width: 1024
    image_height: 768
    camera_name: projector
    camera_matrix:
      rows: 3
      cols: 3
      data: [1400, 0, 511.5, 0, 1401.0, 383, 0, 0, 1]
    distortion_model: plumb_bob
    distortion_coefficients:
      rows: 1
      cols: 5
      data: [-0.2, 5e-2, 0.001, -0.002, 1.0e-17]
    rectification_matrix:
      rows: 3
      cols: 3
      data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
    projection_matrix:
      rows: 3
      cols: 4
      data: [1400, 0, 511.5, 0, 0, 1401, 383, 0, 0, 0, 1, 0]
    """


@pytest.fixture
def file(tmp_path):
    """Write a text and give its path."""

    def write(text):
        path = tmp_path / 'calibration.yaml'
        path.write_text(dedent(text))
        return path

    return write


@pytest.mark.parametrize('text', [OPENCV_4, OPENCV_5, CAMERA_INFO], ids=['4', '5', 'ros'])
def test_the_forms_of_a_file(file, text):
    found = read_calibration(file(text))
    assert (found.width, found.height) == (1024, 768)
    expected = [[1400, 0, 511.5], [0, 1401, 383], [0, 0, 1]]
    np.testing.assert_array_equal(found.intrinsic, expected)
    np.testing.assert_array_equal(found.distortion, [*LENS, 0, 0, 0])
    if text is CAMERA_INFO:
        assert found.rotation is found.translation is None
        return
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(found.rotation, quarter, atol=1e-15)  # rounding
    np.testing.assert_array_equal(found.translation, [1, 2, 3])


@pytest.mark.parametrize(
    ('matrix', 'lens', 'size', 'pose'),
    [
        ('camera_matrix', 'distortion_coefficients', None, ('R', 'T')),
        ('cameraMatrix', 'distCoeffs', 'image_size', ('rvec', 'tvec')),
        ('Camera_Matrix', 'Distortion_Coefficients', 'imageSize', ('rotation_matrix', 't')),
    ],
)
@pytest.mark.parametrize('coefficients', [0, 4, 5, 8, 14])
def test_what_opencv_writes_is_read(tmp_path, matrix, lens, size, pose, coefficients):
    path = tmp_path / 'opencv.yml'
    distortion = np.zeros(coefficients)
    distortion[:8] = np.resize(LENS, min(coefficients, 8))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if size is None:
        storage.write('image_width', 1280)
        storage.write('image_height', 720)
    else:
        storage.startWriteStruct(size, cv2.FILE_NODE_SEQ + cv2.FILE_NODE_FLOW)
        storage.write('', 1280)
        storage.write('', 720)
        storage.endWriteStruct()
    storage.write(matrix, INTRINSIC)
    if coefficients:
        storage.write(lens, distortion[:, None])
    storage.write(pose[0], ROTATION if pose[0] != 'rvec' else cv2.Rodrigues(ROTATION)[0])
    storage.write(pose[1], TRANSLATION)  # one dimension: OpenCV 5 has a tag of its own for it
    storage.release()
    found = read_calibration(path)
    assert (found.width, found.height) == (1280, 720)
    np.testing.assert_array_equal(found.intrinsic, INTRINSIC)
    np.testing.assert_array_equal(found.distortion, np.pad(distortion, (0, 8))[:8])
    np.testing.assert_allclose(found.rotation, ROTATION, atol=1e-14)  # by a rotation vector
    np.testing.assert_array_equal(found.translation, TRANSLATION)


def test_what_is_written_is_read_by_opencv_and_here(tmp_path):
    path = tmp_path / 'calibration.yaml'
    lens = np.resize(LENS, 8)
    written = DeviceCalibration(1280, 720, INTRINSIC, lens, ROTATION, TRANSLATION)
    write_calibration(path, written, 0.25)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode('camera_matrix').mat(), INTRINSIC)
    np.testing.assert_array_equal(storage.getNode('distortion_coefficients').mat().ravel(), lens)
    np.testing.assert_array_equal(storage.getNode('R').mat(), ROTATION)
    np.testing.assert_array_equal(storage.getNode('T').mat().ravel(), TRANSLATION)
    assert storage.getNode('image_width').real() == 1280
    assert storage.getNode('avg_reprojection_error').real() == 0.25
    found = read_calibration(path)
    for name in ('width', 'height', 'intrinsic', 'distortion', 'rotation', 'translation'):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name), name)


def test_a_file_takes_the_place_of_the_parameters(file):
    config = ProjectorConfig(alpha=700.0, gamma=3.0, distortion=(0.1,) * 4, width=11, u0=5.0)
    filed = replace(config, calibration=str(file(CAMERA_INFO)), throw='ceiling')
    typed = ProjectorConfig(
        width=1024,
        height=768,
        alpha=1400.0,
        beta=1401.0,
        u0=511.5,
        v0=383.0,
        distortion=tuple(LENS),
        throw='ceiling',
    )
    points = np.random.default_rng(1).uniform([0, 0.8, -0.3], [0.5, 1.4, 0.3], (9, 3))
    pinhole = Pinhole.from_config(filed)
    assert (pinhole.width, pinhole.height) == (1024, 768)
    # the file has no pose: the configured one stays
    expected = Pinhole.from_config(typed).project(points)
    np.testing.assert_array_equal(pinhole.project(points), expected)
    posed = replace(filed, calibration=str(file(OPENCV_4)))
    np.testing.assert_array_equal(Pinhole.from_config(posed).translation, [1, 2, 3])


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('rows: 3\n       cols: 3', 'rows: 1\n       cols: 9', 'camera_matrix: expected 3 x 3'),
        ('383., 0., 0.,', '383., 0.,', 'camera_matrix: expected 9 numbers, got 8'),
        ('1401.', 'x', 'camera_matrix: expected numbers'),
        ('1401.', '.nan', 'camera_matrix: a number is not finite'),
        ('1401.', '0', 'camera_matrix: singular or mirrored'),
        ('1400.,', '-1400.,', 'camera_matrix: singular or mirrored'),
        ('1. ]', '2. ]', 'camera_matrix: .*last row'),
        ('camera_matrix', 'matrix', 'camera_matrix: missing'),
        ('image_width: 1024', '', 'image_width: missing: .*resolution'),
        ('1024', '0', 'image_width: expected a whole number of pixels, got 0'),
        ('768', '768.5', 'image_height: expected a whole number of pixels, got 768.5'),
        ('-0.002,', '-0.002, 0, ', 'distortion_coefficients: expected .*, got 6'),
        (
            'rows: 5\n       cols: 1',
            'rows: 5\n       cols: 2',
            'distortion_coefficients: expected 1 x 5, got 5 x 2',
        ),
        ('[ 1., 2., 3. ]', '[ 1., 2. ]', 'tvec: expected 3 numbers, got 2'),
        ('tvec', 'other', 'has a rotation but no translation'),
        ('rvec', 'other', 'has a translation but no rotation'),
        ('flags: 2', 'flags: [', 'not YAML: .*line 6'),
        ('flags: 2', 'distortion_model: equidistant', "distortion_model: 'equidistant' is not"),
    ],
)
def test_a_wrong_file_is_refused_by_the_name_of_its_entry(file, old, new, message):
    assert OPENCV_4.count(old)
    path = file(OPENCV_4.replace(old, new, 1))
    with pytest.raises(FormatError, match=f'^{path}: {message}'):
        Pinhole.from_config(ProjectorConfig(calibration=str(path)))


@pytest.mark.parametrize('count', [12, 14])
def test_models_with_more_coefficients_are_refused(file, count):
    numbers = ', '.join(['0.01'] * count)
    text = CAMERA_INFO.replace('[-0.2, 5e-2, 0.001, -0.002, 1.0e-17]', f'[{numbers}]')
    path = file(text.replace('cols: 5', f'cols: {count}'))
    with pytest.raises(FormatError, match=f'{count} coefficients are not supported: at most 8'):
        read_calibration(path)


def test_a_mirrored_rotation_in_a_file_is_refused(tmp_path):
    path = tmp_path / 'calibration.yaml'
    mirrored = np.diag([1.0, 1.0, -1.0])
    write_calibration(
        path, DeviceCalibration(9, 9, INTRINSIC, np.zeros(8), mirrored, TRANSLATION), 0.0
    )
    with pytest.raises(FormatError, match=f'{path}: R: .*mirrors.*projector.throw'):
        Pinhole.from_config(ProjectorConfig(calibration=str(path)))


def test_what_is_no_calibration_is_refused(tmp_path, file):
    with pytest.raises(FormatError, match=r'gone\.yaml: cannot be read: No such file'):
        read_calibration(tmp_path / 'gone.yaml')
    with pytest.raises(FormatError, match='cannot be read: Is a directory'):
        read_calibration(tmp_path)
    with pytest.raises(FormatError, match='not a calibration'):
        read_calibration(file('hello'))
    binary = tmp_path / 'binary.yaml'
    binary.write_bytes(b'\xff\xfe\x00')
    with pytest.raises(FormatError, match='not a text file'):
        read_calibration(binary)
    with pytest.raises(FormatError, match='cannot be written: No such file'):
        write_calibration(tmp_path / 'no' / 'c.yaml', read_calibration(file(OPENCV_4)), 0.0)
