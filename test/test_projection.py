"""The projector: pixels and rays against homogeneous coordinates, OpenCV and closed forms."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import ProjectorConfig, build
from cloth_predict.errors import ConfigError
from cloth_predict.projection.lens import REACH, Lens
from cloth_predict.projection.pinhole import Pinhole

LENSES = [
    (-0.21, 0.06, 0.0012, -0.0021),
    (-0.21, 0.06, 0.0012, -0.0021, -0.008),
    (0.11, -0.05, 0.0012, -0.0021, 0.02, 0.31, -0.04, 0.01),
]


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


def test_a_mirrored_rotation_is_refused_with_what_to_do_instead():
    config = ProjectorConfig(rotation=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0))
    with pytest.raises(ConfigError, match=r'projector\.rotation: .*mirrors.*projector\.throw'):
        Pinhole.from_config(config)


@pytest.mark.parametrize('count', [1, 2, 3, 6, 7, 9, 12, 14])
def test_a_lens_of_an_unknown_number_of_coefficients_is_refused(count):
    config = ProjectorConfig(distortion=(0.01,) * count)
    with pytest.raises(ConfigError, match=rf'projector\.distortion: expected 4, 5 or 8.*{count}'):
        Pinhole.from_config(config)


@pytest.mark.parametrize(
    ('name', 'value'),
    [('width', 0), ('height', -1), ('alpha', 0.0), ('beta', -1400.0), ('fps', 0), ('fps', -60.0)],
)
def test_nothing_that_has_to_be_positive_may_be_zero(name, value):
    with pytest.raises(ConfigError, match=rf'projector\.{name}: '):
        build({'projector': {name: value}}, 'here')


@pytest.mark.parametrize('distortion', LENSES, ids=len)
def test_pixels_with_a_lens_equal_those_of_opencv(turned, distortion):
    config = replace(turned, gamma=0.0, distortion=distortion)  # OpenCV has no skew
    pinhole = Pinhole.from_config(config)
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (50, 3))
    vector = cv2.Rodrigues(pinhole.rotation)[0]
    expected, _ = cv2.projectPoints(
        points, vector, pinhole.translation, pinhole.intrinsic, np.array(distortion)
    )
    found = pinhole.project(points)
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-9)  # rounding of 1e3 px, by vector
    without = Pinhole.from_config(replace(config, distortion=())).project(points)
    assert np.abs(found - without).max() > 5  # px: the lens matters


@pytest.mark.parametrize('distortion', LENSES, ids=len)
def test_rays_with_a_lens_equal_those_of_opencv(distortion):
    upright = ProjectorConfig(distortion=distortion, rotation=tuple(np.eye(3).ravel()))
    pinhole = Pinhole.from_config(upright)
    pixels = np.random.default_rng(4).uniform([0, 0], [1280, 720], (50, 2))
    # OpenCV 4 iterates to a precision of its own choice, OpenCV 5 to the one that is asked for
    undistort = getattr(cv2, 'undistortPointsIter', cv2.undistortPoints)
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    arguments = (pixels[:, None], pinhole.intrinsic, np.array(distortion))
    if undistort is cv2.undistortPoints:
        expected = undistort(*arguments, criteria=exact)
    else:
        expected = undistort(*arguments, None, None, exact)
    _, directions = pinhole.rays(pixels)
    found = directions[:, :2] / directions[:, 2:]
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-10)  # where its iteration ends


@pytest.mark.parametrize('throw', ['front', 'rear', 'ceiling', 'ceiling_rear'])
@pytest.mark.parametrize('distortion', [(), *LENSES], ids=len)
def test_rays_lead_back_to_the_points(turned, distortion, throw):
    rounded = tuple(np.round(turned.rotation, 3))  # not orthogonal
    config = replace(turned, distortion=distortion, throw=throw, rotation=rounded)
    pinhole = Pinhole.from_config(config)
    points = np.random.default_rng(5).uniform(-0.5, 0.5, (6, 7, 3))
    origin, directions = pinhole.rays(pinhole.project(points))
    away = points - origin
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, rtol=1e-15)  # rounding
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    # Newton's method ends at 1e-12 of a distance of 3 m, or less
    np.testing.assert_allclose(origin + distance * directions, points, atol=1e-11)
    np.testing.assert_allclose(pinhole.depth(origin), 0, atol=1e-15)  # rounding
    ahead = origin + 1.7 * pinhole.rotation[2]
    across = pinhole.rotation[2] @ pinhole.rotation[2]  # 1 but for the rounding of the rotation
    assert pinhole.depth(ahead) == pytest.approx(1.7 * across, rel=1e-14)  # rounding


def test_what_the_projector_mirrors_by_itself_is_mirrored_in_the_frame(turned):
    points = np.random.default_rng(6).uniform(-0.5, 0.5, (9, 3))
    config = replace(turned, distortion=LENSES[0])
    u, v = Pinhole.from_config(config).project(points).T
    for throw, expected in (
        ('rear', (1279 - u, v)),
        ('ceiling', (1279 - u, 719 - v)),
        ('ceiling_rear', (u, 719 - v)),
    ):
        found = Pinhole.from_config(replace(config, throw=throw)).project(points)
        np.testing.assert_allclose(found.T, expected, atol=1e-10)  # rounding of 1e3 px


def test_the_frame_reaches_half_a_pixel_beyond_the_centres_of_its_pixels():
    pinhole = Pinhole.from_config(ProjectorConfig())
    inside = [[-0.5, 0], [1279.49, 719.49], [640, -0.5], [0, 0]]
    outside = [[-0.51, 0], [1279.5, 0], [0, 719.5], [0, -0.51], [np.nan, np.nan], [640, np.nan]]
    assert pinhole.inside(np.array(inside)).all()
    assert not pinhole.inside(np.array(outside)).any()
    assert pinhole.inside(np.zeros((2, 3, 2))).shape == (2, 3)


def test_a_lens_ends_where_its_model_folds_back():
    # r (1 - 0.3 r^2) has its maximum of 2 r / 3 at r^2 = 1 / 0.9
    lens = Lens(np.array([-0.3, 0, 0, 0, 0, 0, 0, 0]))
    assert lens.limit == pytest.approx(0.9**-0.5, rel=1e-12)  # a root of a line
    config = ProjectorConfig(distortion=(-0.3, 0.0, 0.0, 0.0), rotation=tuple(np.eye(3).ravel()))
    pinhole = Pinhole.from_config(replace(config, translation=(0.0, 0.0, 0.0)))
    across = np.array([0, 0.5, 1.05, 1.06, 2.0])
    points = np.column_stack([across, 0 * across, np.ones(5)])
    found = pinhole.project(points)
    # at r = 2 the model says 560 px to the left of the middle, not far to its right
    assert np.isnan(found[3:]).all()
    assert (np.diff(found[:3, 0]) > 0).all()
    edge = 640 + 1400 * 2 / 3 * 0.9**-0.5
    _, directions = pinhole.rays(np.array([[edge - 0.1, 360], [edge + 0.1, 360]]))
    assert np.isfinite(directions[0]).all()
    assert np.isnan(directions[1]).all()


@pytest.mark.parametrize(
    ('coefficients', 'expected'),
    [
        ((0, 0, 0, 0.01, 0), 1 / 0.06),  # x + 3 p2 x^2 turns round at -1 / (6 p2)
        ((0, 0, -0.01, 0, 0), 1 / 0.06),  # y + 3 p1 y^2
        ((0.1, 0, 0, 0, 0), REACH),  # grows for ever
        ((0, 0, 0, 0, 0, -0.25), 2),  # r / (1 - r^2 / 4) has a pole
        ((0, 0, 0, 0, 0, 0.25), 2),  # r / (1 + r^2 / 4) has its maximum at 2
    ],
)
def test_the_limit_of_a_lens_of_one_term(coefficients, expected):
    limit = Lens(np.pad(np.array(coefficients, float), (0, 8 - len(coefficients)))).limit
    # tangential terms are looked at a thousandth of the reach at a time
    assert 0 <= expected - limit <= 1e-3 * REACH


@pytest.mark.parametrize(
    'distortion', [*LENSES, (-0.3, 0.02, 0.02, -0.03), (0, 0, 0, 0, 0, -0.25)], ids=str
)
def test_within_its_limit_a_lens_is_one_to_one(distortion):
    lens = Lens(np.pad(distortion, (0, 8 - len(distortion))))
    rng = np.random.default_rng(7)
    reach = 0.998 * min(lens.limit, 2.0)
    angle, radius = rng.uniform(0, 2 * np.pi, 500), reach * np.sqrt(rng.uniform(size=500))
    points = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    step = 1e-6
    across, down = (
        (lens.distort(points + side) - lens.distort(points - side)) / (2 * step)
        for side in step * np.eye(2)
    )
    assert (across[:, 0] * down[:, 1] > across[:, 1] * down[:, 0]).all()
    # near the limit a pixel of 1e-10 is as much as 1e-8 of the coordinates
    np.testing.assert_allclose(lens.undistort(lens.distort(points)), points, atol=1e-7)
