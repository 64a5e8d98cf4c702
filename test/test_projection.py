"""The projector: pixels against homogeneous coordinates, and when each row is drawn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import ProjectorConfig
from cloth_predict.errors import ConfigError
from cloth_predict.projection.pinhole import Pinhole


@pytest.fixture
def turned():
    """A projector with skew and a general rotation."""
    rotation = Rotation.from_rotvec([0.3, 2.8, -0.2]).as_matrix()
    return ProjectorConfig(
        alpha=1500.0,
        beta=1400.0,
        gamma=2.5,
        u0=620.0,
        v0=350.0,
        rotation=tuple(rotation.ravel()),
        translation=(0.1, -0.2, 2.5),
    )


def test_pixels_equal_homogeneous_coordinates(turned):
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (4, 3, 3))
    found = Pinhole.from_config(turned).project(points)
    assert found.shape == (4, 3, 2)
    rotation = np.reshape(turned.rotation, (3, 3))
    for index in np.ndindex(4, 3):
        # Gomes 2016, eq. 2.8-2.10, one coordinate at a time
        x, y, z = rotation @ points[index] + turned.translation
        u = turned.alpha * x / z + turned.gamma * y / z + turned.u0
        v = turned.beta * y / z + turned.v0
        np.testing.assert_allclose(found[index], [u, v], rtol=1e-13)  # rounding


def test_the_default_projector_sees_the_towel_upright():
    # 2.2 m before its middle (0.255, 1.1, 0): x to the right, y up, pixel rows down
    pinhole = Pinhole.from_config(ProjectorConfig())
    points = np.array([[0.255, 1.1, 0.0], [0.475, 1.1, 0.0], [0.255, 1.32, 0.0]])
    # 0.22 m at 2.2 m are a tenth of the focal length of 1400 px; rounding of 1e3 px
    expected = [[640, 360], [780, 360], [640, 220]]
    np.testing.assert_allclose(pinhole.project(points), expected, atol=1e-10)


def test_points_behind_or_beside_the_projector_are_nan():
    pinhole = Pinhole.from_config(ProjectorConfig())
    points = np.array([[0.255, 1.1, 2.3], [0.0, 0.0, 2.2], [0.255, 1.1, 2.1]])
    found = pinhole.project(points)
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2], [640, 360], atol=1e-10)  # rounding of 1e3 px
    assert np.isnan(pinhole.project(np.full(3, np.nan))).all()


@pytest.mark.parametrize(
    'rotation',
    [
        np.diag([1.0, 1.0, -1.0]),  # mirrored
        2 * np.eye(3),
        np.zeros((3, 3)),
        [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]],  # sheared
    ],
)
def test_a_matrix_that_is_no_rotation_is_refused(rotation):
    config = ProjectorConfig(rotation=tuple(np.ravel(rotation)))
    with pytest.raises(ConfigError, match=r'projector\.rotation'):
        Pinhole.from_config(config)


def test_a_rotation_of_three_digits_is_accepted(turned):
    rounded = ProjectorConfig(rotation=tuple(np.round(turned.rotation, 3)))
    pinhole = Pinhole.from_config(rounded)
    np.testing.assert_array_equal(pinhole.rotation, np.round(turned.rotation, 3).reshape(3, 3))
