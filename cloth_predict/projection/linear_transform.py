"""A first guess of a projector from pairs of points and pixels: the direct linear transform.

Hartley and Zisserman 2004, Multiple View Geometry, algorithm 7.1 and section 6.2.4.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TypeAlias

import numpy as np
from scipy.linalg import rq

from cloth_predict.errors import ClothPredictError
from cloth_predict.types import FloatArray

Guess: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Camera matrix [px], shape (3, 3), rotation, (3, 3), translation [m], (3,)."""

FLAT = 2e-3
"""Share of the spread of points within which they count as a plane: the noise of a mocap."""
MEAGRE = 1e-9


class _MirroredError(ClothPredictError):
    pass


def first_guess(points: FloatArray, pixels: FloatArray) -> Guess:
    """As `linear_transform`, but one mistyped pair does not make a picture count as mirrored."""
    try:
        return linear_transform(points, pixels)
    except _MirroredError:
        guesses = []
        for pair in range(len(points) if len(points) > 6 else 0):
            with suppress(ClothPredictError):
                rest = np.delete(points, pair, axis=0), np.delete(pixels, pair, axis=0)
                guesses.append(linear_transform(*rest))
        if not guesses:
            raise
        return min(guesses, key=lambda guess: _misfit(guess, points, pixels))


def _misfit(guess: Guess, points: FloatArray, pixels: FloatArray) -> float:
    """Median distance from pixel to pixel [px]; infinite behind the projector."""
    intrinsic, rotation, translation = guess
    local = points @ rotation.T + translation
    depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
    away = np.linalg.norm((local / depth) @ intrinsic[:2].T - pixels, axis=1)
    return float(np.median(np.where(np.isfinite(away), away, np.inf)))


def linear_transform(points: FloatArray, pixels: FloatArray) -> Guess:
    """Camera matrix, shape (3, 3), rotation, (3, 3), and translation [m], (3,), without a lens.

    points [m], shape (n, 3), pixels, shape (n, 2), n >= 6. Raises ClothPredictError where they
    determine none: points in a plane, too few different ones, a mirrored picture.
    """
    centred = points - points.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[2] <= FLAT * spread[0]:
        raise ClothPredictError(
            'all points lie in a plane, and a plane does not determine a projector: take pairs at '
            'several depths'
        )
    to_points, to_pixels = _normalising(points), _normalising(pixels)
    world = _homogeneous(points) @ to_points.T
    image = _homogeneous(pixels) @ to_pixels.T
    nothing = np.zeros_like(world)
    # image x (P world) = 0, two rows for each pair
    rows = np.concatenate(
        [np.hstack([world, nothing, -image[:, :1] * world]),
         np.hstack([nothing, world, -image[:, 1:2] * world])]
    )  # fmt: skip
    _, weights, vectors = np.linalg.svd(rows)
    if weights[10] <= MEAGRE * weights[0]:
        raise ClothPredictError(
            'the pairs do not determine a projector: too few different points or pixels'
        )
    matrix = np.linalg.solve(to_pixels, vectors[-1].reshape(3, 4)) @ to_points
    return _parts(matrix, points)


def _parts(matrix: FloatArray, points: FloatArray) -> Guess:
    """Part a projection matrix, shape (3, 4), of any scale into F, R, t (Gomes 2016, eq. 2.10)."""
    # the scale's sign is such that the points are before the projector
    matrix = matrix * np.sign(np.median(_homogeneous(points) @ matrix[2]))
    if np.linalg.det(matrix[:, :3]) < 0:
        raise _MirroredError(
            'the picture is mirrored, or pairs are mistyped; for a projector that mirrors its '
            'picture by itself, give its throw'
        )
    upper, rotation = rq(matrix[:, :3])
    signs = np.sign(np.diag(upper))
    upper, rotation = upper * signs, signs[:, None] * rotation
    return upper / upper[2, 2], rotation, np.linalg.solve(upper, matrix[:, 3])


def _homogeneous(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])


def _normalising(points: FloatArray) -> FloatArray:
    """Similarity that moves points to the origin, at a mean distance of sqrt(dimensions)."""
    centre, size = points.mean(axis=0), points.shape[1]
    distance = np.linalg.norm(points - centre, axis=1).mean()
    scale = np.sqrt(size) / distance if distance else 1.0
    found = np.eye(size + 1) * scale
    found[:size, size], found[size, size] = -scale * centre, 1
    return found
