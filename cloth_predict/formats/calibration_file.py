"""Calibrations of cameras and projectors: YAML of OpenCV's FileStorage, and ROS `camera_info`.

Both hold a camera matrix, distortion coefficients and a resolution, under names that differ in
case and underscores; OpenCV's may hold a rotation and a translation, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_predict.errors import FormatError
from cloth_predict.formats.files import writing
from cloth_predict.formats.opencv_yaml import parse
from cloth_predict.types import FloatArray

CAMERA_MATRIX = ('camera_matrix',)
DISTORTION = ('distortion_coefficients', 'dist_coeffs')
ROTATION = ('R', 'rotation_matrix', 'rotation')
ROTATION_VECTOR = ('rvec', 'rotation_vector')
TRANSLATION = ('T', 'tvec', 'translation', 'translation_vector')
MODELS = ('plumb_bob', 'rational_polynomial')
LENS_COUNTS = (0, 4, 5, 8)
"""Numbers of coefficients; OpenCV writes 12 or 14 for 8, and then the others are zero."""


@dataclass(frozen=True, eq=False)
class DeviceCalibration:
    """What a calibration file holds.

    width, height: resolution [px]. intrinsic [px]: shape (3, 3), as Gomes 2016, eq. 2.9.
    distortion: k1, k2, p1, p2, k3 to k6, shape (8,). rotation, shape (3, 3), and translation [m],
    shape (3,), from the mocap frame to the device's; None where the file has neither.
    """

    width: int
    height: int
    intrinsic: FloatArray
    distortion: FloatArray
    rotation: FloatArray | None = None
    translation: FloatArray | None = None


def read_calibration(path: Path) -> DeviceCalibration:
    """Read a calibration; raises FormatError, which names the file and what is wrong in it."""
    entries = _Entries(path)
    width, height = entries.resolution()
    rotation, translation = entries.rotation(), entries.numbers(TRANSLATION, 3)
    if (rotation is None) != (translation is None):
        there, missing = ('translation', 'rotation')[:: 1 if rotation is None else -1]
        raise FormatError(f'{path}: has a {there} but no {missing}; they go together')
    return DeviceCalibration(
        width, height, entries.intrinsic(), entries.distortion(), rotation, translation
    )


def write_calibration(path: Path, calibration: DeviceCalibration, error: float) -> None:
    """Write what OpenCV and `read_calibration` read; error: mean of the reprojection [px]."""
    lines = [
        '%YAML:1.0',
        '---',
        f'image_width: {calibration.width}',
        f'image_height: {calibration.height}',
        f'avg_reprojection_error: {float(error)!r}',
    ]
    for name, matrix in (
        ('camera_matrix', calibration.intrinsic),
        ('distortion_coefficients', calibration.distortion),
        ('R', calibration.rotation),
        ('T', calibration.translation),
    ):
        if matrix is not None:
            rows = matrix.reshape(len(matrix), -1)
            numbers = ', '.join(repr(float(number)) for number in rows.ravel())
            lines += [
                f'{name}: !!opencv-matrix',
                f'   rows: {rows.shape[0]}',
                f'   cols: {rows.shape[1]}',
                '   dt: d',
                f'   data: [ {numbers} ]',
            ]
    with writing(path):
        path.write_text('\n'.join(lines) + '\n', encoding='utf-8')


class _Entries:
    """The entries of a file, by names without regard to case and underscores."""

    def __init__(self, path: Path) -> None:
        self._path = path
        document = parse(path)
        if not isinstance(document, Mapping):
            raise FormatError(f'{path}: not a calibration: no names with values at the top')
        self._entries = {_plain(str(key)): (str(key), document[key]) for key in document}

    def _find(self, names: tuple[str, ...]) -> tuple[str, Any]:
        """Return the name as the file spells it and the value, or the first name and None."""
        found = (self._entries.get(_plain(name)) for name in names)
        return next((entry for entry in found if entry is not None), (names[0], None))

    def _flaw(self, name: str, text: str) -> FormatError:
        return FormatError(f'{self._path}: {name}: {text}')

    def numbers(self, names: tuple[str, ...], *counts: int) -> FloatArray | None:
        """Return the numbers of an entry, or None where there is none of these names."""
        name, value = self._find(names)
        if value is None:
            return None
        data = value.get('data') if isinstance(value, Mapping) else value
        try:
            found = np.array([] if data is None else data, dtype=float).ravel()
        except (TypeError, ValueError):
            raise self._flaw(name, 'expected numbers') from None
        if found.size not in counts:
            expected = ' or '.join(map(str, counts))
            raise self._flaw(name, f'expected {expected} numbers, got {found.size}')
        shape = [value.get(side) for side in ('rows', 'cols')] if data is not value else [None]
        fitting = [[3, 3]] if counts == (9,) else [[1, found.size], [found.size, 1]]
        if None not in shape and shape not in fitting:
            expected = '{} x {}'.format(*fitting[0])
            raise self._flaw(name, f'expected {expected}, got {shape[0]} x {shape[1]}')
        if not np.isfinite(found).all():
            raise self._flaw(name, 'a number is not finite')
        return found

    def resolution(self) -> tuple[int, int]:
        """Width and height [px]."""
        name, size = self._find(('image_size',))
        if size is not None:
            if not isinstance(size, list) or len(size) != 2:
                raise self._flaw(name, f'expected width and height, got {size!r}')
            pair = [(name, size[0]), (name, size[1])]
        else:
            pair = [self._find(('image_width',)), self._find(('image_height',))]
        for name, value in pair:
            if value is None:
                raise self._flaw(name, 'missing: the file tells no resolution')
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise self._flaw(name, f'expected a whole number of pixels, got {value!r}')
        return pair[0][1], pair[1][1]

    def intrinsic(self) -> FloatArray:
        """Focal lengths, skew and principal point, shape (3, 3)."""
        name = self._find(CAMERA_MATRIX)[0]
        numbers = self.numbers(CAMERA_MATRIX, 9)
        if numbers is None:
            raise self._flaw(name, 'missing')
        matrix = numbers.reshape(3, 3)
        if np.tril(matrix, -1).any() or matrix[2, 2] != 1:
            raise self._flaw(name, 'below its diagonal are no zeros, or its last row is not 0 0 1')
        if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise self._flaw(name, 'singular or mirrored: focal lengths must be above 0')
        return matrix

    def distortion(self) -> FloatArray:
        """Coefficients of the lens, shape (8,)."""
        name, model = self._find(('distortion_model',))
        if model not in (None, '', *MODELS):
            raise self._flaw(name, f'{model!r} is not one of {", ".join(MODELS)}')
        name = self._find(DISTORTION)[0]
        found = self.numbers(DISTORTION, *LENS_COUNTS, 12, 14)
        if found is None:
            return np.zeros(8)
        if found[8:].any():
            raise self._flaw(
                name, f'models with {found.size} coefficients are not supported: at most 8'
            )
        return np.pad(found[:8], (0, 8 - len(found[:8])))

    def rotation(self) -> FloatArray | None:
        """Rotation matrix, shape (3, 3), of a matrix or a rotation vector."""
        matrix = self.numbers(ROTATION, 9)
        if matrix is not None:
            return matrix.reshape(3, 3)
        vector = self.numbers(ROTATION_VECTOR, 3)
        return None if vector is None else np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _plain(name: str) -> str:
    return name.replace('_', '').lower()
