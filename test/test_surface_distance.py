"""The distance of points from triangles: closed forms, all pairs, and a minimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from cloth_predict.bodies.surface_distance import closest_weights, nearest_on_surface

ROUNDING = 1e-12  # of lengths of about 1 m, in sums of some ten terms


def distance(points, nodes, triangles):
    return np.linalg.norm(nearest_on_surface(points, nodes, triangles).place - points, axis=1)


def ball(nodes, seed=0):
    """Points on the unit sphere, and the triangles of their hull."""
    points = np.random.default_rng(seed).normal(size=(nodes, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return points, ConvexHull(points).simplices


@pytest.mark.parametrize(
    ('point', 'place'),
    [
        ([0.2, 0.3, 0.5], [0.2, 0.3, 0.0]),  # above the inside
        ([0.2, 0.3, -2.0], [0.2, 0.3, 0.0]),
        ([0.4, -1.0, 1.0], [0.4, 0.0, 0.0]),  # beside an edge
        ([1.0, 1.0, 0.0], [0.5, 0.5, 0.0]),
        ([-1.0, 0.25, 0.0], [0.0, 0.25, 0.0]),
        ([2.0, -1.0, 0.0], [1.0, 0.0, 0.0]),  # beyond a corner
        ([-1.0, -2.0, 3.0], [0.0, 0.0, 0.0]),
        ([0.0, 5.0, 0.0], [0.0, 1.0, 0.0]),
        ([0.3, 0.2, 0.0], [0.3, 0.2, 0.0]),  # on it
    ],
)
def test_each_region_of_a_right_triangle(point, place):
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for turned in range(3):
        triangle = np.roll(corners, turned, axis=0)
        (weight,) = closest_weights(np.array([point]), triangle[None])
        np.testing.assert_allclose(weight @ triangle, place, atol=ROUNDING)
        assert weight.sum() == pytest.approx(1.0, abs=ROUNDING)
        assert (weight >= 0).all()


def test_points_round_an_octahedron():
    # of the octahedron |x| + |y| + |z| = 1 the nearest place to (r, r, r) is (1, 1, 1) / 3
    nodes = np.vstack([np.eye(3), -np.eye(3)])
    triangles = ConvexHull(nodes).simplices
    points = np.array([[1.0, 1.0, 1.0], [0.1, 0.1, 0.1], [3.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    expected = [2 / np.sqrt(3), 0.7 / np.sqrt(3), 2.0, 1 / np.sqrt(2)]
    np.testing.assert_allclose(distance(points, nodes, triangles), expected, atol=ROUNDING)


def test_as_all_pairs_and_as_a_minimiser_find():
    rng = np.random.default_rng(3)
    nodes, triangles = ball(30)
    nodes *= [0.2, 0.5, 1.5]  # long triangles, of which the nearest has no near node
    points = rng.normal(0.0, 1.0, (40, 3))
    found = nearest_on_surface(points, nodes, triangles)
    for k, point in enumerate(points):
        many = np.repeat(point[None], len(triangles), axis=0)
        places = np.einsum('tk,tki->ti', closest_weights(many, nodes[triangles]), nodes[triangles])
        assert np.linalg.norm(found.place[k] - point) == pytest.approx(
            np.linalg.norm(places - point, axis=1).min(), abs=ROUNDING
        )
    for k, point in enumerate(points[:5]):
        best = min(_minimised(point, nodes[triangle]) for triangle in triangles)
        # m: what the minimiser stops at, in squares of some m
        assert np.linalg.norm(found.place[k] - point) == pytest.approx(best, abs=1e-6)
    np.testing.assert_allclose(
        np.einsum('pk,pki->pi', found.weight, nodes[triangles[found.triangle]]),
        found.place,
        atol=ROUNDING,
    )


def _minimised(point, corners):
    """Least distance over the weights of a triangle's corners, by a general method."""
    found = minimize(
        lambda w: np.sum((w @ corners[:2] + (1 - w.sum()) * corners[2] - point) ** 2),
        np.full(2, 1 / 3),
        method='SLSQP',
        bounds=[(0, 1)] * 2,
        constraints={'type': 'ineq', 'fun': lambda w: 1 - w.sum()},
        options={'ftol': 1e-15},
    )
    return float(np.sqrt(found.fun))


def test_a_mesh_of_a_ball_converges_to_it_with_the_square_of_its_edges():
    points = 1.3 * ball(200, 5)[0]
    means = []
    for count in (200, 800, 3200):
        k = np.arange(count) + 0.5
        z, angle = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
        across = np.sqrt(1 - z**2)
        nodes = np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
        means.append(distance(points, nodes, ConvexHull(nodes).simplices).mean() - 0.3)
    # four times the nodes halve the edges, and their sagitta falls to a quarter; the distance from
    # outside is too long by it
    assert means[0] / means[1] == pytest.approx(4, rel=0.1)
    assert means[1] / means[2] == pytest.approx(4, rel=0.1)
    assert means[2] > 0


@pytest.mark.parametrize('corners', [[[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1, 1, 1]] * 3])
def test_a_triangle_without_an_area_is_its_edges(corners):
    nodes = np.array(corners, float)
    points = np.array([[0.5, 1.0, 0.0], [3.0, 0.0, 0.0]])
    found = distance(points, nodes, np.array([[0, 1, 2]]))
    expected = [1.0, 1.0] if nodes[1, 1] == 0 else [np.sqrt(1.25), np.sqrt(6.0)]
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
