"""The projector as an inverse camera (Gomes 2016, section 2.2.2), with a lens."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cloth_predict.config import ProjectorConfig
from cloth_predict.errors import ConfigError, FormatError
from cloth_predict.formats.calibration_file import LENS_COUNTS, read_calibration
from cloth_predict.projection.lens import Lens
from cloth_predict.types import BoolArray, FloatArray

MIRRORS = {
    'front': (False, False),
    'rear': (True, False),
    'ceiling': (True, True),
    'ceiling_rear': (False, True),
}
"""Whether the projector mirrors its picture across, and down, by throw."""


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A projector without time: from points [m] in the mocap frame to pixels [px] and back.

    intrinsic: F, focal lengths, skew and principal point [px], shape (3, 3) (Gomes 2016, eq. 2.9).
    rotation, translation [m]: from the mocap frame to the projector's, shapes (3, 3) and (3,).
    distortion: k1, k2, p1, p2, k3 to k6 of OpenCV, shape (8,). width, height: resolution [px].
    throw: what the projector does to its picture by itself; pixels are those of the picture that
    it is given, before that.
    """

    intrinsic: FloatArray
    rotation: FloatArray
    translation: FloatArray
    distortion: FloatArray
    width: int
    height: int
    throw: str = 'front'
    _lens: Lens | None = field(init=False)
    _frame: FloatArray = field(init=False)
    _linear: FloatArray = field(init=False)
    _offset: FloatArray = field(init=False)

    @classmethod
    def from_config(cls, config: ProjectorConfig) -> Pinhole:
        """Build from the configuration and the file of `calibration`, if it names one.

        Raises ConfigError, which names the parameter, or FormatError, which names the file.
        """
        if config.calibration:
            return cls._from_file(config)
        if len(config.distortion) not in LENS_COUNTS:
            raise ConfigError(
                f'projector.distortion: expected 4, 5 or 8 coefficients, or none, got '
                f'{len(config.distortion)}'
            )
        intrinsic = [[config.alpha, config.gamma, config.u0], [0, config.beta, config.v0]]
        return cls(
            np.array([*intrinsic, [0, 0, 1]], dtype=float),
            _rotation_of(config),
            np.array(config.translation),
            np.pad(config.distortion, (0, 8 - len(config.distortion))),
            config.width,
            config.height,
            config.throw,
        )

    @classmethod
    def _from_file(cls, config: ProjectorConfig) -> Pinhole:
        path = Path(config.calibration)
        found = read_calibration(path)
        rotation, translation = found.rotation, found.translation
        if rotation is None or translation is None:
            rotation, translation = _rotation_of(config), np.array(config.translation)
        elif flaw := flaw_of_rotation(rotation):
            raise FormatError(f'{path}: R: {flaw}')
        return cls(
            found.intrinsic,
            rotation,
            translation,
            found.distortion,
            found.width,
            found.height,
            config.throw,
        )

    def __post_init__(self) -> None:
        frame = mirror(self.throw, self.width, self.height) @ self.intrinsic
        lens = Lens(self.distortion) if self.distortion.any() else None
        # with a lens what is linear ends at the coordinates that the lens distorts
        last = np.eye(3) if lens else frame
        if lens:
            _ = lens.limit  # takes some ms, and not those of the first frame
        object.__setattr__(self, '_lens', lens)
        object.__setattr__(self, '_frame', frame)
        object.__setattr__(self, '_linear', np.ascontiguousarray((last @ self.rotation).T))
        object.__setattr__(self, '_offset', last @ self.translation)

    @property
    def origin(self) -> FloatArray:
        """Position of the projector in the mocap frame [m], shape (3,)."""
        return np.asarray(-np.linalg.solve(self.rotation, self.translation))

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels u, v of points [m], shape (..., 3) to (..., 2) (Gomes 2016, eq. 2.8-2.10).

        NaN behind the projector, and where the model of the lens folds back.
        """
        homogeneous = points @ self._linear + self._offset
        depth = homogeneous[..., 2:]
        found: FloatArray = homogeneous[..., :2] / np.where(depth > 0, depth, np.nan)
        if self._lens is None:
            return found
        return self._lens.distort(found) @ self._frame[:2, :2].T + self._frame[:2, 2]

    @property
    def handedness(self) -> float:
        """Sign of the area in the picture of what turns from u to v on a wall before it."""
        return float(np.sign(np.linalg.det(self._frame[:2, :2])))

    def depth(self, points: FloatArray) -> FloatArray:
        """Distance along the axis [m] of points [m], shape (..., 3) to (...)."""
        return np.asarray(points @ self.rotation[2] + self.translation[2])

    def inside(self, pixels: FloatArray) -> BoolArray:
        """Whether pixels are within the frame, shape (..., 2) to (...); NaN is not."""
        within = (pixels >= -0.5) & (pixels < np.array([self.width, self.height]) - 0.5)
        return np.asarray(within.all(axis=-1))

    def rays(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the light of pixels starts [m], shape (3,), and its directions, shape (..., 3).

        Both in the mocap frame; directions have length 1, and are NaN for pixels to which the lens
        brings no light.
        """
        centred = np.asarray(pixels, dtype=float) - self._frame[:2, 2]
        ideal = centred @ np.linalg.inv(self._frame[:2, :2]).T
        if self._lens is not None:
            ideal = self._lens.undistort(ideal)
        directions = np.empty((*ideal.shape[:-1], 3))
        directions[..., :2], directions[..., 2] = ideal, 1
        # the inverse, not the transpose: a rotation typed with three digits is not orthogonal
        directions = directions @ np.linalg.inv(self.rotation).T
        return self.origin, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def mirror(throw: str, width: int, height: int) -> FloatArray:
    """What the projector does to homogeneous pixels, shape (3, 3); its own inverse."""
    across, down = MIRRORS[throw]
    found = np.eye(3)
    if across:
        found[0] = -1, 0, width - 1
    if down:
        found[1] = 0, -1, height - 1
    return found


def _rotation_of(config: ProjectorConfig) -> FloatArray:
    rotation = np.reshape(config.rotation, (3, 3))
    if flaw := flaw_of_rotation(rotation):
        raise ConfigError(f'projector.rotation: {flaw}')
    return rotation


def flaw_of_rotation(matrix: FloatArray) -> str:
    """Return why a matrix, shape (3, 3), is no rotation, or nothing."""
    # a rotation typed with three digits is accepted, a scaled or sheared one is not
    if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-2):
        return 'not a rotation matrix: its rows are not of length 1 and at right angles'
    if np.linalg.det(matrix) < 0:
        return (
            'not a rotation matrix: it mirrors; where the projector mirrors its picture, tell so '
            'by projector.throw'
        )
    return ''
