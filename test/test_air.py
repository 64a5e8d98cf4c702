"""Air along the normals: by hand on flat sheets, against differences, and its drag."""

import numpy as np
import pytest
from references import central_differences, flat_grid, random_surface
from scipy.spatial.transform import Rotation

from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.air import Air
from cloth_predict.simulation.recordings import vertex_areas
from cloth_predict.surface.topology import grid_triangles

STILL = np.zeros((12, 3))


@pytest.fixture
def air():
    return Air(grid_triangles(4, 3), np.linspace(0.3, 1.0, 12), 0.5)


def test_a_flat_sheet_feels_what_blows_along_its_normal(air):
    # u = (1, 2, 3) N on a sheet in the x-y plane: 3 N times the share of each node
    force = air.at(flat_grid(4, 3)).force(STILL, np.zeros(12), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-16)
    np.testing.assert_allclose(force[:, 2], 3.0 * air.share, rtol=1e-15)  # rounding


def test_gusts_press_node_by_node_and_turn_with_the_sheet(air):
    turn = Rotation.from_rotvec([0.4, -0.9, 0.3])
    gust = np.arange(12.0)
    force = air.at(turn.apply(flat_grid(4, 3))).force(STILL, gust, np.zeros(3))
    expected = turn.apply(np.outer(gust * air.share, [0.0, 0.0, 1.0]))
    np.testing.assert_allclose(force, expected, atol=1e-14)  # rounding of 11 N


def test_drag_takes_energy_from_motion_along_the_normal_alone(air):
    normals = air.at(flat_grid(4, 3))
    velocity = np.tile([2.0, -1.0, 4.0], (12, 1))
    force = normals.force(velocity, np.zeros(12), np.zeros(3))
    np.testing.assert_allclose(force[:, 2], -0.5 * 4.0 * air.share, rtol=1e-15)  # -c v s
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-16)
    damping = normals.damping().reshape(12, 3, 3)
    np.testing.assert_allclose(np.einsum('nij,nj->ni', damping, velocity), force, atol=1e-15)


def test_normals_weigh_triangles_by_their_areas(air):
    rng = np.random.default_rng(1)
    position = flat_grid(4, 3) + rng.normal(0, 0.02, (12, 3))
    normals = air.at(position)
    # a third of each triangle at each corner: in all the area of the sheet, as by its cells
    whole = (normals.unit * normals.area[:, None]).sum(axis=0)
    by_cells = vertex_areas(position.reshape(4, 3, 3)).sum(axis=(0, 1))
    np.testing.assert_allclose(whole, by_cells, rtol=1e-12)  # both are the rim's vector area


@pytest.mark.parametrize('seed', [1, 2])
def test_slope_equals_central_differences(air, seed):
    rng = np.random.default_rng(seed)
    position = flat_grid(4, 3) + rng.normal(0, 0.03, (12, 3))
    state = rng.normal(size=(12, 3)), rng.normal(size=12), rng.normal(size=3)
    expected = central_differences(
        lambda p: air.at(p.reshape(12, 3)).force(*state).ravel(), position.ravel(), 1e-6
    )
    found = np.zeros((12, 3, 12, 3))
    slope = air.at(position).slope(*state).reshape(-1, 3, 3, 3, 3)
    for corners, blocks in zip(air.triangles, slope, strict=True):
        for a, row in zip(corners, blocks, strict=True):
            for b, block in zip(corners, row, strict=True):
                found[a, :, b] += block
    # entries of 10 N/m; the third derivative over 1e-6 m, and rounding of 1e-16 over it
    np.testing.assert_allclose(found.reshape(36, 36), expected, atol=1e-8)


def test_nodes_without_an_area_feel_nothing(air):
    normals = air.at(STILL)
    state = np.ones((12, 3)), np.ones(12), np.ones(3)
    np.testing.assert_array_equal(normals.force(*state), 0.0)
    np.testing.assert_array_equal(normals.slope(*state), 0.0)


def test_slope_of_the_model_equals_central_differences():
    model, x, u = random_surface(np.random.default_rng(3), 3, 4, (0, 3), air=True)
    for found, expected in (
        (model.jac(x, u), central_differences(lambda y: model.f(y, u), x, 1e-6)),
        (model.jac_input(x, u), central_differences(lambda y: model.f(x, y), u, 1e-6)),
    ):
        # entries up to 1e4 1/s^2; rounding 1e-9 of that
        atol = 1e-8 * np.abs(expected).max()
        np.testing.assert_allclose(found.toarray(), expected, atol=atol)


def test_a_step_of_any_length_is_damped():
    # a sheet without springs to speak of, thrown along its normal: v' = -c s / m v
    model, x, u = random_surface(np.random.default_rng(4), 3, 3, air=True)
    x[:27] = flat_grid(3, 3).ravel()
    x[27:] = np.tile([0.0, 0.0, 1.0], 9)
    weightless = type(model)(model.springs, model.mass, (), np.zeros(3), model.air)
    still = np.zeros_like(u)
    after = ImplicitEuler().step(weightless, x, still, 1e-6)[27:].reshape(-1, 3)
    slowed = (1.0 - after[:, 2]) / 1e-6
    # flat springs do not pull along the normal; second order in 1e-6 s
    np.testing.assert_allclose(slowed, 0.3 * model.air.share / model.mass, rtol=1e-3)
    for dt in (0.01, 1.0, 100.0):
        faster = ImplicitEuler().step(weightless, x, still, dt)[27:].reshape(-1, 3)
        assert np.abs(faster[:, 2]).max() < 1.0
