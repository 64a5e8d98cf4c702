"""The membrane: what displacements cost, by closed forms on the sphere."""

import numpy as np
import pytest
from references import order_of

from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.membrane import Membrane


def area(mesh):
    """Area of the triangles between the nodes on the unit sphere."""
    a, b, c = np.moveaxis(mesh.directions[mesh.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def energy(membrane, d):
    return np.sum(d * membrane.apply(d)) / 2


@pytest.mark.parametrize('nodes', [4, 27, 123])
def test_one_element_at_a_time_equals_the_matrix(nodes):
    membrane = Membrane(ClosedMesh.even(nodes), 0.1, 0.5)
    d = np.random.default_rng(1).normal(size=(nodes, 3))
    np.testing.assert_allclose(membrane.apply(d), membrane.matrix() @ d, atol=1e-14)  # rounding


def test_the_matrix_is_symmetric_and_never_gives_energy():
    mesh = ClosedMesh.even(123)
    both = Membrane(mesh, 0.1, 0.5).matrix().toarray()
    np.testing.assert_allclose(both, both.T, atol=1e-15)  # rounding
    assert np.linalg.eigvalsh(both).min() > 0.0
    variation = np.linalg.eigvalsh(Membrane(mesh, 0.0, 0.5).matrix().toarray())
    # rounding of the one zero: all nodes alike; the next is 2 w1 times a node's area, w1 / 5
    assert abs(variation[0]) < 1e-14 < 0.05 < variation[1]


def test_a_rigid_displacement_costs_its_size_alone():
    mesh, shift = ClosedMesh.even(49), np.array([0.3, -0.2, 0.5])
    d = np.tile(shift, (49, 1))
    np.testing.assert_allclose(Membrane(mesh, 0.0, 0.5).apply(d), 0.0, atol=1e-15)  # rounding
    expected = 0.1 / 2 * (shift @ shift) * area(mesh)
    np.testing.assert_allclose(energy(Membrane(mesh, 0.1, 0.5), d), expected, rtol=1e-13)  # same


def test_one_node_by_itself_costs_the_square_of_its_hat():
    """A linear function from 1 at a corner to 0 has a square integral of a sixth of the area."""
    mesh = ClosedMesh.even(4)
    found = Membrane(mesh, 1.0, 0.0).matrix().diagonal()
    a, b, c = np.moveaxis(mesh.directions[mesh.triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    around = [areas[np.any(mesh.triangles == node, axis=1)].sum() for node in range(4)]
    np.testing.assert_allclose(found, np.array(around) / 6, rtol=1e-14)  # rounding


HARMONICS = {
    1: lambda x, y, z: z,
    2: lambda x, y, z: x * y,
    3: lambda x, y, z: x * (5 * z**2 - 1),
}
SQUARES = {1: 4 * np.pi / 3, 2: 4 * np.pi / 15, 3: 32 * np.pi / 21}
"""Integrals of their squares over the unit sphere."""


@pytest.mark.parametrize('degree', HARMONICS)
def test_the_energy_of_a_spherical_harmonic_converges_with_order_two(degree):
    """The gradient of a harmonic of degree l has l (l + 1) times its square integral."""
    exact = SQUARES[degree] * np.array([1.0, degree * (degree + 1)]) / 2
    counts, errors = np.array([200, 800, 3200]), []
    for nodes in counts:
        mesh = ClosedMesh.even(int(nodes))
        d = np.zeros((nodes, 3))
        d[:, 1] = HARMONICS[degree](*mesh.directions.T)
        found = [energy(Membrane(mesh, *weights), d) for weights in ((1.0, 0.0), (0.0, 1.0))]
        errors.append(np.abs(found / exact - 1))
    for error in np.array(errors).T:
        assert error[-1] < 0.01
        # linear elements on chords of the sphere are both of second order in the length of an edge
        assert abs(order_of(error, counts**-0.5) - 2.0) < 0.2
