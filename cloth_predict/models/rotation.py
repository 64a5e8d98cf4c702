"""Rotations by quaternions theta = (s, v) of any length but 0: R is that of theta / |theta|.

Each entry of R is then a quotient of quadratic forms, theta' A theta / theta' theta, which makes
the derivatives short. The functions are analytic in theta, so that complex ones give derivatives.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cloth_predict.types import FloatArray


def _forms() -> FloatArray:
    """A, shape (3, 3, 4, 4), of (s^2 - v'v) I + 2 v v' + 2 s [v]x."""
    identity = np.eye(3)
    forms = np.zeros((3, 3, 4, 4))
    forms[:, :, 0, 0] = identity
    forms[:, :, 1:, 1:] = (
        np.einsum('ai,bj->abij', identity, identity)
        + np.einsum('aj,bi->abij', identity, identity)
        - np.einsum('ab,ij->abij', identity, identity)
    )
    turn = np.cross(identity[:, None], identity)  # e_a x e_b
    forms[:, :, 0, 1:] = forms[:, :, 1:, 0] = -turn
    return forms


FORMS = _forms()


def matrix(theta: FloatArray) -> FloatArray:
    """R, shape (3, 3), from the frame of the body to the inertial one."""
    return np.asarray(FORMS @ theta @ theta / (theta @ theta))


def derivative(theta: FloatArray) -> FloatArray:
    """Derivative of R by theta, shape (3, 3, 4)."""
    along = FORMS @ theta - matrix(theta)[:, :, None] * theta
    return np.asarray(2.0 * along / (theta @ theta))


def second_rate(theta: FloatArray, rate: FloatArray) -> FloatArray:
    """R'' [1/s^2], shape (3, 3), while theta changes at a steady rate [1/s]."""
    first = derivative(theta) @ rate
    along = FORMS @ rate @ rate - matrix(theta) * (rate @ rate) - 2.0 * first * (theta @ rate)
    return np.asarray(2.0 * along / (theta @ theta))


def curvature(theta: FloatArray, weight: FloatArray) -> FloatArray:
    """Second derivative of the sum of weight * R, both (3, 3), by theta, shape (4, 4)."""
    slope = np.einsum('ab,abk->k', weight, derivative(theta))
    form = np.einsum('ab,abkl->kl', weight, FORMS) - np.sum(weight * matrix(theta)) * np.eye(4)
    cross = np.outer(theta, slope)
    return np.asarray(2.0 * (form - cross - cross.T) / (theta @ theta))


def turned_jacobian(theta: FloatArray, p: FloatArray) -> FloatArray:
    """B, the derivative of R p by theta, (N, 3, 4), of points p, (N, 3) (M. & T. 1993, eq. 7)."""
    return np.asarray(np.einsum('abk,nb->nak', derivative(theta), p))


def rate_map(theta: FloatArray) -> FloatArray:
    """Q, shape (3, 4): the angular velocity in the inertial frame is Q theta' (eq. 46).

    That is so for a unit quaternion whose length stays.
    """
    s, (a, b, c) = theta[0], theta[1:]
    return np.asarray(2.0 * np.array([[-a, s, -c, b], [-b, c, s, -a], [-c, -b, a, s]]))


def nearest(matrix: FloatArray) -> FloatArray:
    """The rotation nearest to a matrix, both (3, 3), by the sum of squares (Kabsch 1976)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def from_matrix(rotation: FloatArray) -> FloatArray:
    """The unit quaternion (s, v), s >= 0, of a rotation matrix, shape (4,)."""
    x, y, z, s = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([s, x, y, z])
