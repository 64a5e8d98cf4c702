"""A closed body before the projector: what is lit of it, ray by ray, and with which texture."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import BodyConfig, Config, ModelConfig, ProjectorConfig
from cloth_predict.errors import FrameError
from cloth_predict.models import superquadric_shape
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.projection.field_maps import field_maps
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.visibility import Flag
from cloth_predict.projection.warp import Warper

SEEN = ProjectorConfig(
    width=96,
    height=72,
    alpha=130.0,
    beta=130.0,
    u0=47.6,
    v0=35.3,
    rotation=tuple(np.eye(3).ravel()),
    translation=(0.0, 0.0, 0.0),
)
CENTRE = np.array([0.02, -0.01, 1.0])
EVERY = np.stack(np.meshgrid(np.arange(96), np.arange(72)), axis=-1).reshape(-1, 2) * 1.0
BALL = (0.2, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5)
LONG = (0.26, 0.4, 0.5, 1.0, 0.7, 1.0, 0.5, -0.3, 0.0, 0.0, 0.5)
BANANA = (0.26, 0.3, 0.5, 1.0, 1.0, 1.0, 0.0, 0.0, 0.2, 0.0, 1.0)


def config(nodes=500, **changes):
    model = ModelConfig(kind='superquadric', topology='closed', nodes=nodes)
    return Config(model=model, projector=replace(SEEN, **changes))


def body(q_s, turn, nodes=500):
    """Nodes of a superquadric before the projector, turned by a rotation vector [rad]."""
    coordinates = ClosedMesh.even(nodes).coordinates
    shape = superquadric_shape.positions(np.array(q_s), coordinates)
    shape -= shape.mean(axis=0)
    return Rotation.from_rotvec(turn).apply(shape) + CENTRE


def rendered(q_s, turn, nodes=500, **changes):
    """The warper, what it makes of a still body, and the map, shape (height, width, 2)."""
    position = body(q_s, turn, nodes)
    warper = Warper.of(config(nodes, **changes), position)
    warped = warper.warp(Motion.still(position))
    ((_, image),) = field_maps(warper, warped.keys)
    return warper, warped, image, position


def cast(origin, rays, corners):
    """The distance along each ray to each triangle, infinite beside it, and the corners' shares.

    Shapes (rays, t) and (rays, t, 3) (Moeller and Trumbore 1997).
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    across = np.cross(rays[:, None], c - a)
    det = (across * (b - a)).sum(axis=-1)
    one = (across * (origin - a)).sum(axis=-1) / det
    turned = np.cross(origin - a, b - a)
    two = (turned * rays[:, None]).sum(axis=-1) / det
    far = (turned * (c - a)).sum(axis=-1) / det
    shares = np.stack([1 - one - two, one, two], axis=-1)
    return np.where((shares > 0).all(axis=-1) & (far > 0), far, np.inf), shares


@pytest.mark.parametrize('throw', ['front', 'rear', 'ceiling'])
@pytest.mark.parametrize(
    ('q_s', 'turn'),
    [(LONG, [0.3, 2.0, 0.4]), (LONG, [1.5, 0.0, 1.0]), (BANANA, [0.0, 1.2, 0.5])],
)
def test_each_pixel_has_the_texture_of_the_triangle_that_its_ray_meets_first(q_s, turn, throw):
    warper, _, image, position = rendered(q_s, turn, throw=throw)
    origin, rays = warper.pinhole.rays(EVERY)
    skin = warper.skin
    corners = position[skin.faces]
    far, shares = cast(origin, rays, corners)
    first, pixel = far.argmin(axis=1), np.arange(len(EVERY))
    lit = np.isfinite(far[pixel, first])
    expected = np.einsum('pk,pkc->pc', shares[pixel, first], skin.texture[skin.triangles[first]])
    expected[:, 0] %= 1.0
    found = image.reshape(-1, 2)
    assert lit.sum() > 600
    # a ray along an edge is within one triangle of the map, and of rounding's choice here
    edge = np.abs(shares[pixel, first]).min(axis=1) < 1e-6
    same = np.isfinite(found).all(axis=1) == lit
    assert same[~edge].all()
    off = np.abs(found - expected)[lit & ~edge]
    off[:, 0] = np.minimum(off[:, 0], 1 - off[:, 0])  # s of 0 and 1 are the same
    assert off.max() < 1e-5  # single precision
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = np.einsum('pi,pi->p', outward[first], rays)
    assert (towards[lit] < 0).all()  # only outsides are lit


@pytest.mark.parametrize('turn', [[1.5, 0.0, 0.0], [1.2, 0.0, 3.1], [-1.4, 0.3, 1.5]])
def test_the_picture_on_a_ball_has_no_seam(turn):
    nodes = 4000
    warper, _, image, _ = rendered(BALL, turn, nodes)
    origin, rays = warper.pinhole.rays(EVERY)
    along = rays @ (CENTRE - origin)
    gap = np.linalg.norm(CENTRE - origin) ** 2 - along**2
    radius = 0.2
    lit = gap < (0.95 * radius) ** 2  # within the rim, where the mesh is as round as the ball
    reach = along - np.sqrt(np.maximum(radius**2 - gap, 0))
    normal = (origin + reach[:, None] * rays - CENTRE) / radius
    x, y, z = Rotation.from_rotvec(turn).inv().apply(normal).T
    pole = np.abs(z) > 0.95  # near which no picture goes evenly
    round_it = np.arctan2(y, x) / 2 / np.pi + 0.5
    down = 0.5 - np.arcsin(np.clip(z, -1, 1)) / np.pi
    off = (image.reshape(-1, 2) - np.column_stack([round_it, down]))[lit & ~pole]
    off[:, 0] = (off[:, 0] + 0.5) % 1 - 0.5
    assert len(off) > 800
    # edges of 0.06 radii: a chord is up to 0.06^2 / 8 inside, seen at an angle and stretched by
    # 1 / cos u = 3 at most; a triangle across a seam that is not cut would be off by up to 0.5
    assert np.abs(off).max() < 3e-3


@pytest.mark.parametrize('throw', ['front', 'rear'])
@pytest.mark.parametrize('mirrored', [False, True])
@pytest.mark.parametrize('q_s', [LONG, BANANA])
def test_flags_are_those_of_normals_and_rays(q_s, mirrored, throw):
    warper, warped, _, position = rendered(q_s, [0.0, 1.2, 0.5], throw=throw, mirrored=mirrored)
    skin, flags = warper.skin, warped.flags[0][:500]
    origin = warper.pinhole.origin
    normal = ClosedMesh.even(500).normals(position)
    ray = position - origin
    far = np.linalg.norm(ray, axis=1)
    towards = -np.einsum('ni,ni->n', normal, ray) / far
    clear = np.abs(towards) > 0.15  # at the rim the mesh has edges
    back = (flags & Flag.BACK_FACING).astype(bool)
    np.testing.assert_array_equal(back[clear], (towards < 0)[clear])
    own = (skin.faces[None] == np.arange(500)[:, None, None]).any(axis=-1)
    before, _ = cast(origin, ray / far[:, None], position[skin.faces])
    hidden = (np.where(own, np.inf, before) < (1 - 1e-4) * far[:, None]).any(axis=1)
    np.testing.assert_array_equal((flags & Flag.OCCLUDED).astype(bool), hidden)
    if q_s is BANANA:  # it hides some of its own front
        assert (hidden & ~back).sum() > 10
    visible = flags == 0
    assert 100 < visible.sum() < 300
    np.testing.assert_array_equal(warped.flags[0], flags[skin.source])


def test_a_vertex_that_is_drawn_twice_is_one_node():
    warper, warped, *_ = rendered(LONG, [0.3, 2.0, 0.4])
    skin, mesh = warper.skin, ClosedMesh.even(500)
    np.testing.assert_array_equal(skin.source[:500], np.arange(500))
    np.testing.assert_array_equal(skin.faces, mesh.triangles)
    copies = np.arange(500, len(skin.source))
    assert 20 < len(copies) < 60  # along one meridian of a ball of 500 nodes, and at the poles
    np.testing.assert_array_equal(skin.texture[copies, 0], skin.texture[skin.source[500:], 0] + 1)
    wide = np.ptp(skin.texture[skin.triangles, 0], axis=1)
    pole = np.abs(mesh.coordinates[mesh.triangles, 0]).min(axis=1) > 1.3
    assert wide[~pole].max() < 0.25
    packed = warper.vertices(warped)
    assert packed.shape == (1, len(skin.source))
    for axis in ('x', 'y', 'z', 'u', 'v', 'dt', 'flags'):
        np.testing.assert_array_equal(packed[axis][0], packed[axis][0][skin.source])
    assert warper.scanlines(warped).shape[1] == len(skin.source)


def test_the_texture_goes_to_the_right_and_down_as_the_outside_is_seen():
    # z of the body up, its x axis towards the projector: longitude goes to the right
    up = Rotation.from_matrix([[0, 1, 0], [0, 0, -1], [-1, 0, 0]]).as_rotvec()
    image = rendered(BALL, up)[2]
    middle = image[35, 47]
    assert middle == pytest.approx([0.5, 0.5], abs=0.03)
    assert (np.diff(image[35, 35:60, 0]) > 0).all()
    assert (np.diff(image[25:45, 47, 1]) > 0).all()
    mirrored = rendered(BALL, up, mirrored=True)[2]
    assert (np.diff(mirrored[35, 35:60, 0]) < 0).all()
    np.testing.assert_array_equal(np.isnan(mirrored), np.isnan(image))


def test_a_body_with_nodes_at_markers_has_the_mesh_of_where_it_starts():
    position = body(LONG, [0.2, 0.1, 0.0], 30)
    at_markers = replace(config(30), body=BodyConfig(mesh='markers'))
    skin = Warper.of(at_markers, position).skin
    assert skin.faces.shape == (56, 3)  # of any closed mesh of 30 nodes: 2 n - 4
    corners = position[skin.faces]
    volume = np.linalg.det(corners - position.mean(axis=0)).sum() / 6
    assert volume > 0  # all outward
    with pytest.raises(FrameError, match='at the centre'):
        Warper.of(at_markers, np.zeros((30, 3)) + np.arange(3))
