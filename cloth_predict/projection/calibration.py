"""Least-squares calibration of a projector from pairs of points and the pixels that light them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cloth_predict.errors import ClothPredictError
from cloth_predict.projection.lens import Lens
from cloth_predict.projection.linear_transform import first_guess
from cloth_predict.projection.pinhole import Pinhole, mirror
from cloth_predict.types import FloatArray

COEFFICIENTS = ('k1', 'k2', 'p1', 'p2', 'k3')
COUNTS = (0, 2, 4, 5)
"""Numbers of coefficients of the lens that can be calibrated."""
POSE = (
    'rotation_x',
    'rotation_y',
    'rotation_z',
    'translation_x',
    'translation_y',
    'translation_z',
)
EVALUATIONS = 200
"""Longest search: most take 5 to 50, one for what the pairs do not tell may never end."""
SUSPECT = 6.0
"""A misfit this many times the median is no noise: of a normal one that is 7 sigma."""
QUIET = 0.25
"""Least median [px] that counts in that: pixels are seldom known better."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A projector, and how well the pairs determine it.

    names, values, sigma: of the parameters, in px for the first four or five, none for the lens,
    rad and m; values of the rotation are its rotation vector, and their sigmas those of a turn
    about the axes of the projector. residuals: pixel by the projector less pixel of the pair
    [px], shape (n, 2). misfits: their lengths [px] by a fit that a mistyped pair does not spoil,
    (n,); infinite for a point that this cannot light. converged: whether the search ended.
    """

    pinhole: Pinhole
    names: tuple[str, ...]
    values: FloatArray
    sigma: FloatArray
    residuals: FloatArray
    misfits: FloatArray
    converged: bool

    @property
    def rms(self) -> float:
        """Root mean square of the distances from pixel to pixel [px], as OpenCV reports it."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))

    @property
    def max(self) -> float:
        """Largest distance [px]."""
        return float(np.linalg.norm(self.residuals, axis=1).max())

    @property
    def suspects(self) -> list[int]:
        """Indices of the pairs that seem mistyped, the worst first."""
        usual = max(float(np.median(self.misfits)), QUIET)
        order = np.argsort(-self.misfits)
        return [int(i) for i in order if self.misfits[i] > SUSPECT * usual]

    def undetermined(self) -> Iterator[str]:
        """Names of the parameters whose sigma is so large that the pairs do not tell them.

        More than 2 % of a focal length, of the resolution, or of the distance, 1 degree, or as
        much as the lens of a projector may have: 0.1, or 0.01 of its tangential terms.
        """
        alpha, distance = self.values[0], float(np.linalg.norm(self.pinhole.translation))
        most = {'alpha': alpha, 'beta': alpha, 'gamma': alpha, 'u0': self.pinhole.width}
        most |= {'v0': self.pinhole.height, 'k': 5.0, 'p': 0.5, 'rotation': 1.0}
        for name, sigma in zip(self.names, self.sigma, strict=True):
            kind = name if name in most else name.rstrip('123_xyz')
            if not sigma <= 0.02 * most.get(kind, distance):
                yield name


def calibrate(
    points: FloatArray,
    pixels: FloatArray,
    width: int,
    height: int,
    throw: str = 'front',
    distortion: int = 0,
    skew: bool = False,
) -> Calibration:
    """Fit a projector to points [m], shape (n, 3), and pixels [px], shape (n, 2).

    distortion: how many of k1, k2, p1, p2, k3 are fitted; skew: whether the skew is, else it is 0.
    A linear guess is refined by least squares of the distances from pixel to pixel; covariances
    are s^2 (J'J)^-1, with s^2 the sum of squares over the degrees of freedom. Raises
    ClothPredictError where the pairs determine no projector.
    """
    names = ('alpha', 'beta', *(['gamma'] if skew else []), 'u0', 'v0')
    names += (*COEFFICIENTS[:distortion], *POSE)
    least = max(6, len(names) // 2 + 1)
    if len(points) < least:
        raise ClothPredictError(
            f'{len(points)} pairs, but {len(names)} parameters and their sigmas need {least}'
        )
    mirrored = mirror(throw, width, height)
    seen = pixels @ mirrored[:2, :2].T + mirrored[:2, 2]
    intrinsic, rotation, translation = first_guess(points, seen)
    start = _vector(names, intrinsic, translation)
    misses = partial(_misses, names, rotation, points, seen)
    # a mistyped pair draws the sum of squares to itself, and less so a sum of distances
    search = partial(least_squares, misses, jac='3-point', x_scale='jac', max_nfev=EVALUATIONS)
    robust = search(start, loss='soft_l1').x
    fit = search(robust, xtol=1e-12, ftol=1e-12)
    pinhole = _pinhole(names, fit.x, rotation, (width, height, throw))
    # not `misses`, which knows neither what lies behind nor where the lens folds back
    lit = _pinhole(names, robust, rotation, (width, height, throw)).project(points)
    misfits = np.linalg.norm(lit - pixels, axis=1)
    values = fit.x.copy()
    values[-6:-3] = Rotation.from_matrix(pinhole.rotation).as_rotvec()
    return Calibration(
        pinhole,
        names,
        values,
        _sigma(fit.jac, fit.fun),
        fit.fun.reshape(-1, 2),
        np.where(np.isfinite(misfits), misfits, np.inf),
        fit.status > 0,
    )


def _vector(names: tuple[str, ...], intrinsic: FloatArray, translation: FloatArray) -> FloatArray:
    """Parameters, of which those of the rotation turn on the one of the guess."""
    known = {
        'alpha': intrinsic[0, 0],
        'beta': intrinsic[1, 1],
        'gamma': intrinsic[0, 1],
        'u0': intrinsic[0, 2],
        'v0': intrinsic[1, 2],
    }
    known |= dict(zip(POSE[3:], translation, strict=True))
    return np.array([known.get(name, 0.0) for name in names])


def _unpack(
    names: tuple[str, ...], values: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Camera matrix, coefficients of the lens, rotation and translation of parameters."""
    given = dict(zip(names, values, strict=True))
    intrinsic = np.array(
        [
            [given['alpha'], given.get('gamma', 0.0), given['u0']],
            [0, given['beta'], given['v0']],
            [0, 0, 1],
        ]
    )
    lens = np.zeros(8)
    lens[:5] = [given.get(name, 0.0) for name in COEFFICIENTS]
    turned = Rotation.from_rotvec(values[-6:-3]).as_matrix() @ rotation
    return intrinsic, lens, turned, values[-3:]


def _pinhole(
    names: tuple[str, ...],
    values: FloatArray,
    rotation: FloatArray,
    frame: tuple[int, int, str],
) -> Pinhole:
    intrinsic, lens, turned, translation = _unpack(names, values, rotation)
    return Pinhole(intrinsic, turned, translation, lens, *frame)


def _misses(
    names: tuple[str, ...],
    rotation: FloatArray,
    points: FloatArray,
    pixels: FloatArray,
    values: FloatArray,
) -> FloatArray:
    """Pixels by the parameters less those that were seen [px], shape (2 n,)."""
    intrinsic, lens, turned, translation = _unpack(names, values, rotation)
    local = points @ turned.T + translation
    ideal = local[:, :2] / local[:, 2:]
    bent = Lens(lens).bend(ideal, (ideal * ideal).sum(axis=-1))
    return np.asarray(bent @ intrinsic[:2, :2].T + intrinsic[:2, 2] - pixels).ravel()


def _sigma(jacobian: FloatArray, misses: FloatArray) -> FloatArray:
    """Standard deviations of the parameters; infinite where the pairs do not tell them."""
    variance = misses @ misses / (len(misses) - jacobian.shape[1])
    scale = np.linalg.norm(jacobian, axis=0)
    _, weights, vectors = np.linalg.svd(
        jacobian / np.where(scale > 0, scale, 1), full_matrices=False
    )
    inverse = vectors.T / np.maximum(weights, np.finfo(float).eps * weights[0])
    with np.errstate(divide='ignore'):
        return np.asarray(np.sqrt(variance * (inverse**2).sum(axis=1)) / scale)
