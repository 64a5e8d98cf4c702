"""Flags of the vertices, against rays that are followed one by one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cloth_predict.config import ModelConfig, ProjectorConfig
from cloth_predict.errors import FrameError
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.projection.texture import texture_coordinates
from cloth_predict.projection.visibility import back_facing, occluded, orientation
from cloth_predict.surface.topology import grid_triangles

EYE = Pinhole.from_config(
    ProjectorConfig(rotation=tuple(np.eye(3).ravel()), translation=(0.0, 0.0, 0.0))
)
ROWS, COLS = 7, 6
TRIANGLES = grid_triangles(ROWS, COLS)
GRID = ModelConfig(rows=ROWS, cols=COLS)
TEXTURE = texture_coordinates(GRID, np.zeros((ROWS * COLS, 3)), EYE)
FRONT = orientation(TEXTURE, TRIANGLES)


def sheet(seed, crumpled):
    """A sheet 2 m before the projector: its columns to the right, its rows down."""
    rng = np.random.default_rng(seed)
    flat = np.column_stack([0.5 * TEXTURE, np.full(ROWS * COLS, 2.0)])
    return flat + rng.normal(0, crumpled, flat.shape)


def hit_before(point, vertex, position):
    """Whether the ray to a vertex hits a triangle before it (Moeller and Trumbore 1997)."""
    for triangle in TRIANGLES:
        if vertex in triangle:
            continue
        a, b, c = position[triangle]
        normal = np.cross(point, c - a)
        det = (b - a) @ normal
        if abs(det) < 1e-12:
            continue
        u = -a @ normal / det
        q = np.cross(-a, b - a)
        v, t = point @ q / det, (c - a) @ q / det
        if u > 0 and v > 0 and u + v < 1 and 0 < t < 1 - 1e-4:
            return True
    return False


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('crumpled', [0.0, 0.05, 0.3])
def test_occluded_are_those_whose_ray_meets_the_surface_before(seed, crumpled):
    position = sheet(seed, crumpled)
    found = occluded(EYE.project(position), EYE.depth(position), TRIANGLES)
    expected = [hit_before(point, i, position) for i, point in enumerate(position)]
    assert found.tolist() == expected
    assert any(expected) == (crumpled > 0.1) or crumpled == 0.05


def test_a_folded_sheet_hides_its_far_half():
    position = sheet(0, 0.0).reshape(ROWS, COLS, 3)
    position[4:, :, 1] = position[2:5, :, 1][::-1].copy() - 0.01  # the lower rows are turned up
    position[4:, :, 2] += 0.1  # and behind
    flat = position.reshape(-1, 3)
    pixels, depth = EYE.project(flat), EYE.depth(flat)
    hidden = occluded(pixels, depth, TRIANGLES).reshape(ROWS, COLS)
    assert hidden[5:, 1:-1].all()  # what is at the sides may look out, as it is farther away
    assert not hidden[:4].any()
    back = back_facing(pixels, TRIANGLES, FRONT).reshape(ROWS, COLS)
    assert back[5:].all()
    assert not back[:3].any()


@pytest.mark.parametrize('angle', [0.0, 60.0, 85.0, 95.0, 180.0])
def test_a_sheet_shows_its_back_when_it_is_turned(angle):
    flat = sheet(1, 0.0)
    middle = flat.mean(axis=0)
    turned = Rotation.from_euler('y', angle, degrees=True).apply(flat - middle) + 3 * middle
    # seen along the ray to its middle, which is not the axis
    towards = np.cross(turned[1] - turned[0], turned[COLS] - turned[0]) @ turned[0]
    found = back_facing(EYE.project(turned), TRIANGLES, FRONT)
    assert found.all() == (towards < 0)
    assert found.any() == (towards < 0)
    mirrored = texture_coordinates(GRID, flat, EYE, mirrored=True)
    other = orientation(mirrored, TRIANGLES)
    assert (back_facing(EYE.project(turned), TRIANGLES, other) != found).all()


def test_what_has_no_pixel_hides_nothing():
    position = sheet(2, 0.3)
    position[20, 2] = -1.0
    pixels, depth = EYE.project(position), EYE.depth(position)
    found = occluded(pixels, depth, TRIANGLES)
    assert not found[20]
    assert not back_facing(pixels, TRIANGLES, FRONT)[20]
    assert not occluded(pixels, depth, np.zeros((0, 3), int)).any()


@pytest.mark.parametrize(('depth', 'hidden'), [(1.40, False), (1.44, True), (3.0, True)])
def test_a_slanted_triangle_hides_by_its_depth_in_perspective(depth, hidden):
    # in the middle of its picture it is 3 / (1 + 1 + 1/9) = 1.421 m away, not (1 + 1 + 9) / 3 m
    pixels = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0], [10.0, 10.0]])
    found = occluded(pixels, np.array([1.0, 1.0, 9.0, depth]), np.array([[0, 1, 2]]))
    assert found.tolist() == [False, False, False, hidden]


# --- texture


def test_the_texture_of_a_grid_follows_rows_and_columns():
    found = TEXTURE.reshape(ROWS, COLS, 2)
    np.testing.assert_array_equal(found[..., 0], np.tile(np.linspace(0, 1, COLS), (ROWS, 1)))
    np.testing.assert_array_equal(found[..., 1].T, np.tile(np.linspace(0, 1, ROWS), (COLS, 1)))
    chain = texture_coordinates(ModelConfig(rows=1, cols=3), np.zeros((3, 3)), EYE)
    assert chain.tolist() == [[0, 0], [0.5, 0], [1, 0]]
    mirrored = texture_coordinates(ModelConfig(rows=1, cols=3), np.zeros((3, 3)), EYE, True)
    assert mirrored.tolist() == [[1, 0], [0.5, 0], [0, 0]]


def test_the_texture_of_a_mesh_lies_as_the_projector_sees_it():
    model = ModelConfig(topology='delaunay', rest_length='measured', nodes=4)
    position = np.array([[-0.1, -0.2, 2.0], [0.3, -0.2, 2.0], [-0.1, 0.2, 2.0], [0.1, 0.1, 2.0]])
    expected = [[0, 0], [1, 0], [0, 1], [0.5, 0.75]]
    found = texture_coordinates(model, position, EYE)
    np.testing.assert_allclose(found, expected, atol=1e-12)  # rounding
    position[1, 2] = -2.0
    with pytest.raises(FrameError, match='does not see the whole surface'):
        texture_coordinates(model, position, EYE)
