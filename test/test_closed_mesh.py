"""Closed meshes: Euler's formula, orientation, normals, and nodes where the markers are."""

import numpy as np
import pytest
from references import order_of
from scipy.spatial.transform import Rotation

from cloth_predict.errors import ConfigError
from cloth_predict.models import superquadric_shape
from cloth_predict.models.closed_mesh import ClosedMesh

SEMI_AXES = np.array([0.3, 0.2, 0.5])


@pytest.mark.parametrize('nodes', [4, 5, 27, 36, 49, 81, 123])
def test_any_number_of_nodes_makes_a_closed_surface(nodes):
    mesh = ClosedMesh.even(nodes)
    assert len(mesh) == nodes
    # Euler's formula, of triangles on a sphere
    assert len(mesh.triangles) == 2 * nodes - 4
    sides = {(a, b) for t in mesh.triangles for a, b in zip(t, np.roll(t, -1), strict=True)}
    # each side belongs to two triangles, which see it from opposite ends
    assert len(sides) == 3 * len(mesh.triangles)
    assert {(b, a) for a, b in sides} == sides
    assert np.all(np.linalg.det(mesh.directions[mesh.triangles]) > 0.0)


@pytest.mark.parametrize('nodes', [27, 123])
def test_the_nodes_are_spread_evenly(nodes):
    mesh = ClosedMesh.even(nodes)
    np.testing.assert_allclose(mesh.shares.sum(), 1.0, rtol=1e-14)  # rounding
    # the lattice leaves a node at a pole a fifth less, and its neighbours a fourth more
    np.testing.assert_allclose(mesh.shares * nodes, 1.0, atol=0.3)
    u, v = mesh.coordinates.T
    assert np.all(np.abs(u) <= np.pi / 2)
    assert np.all((v >= -np.pi) & (v < np.pi))


def test_normals_of_an_ellipsoid_converge():
    counts, errors = np.array([100, 400, 1600]), []
    for nodes in counts:
        mesh = ClosedMesh.even(int(nodes))
        exact = mesh.directions / SEMI_AXES
        exact /= np.linalg.norm(exact, axis=1)[:, None]
        off = mesh.normals(mesh.directions * SEMI_AXES) - exact
        errors.append(np.sqrt(np.mean(off**2)))
    # weighted by area they are of first order at least, on a mesh without symmetry
    assert order_of(errors, counts**-0.5) > 0.9
    assert errors[-1] < 0.02


def test_normals_turn_with_the_body():
    mesh, turn = ClosedMesh.even(49), Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    position = mesh.directions * SEMI_AXES
    turned = mesh.normals(position @ turn.T + 0.7)
    np.testing.assert_allclose(turned, mesh.normals(position) @ turn.T, atol=1e-13)  # rounding


@pytest.fixture
def markers():
    """Points on an ellipsoid somewhere, shape (30, 3), with its centre and rotation."""
    rng = np.random.default_rng(1)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    direction = rng.normal(size=(30, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    centre = np.array([1.0, 2.0, 3.0])
    return centre + (direction * SEMI_AXES) @ turn.T, centre, turn


def test_nodes_through_markers_are_where_the_markers_are(markers):
    positions, centre, turn = markers
    mesh = ClosedMesh.through(positions, centre, turn, SEMI_AXES)
    q_s = np.array([1.0, *SEMI_AXES, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    shape = superquadric_shape.positions(q_s, mesh.coordinates)
    np.testing.assert_allclose(centre + shape @ turn.T, positions, atol=1e-13)  # rounding
    assert len(mesh.triangles) == 2 * 30 - 4


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda p, c: p[:3], 'through 3 points: it takes at least 4'),
        (lambda p, c: np.where(p == p[4], np.nan, p), 'that are finite'),
        (lambda p, c: np.concatenate([p, [c]]), 'point 30 is at the centre'),
        (lambda p, c: p[p[:, 2] > c[2]], 'they lie on one side of the centre'),
        (lambda p, c: np.concatenate([p, [p[4]]]), 'lies in the same direction'),
        (
            lambda p, c: c + np.stack([np.cos(p[:, 0]), np.sin(p[:, 0]), 0 * p[:, 0]], axis=1),
            'on one circle',
        ),
    ],
)
def test_points_that_make_no_closed_surface(markers, change, message):
    positions, centre, turn = markers
    turn = np.eye(3) if 'circle' in message else turn
    with pytest.raises(ConfigError, match=message):
        ClosedMesh.through(change(positions, centre), centre, turn, SEMI_AXES)


def test_too_few_nodes():
    with pytest.raises(ConfigError, match='closed mesh of 3 nodes: it takes at least 4'):
        ClosedMesh.even(3)
