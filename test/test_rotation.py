"""Rotations by quaternions of any length: scipy's, central differences, the angular velocity."""

import numpy as np
import pytest
from references import central_differences
from scipy.spatial.transform import Rotation

from cloth_predict.models import rotation


@pytest.fixture
def moving():
    """A quaternion of length 1.7 and its rate."""
    rng = np.random.default_rng(1)
    theta = rng.normal(size=4)
    return 1.7 * theta / np.linalg.norm(theta), rng.normal(size=4)


def kept_length(theta, rate):
    """The unit quaternion of theta, and that part of the rate which keeps its length."""
    unit = theta / np.linalg.norm(theta)
    return unit, rate - unit * (unit @ rate)


def test_the_matrix_is_that_of_scipy_at_any_length(moving):
    theta, _ = moving
    expected = Rotation.from_quat(np.roll(theta, -1)).as_matrix()
    np.testing.assert_allclose(rotation.matrix(theta), expected, atol=1e-14)  # rounding
    np.testing.assert_allclose(rotation.matrix(-0.2 * theta), expected, atol=1e-14)


def test_derivatives_equal_central_differences(moving):
    theta, rate = moving
    # errors of a step of 1e-5: its square, and rounding by it
    at = {'atol': 1e-9}
    expected = central_differences(lambda t: rotation.matrix(t).ravel(), theta, 1e-5)
    np.testing.assert_allclose(rotation.derivative(theta).reshape(9, 4), expected, **at)
    expected = central_differences(
        lambda t: rotation.matrix(theta + t[0] * rate).ravel(), np.zeros(1), 1e-5
    )
    np.testing.assert_allclose((rotation.derivative(theta) @ rate).reshape(9, 1), expected, **at)
    expected = central_differences(
        lambda t: (rotation.derivative(theta + t[0] * rate) @ rate).ravel(), np.zeros(1), 1e-5
    )
    np.testing.assert_allclose(rotation.second_rate(theta, rate).reshape(9, 1), expected, **at)


def test_the_curvature_is_the_derivative_of_the_slope(moving):
    theta, _ = moving
    weight = np.random.default_rng(2).normal(size=(3, 3))
    expected = central_differences(
        lambda t: np.einsum('ab,abk->k', weight, rotation.derivative(t)), theta, 1e-5
    )
    # errors of a step of 1e-5
    np.testing.assert_allclose(rotation.curvature(theta, weight), expected, atol=1e-9)


def test_b_is_the_derivative_of_the_turned_points(moving):
    theta, _ = moving
    points = np.random.default_rng(3).normal(size=(5, 3))
    expected = central_differences(
        lambda t: (points @ rotation.matrix(t).T).ravel(), theta, 1e-5
    ).reshape(5, 3, 4)
    # errors of a step of 1e-5
    np.testing.assert_allclose(rotation.turned_jacobian(theta, points), expected, atol=1e-9)


def test_q_gives_the_angular_velocity_in_the_inertial_frame(moving):
    """Metaxas & Terzopoulos 1993, eq. 45 and 46, are right: R' R' = [omega]x."""
    theta, rate = kept_length(*moving)
    omega = rotation.rate_map(theta) @ rate
    spin = rotation.derivative(theta) @ rate @ rotation.matrix(theta).T
    np.testing.assert_allclose(spin, np.cross(omega, np.eye(3)).T, atol=1e-14)  # rounding


def test_b_turns_points_by_the_angular_velocity(moving):
    theta, rate = kept_length(*moving)
    points = np.random.default_rng(3).normal(size=(5, 3))
    omega = rotation.rate_map(theta) @ rate
    expected = np.cross(omega, points @ rotation.matrix(theta).T)
    # rounding
    np.testing.assert_allclose(
        rotation.turned_jacobian(theta, points) @ rate, expected, atol=1e-14
    )


def test_a_change_of_length_turns_nothing(moving):
    theta, _ = moving
    np.testing.assert_allclose(rotation.derivative(theta) @ theta, 0.0, atol=1e-15)  # rounding


def test_the_quaternion_of_a_matrix(moving):
    theta, _ = moving
    there = rotation.matrix(theta)
    back = rotation.from_matrix(there)
    assert back[0] >= 0.0
    np.testing.assert_allclose(np.linalg.norm(back), 1.0, atol=1e-15)  # rounding
    np.testing.assert_allclose(rotation.matrix(back), there, atol=1e-14)  # rounding
