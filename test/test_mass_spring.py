"""The surface: forces, Jacobians and the implicit solve against loops, papers and physics."""

import numpy as np
import pytest
from references import (
    acceleration_jacobians,
    accelerations,
    central_differences,
    even_surface,
    number_of_springs,
    order_of,
    random_surface,
    state_jacobian,
)
from scipy.spatial.transform import Rotation

from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.integrators.runge_kutta import RK4, RungeKutta
from cloth_predict.models import blocks
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import Springs, grid_pairs

MESHES = [(4, 3, ()), (3, 4, (0, 1, 2, 3)), (1, 6, (0, 5)), (6, 1, (2,)), (2, 2, (3, 1))]

# the printed matrix; nodes p1 (0, 1), p2 (1, 1), p3 (0, 0), p4 (1, 0), each x y z
GOMES_3_26 = np.array(
    [
        [-150, 50, 0, 100, 0, 0, 0, 0, 0, 50, -50, 0],
        [50, -150, 0, 0, 0, 0, 0, 100, 0, -50, 50, 0],
        [0] * 12,
        [100, 0, 0, -150, -50, 0, 50, 50, 0, 0, 0, 0],
        [0, 0, 0, -50, -150, 0, 50, 50, 0, 0, 100, 0],
        [0] * 12,
        [0, 0, 0, 50, 50, 0, -150, -50, 0, 100, 0, 0],
        [0, 100, 0, 50, 50, 0, -50, -150, 0, 0, 0, 0],
        [0] * 12,
        [50, -50, 0, 0, 0, 0, 100, 0, 0, -150, 50, 0],
        [-50, 50, 0, 0, 100, 0, 0, 0, 0, 50, -150, 0],
        [0] * 12,
    ]
)


def all_springs(rows, cols):
    return np.concatenate(list(grid_pairs(rows, cols).values()))


def springs_of(pairs, k=1.0, d=0.1, r=1.0):
    size = np.ones(len(pairs))
    return Springs(pairs, k * size, d * size, r * size)


# --- numbers from the paper


@pytest.fixture
def gomes_example():
    """Section 3.1: four nodes, k = 100 N/m, d = 0.1 N s/m, m = 1 kg."""
    rest = np.array([[0, 1, 0], [1, 1, 0], [0, 0, 0], [1, 0, 0]], float)
    pairs = all_springs(2, 2)
    length = np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1)
    return MassSpring(springs_of(pairs, 100.0, 0.1, length), np.ones(4)), rest


def test_accelerations_of_the_example(gomes_example):
    model, rest = gomes_example
    position = rest.copy()
    position[2:] = [[0, -1, 0], [1, -2, 0]]
    velocity = np.array([[0, 0, 0.5], [1, 0, 0], [0, 0, 0], [1, 0, 0]])
    x = np.concatenate([position.ravel(), velocity.ravel()])
    expected = [
        [55.48, -275.65, -0.15],
        [-36.95, -283.32, 0.05],
        [66.24, 134.41, 0.05],
        [-84.77, 385.32, 0.05],
    ]
    found = model.acceleration(x, model.input())
    np.testing.assert_allclose(found, expected, atol=0.005)  # printed with two decimals


def test_jacobian_of_the_example_at_rest(gomes_example):
    model, rest = gomes_example
    J = model.jac(np.append(rest.ravel(), np.zeros(12)), model.input()).toarray()
    np.testing.assert_allclose(J[12:, :12], GOMES_3_26, atol=1e-12)  # rounding of sqrt(2)
    np.testing.assert_array_equal(J[:12], np.eye(12, 24, 12))
    # (3.25) prints -0.4 on the diagonal; three dampers meet at a node, and rows must add up to 0
    expected = np.kron(0.1 * (np.ones((4, 4)) - 4 * np.eye(4)), np.eye(3))
    np.testing.assert_allclose(J[12:, 12:], expected, atol=1e-15)  # rounding of 3 x 0.1


@pytest.mark.parametrize(
    ('rows', 'cols', 'count'),
    [(5, 4, 77), (2, 2, 6), (1, 1, 0), (1, 2, 1), (1, 13, 23), (7, 1, 11), (21, 21, 2438)],
)
def test_number_of_springs(rows, cols, count):
    assert number_of_springs(rows, cols) == count
    assert len(all_springs(rows, cols)) == count


@pytest.mark.parametrize(('rows', 'cols'), [(5, 4), (1, 6), (6, 1), (2, 5), (3, 2)])
def test_springs_join_the_neighbours_of_their_family(rows, cols):
    families = {'structural': {(0, 1)}, 'shear': {(1, 1)}, 'flexion': {(0, 2)}}
    place = [(node // cols, node % cols) for node in range(rows * cols)]
    for name, offsets in families.items():
        expected = {
            (a, b)
            for a, (row, col) in enumerate(place)
            for b, (other_row, other_col) in enumerate(place)
            if a < b and tuple(sorted((abs(row - other_row), abs(col - other_col)))) in offsets
        }
        found = [tuple(sorted(pair)) for pair in grid_pairs(rows, cols)[name].tolist()]
        assert len(found) == len(set(found))
        assert set(found) == expected, name


@pytest.mark.parametrize(('rows', 'cols'), [(5, 4), (1, 6), (8, 7)])
def test_sparsity_of_the_jacobian(rows, cols):
    model, x, u = random_surface(np.random.default_rng(5), rows, cols)
    n, s = rows * cols, number_of_springs(rows, cols)
    J = model.jac(x, u)
    # (A.4); reached, because no entry of a 3x3 block vanishes at a random state
    assert np.count_nonzero(J.toarray()) == 15 * n + 24 * s
    assert J.has_canonical_format
    # stored besides: the zeros of the dampers' blocks, 6 in each of n + 2 s
    assert J.nnz == 15 * n + 24 * s + 6 * (n + 2 * s)


# --- against second implementations


@pytest.mark.parametrize(('rows', 'cols', 'driven'), MESHES)
@pytest.mark.parametrize('seed', range(3))
def test_accelerations_equal_the_loop_over_springs(rows, cols, driven, seed):
    model, x, u = random_surface(np.random.default_rng(seed), rows, cols, driven)
    position, velocity = model.surface(x, u)
    force = np.zeros((model.nodes, 3))
    force[model.free] = u[6 * len(driven) :].reshape(-1, 3)
    every = accelerations(model.springs, model.mass, model.gravity, position, velocity, force)
    found = model.acceleration(x, u)
    np.testing.assert_allclose(found, every[model.free], rtol=1e-11)  # sums in another order
    n = 3 * len(model.free)
    np.testing.assert_array_equal(model.f(x, u)[:n], x[n:])


@pytest.mark.parametrize(('rows', 'cols', 'driven'), MESHES)
def test_jacobian_equals_central_differences(rows, cols, driven):
    model, x, u = random_surface(np.random.default_rng(11), rows, cols, driven)
    expected = central_differences(lambda y: model.f(y, u), x, 1e-6)
    J = model.jac(x, u).toarray()
    # entries up to 4e4 1/s^2; error: step^2 / length^2 = 1e-10 of that, and rounding 1e-9 of it
    np.testing.assert_allclose(J, expected, atol=1e-8 * np.abs(expected).max())
    position, _ = model.surface(x, u)
    by_hand = state_jacobian(model, position)
    np.testing.assert_allclose(J, by_hand, atol=1e-13 * np.abs(J).max())  # rounding


def test_force_jacobian_equals_differences():
    model, x, u = random_surface(np.random.default_rng(3), 3, 3, (0, 4))
    start = 6 * len(model.driven)

    def with_force(force):
        return model.f(x, np.append(u[:start], force))

    expected = central_differences(with_force, u[start:], 1.0)
    # linear in the force, so any step is exact but for rounding of accelerations of 1e3 m/s^2
    np.testing.assert_allclose(
        model.jac_input(x, u).toarray()[:, -model.dim_load :], expected, atol=1e-11
    )


# --- physics


def energy(model, x, u, gravity):
    """Of motion, of the springs and of height [J]; no driven nodes."""
    position, velocity = model.surface(x, u)
    s = model.springs
    stretch = np.linalg.norm(position[s.pairs[:, 0]] - position[s.pairs[:, 1]], axis=1)
    stretch = stretch - s.rest_length
    motion = 0.5 * np.sum(model.mass[:, None] * velocity**2)
    return (
        motion + 0.5 * np.sum(s.stiffness * stretch**2) - np.sum(model.mass @ position @ gravity)
    )


def thrown(damping):
    """A mesh thrown through the air, far from its rest shape."""
    rng = np.random.default_rng(8)
    gravity = np.array([1.0, -9.81, 2.0])
    model, flat = even_surface(3, 3, gravity=gravity, damping=damping)
    position = flat + rng.normal(0, 0.05, flat.shape)
    return model, np.append(position.ravel(), rng.normal(0, 1.0, flat.size)), gravity


def energies(model, x, gravity, dt, duration=0.5):
    found = [energy(model, x, model.input(), gravity)]
    for _ in range(round(duration / dt)):
        x = RungeKutta(RK4).step(model, x, model.input(), dt)
        found.append(energy(model, x, model.input(), gravity))
    return np.array(found)


def test_momentum_changes_by_gravity_alone():
    model, x, u = random_surface(np.random.default_rng(4), 5, 4)
    u = np.zeros_like(u)
    total = model.mass @ (model.acceleration(x, u) - model.gravity)
    # rounding of 77 forces of up to 5 N
    np.testing.assert_allclose(total, 0.0, atol=1e-13)


def test_angular_momentum_is_kept_by_the_springs():
    model, flat = even_surface(4, 3, gravity=np.zeros(3), damping=0.0)
    position = flat + np.random.default_rng(6).normal(0, 0.05, flat.shape)
    force = 0.017 * model.acceleration(np.append(position, np.zeros(36)), model.input())
    # rounding of torques of up to 1 N m
    np.testing.assert_allclose(np.cross(position, force).sum(axis=0), 0.0, atol=1e-14)


def test_dampers_only_take_energy():
    model, x, gravity = thrown(damping=0.1)
    found = energies(model, x, gravity, 1e-3)
    assert np.diff(found).max() < 1e-12 * abs(found[0])  # rounding
    # J; the springs hold 4.28 and the motion 0.34 at the start, of which little is left
    assert 4.5 < found[0] - found[-1] < 4.7


def test_energy_is_conserved_to_the_order_of_the_step():
    model, x, gravity = thrown(damping=0.0)
    steps = np.array([2e-3, 1e-3, 5e-4])
    drift = []
    for dt in steps:
        found = energies(model, x, gravity, dt)
        drift.append(np.abs(found - found[0]).max())
    assert drift[-1] < 1e-6 * 4.62  # of the energy of springs and motion; measured 5.5e-7
    # RK4 is of order 4 in the state, and of order 5 in the energy of an oscillator
    assert order_of(drift, steps) == pytest.approx(5, abs=0.2)


@pytest.mark.parametrize(('rows', 'cols'), [(4, 3), (1, 5)])
def test_rest_is_an_equilibrium_and_rigid_motion_makes_no_force(rows, cols):
    model, flat = even_surface(rows, cols, gravity=np.zeros(3))
    turn = Rotation.from_rotvec([0.3, -1.2, 0.7])
    turned = turn.apply(flat) + np.array([3.0, -2.0, 1.0])
    drift = np.tile([2.0, -1.0, 0.5], (rows * cols, 1))  # the dampers resist turning, not this
    for position, velocity in ((flat, 0 * flat), (turned, 0 * flat), (turned, drift)):
        x = np.append(position, velocity)
        # rounding: k / m = 3.5e3 times 1e-16 of coordinates of 3 m, times 12 springs
        np.testing.assert_allclose(model.acceleration(x, model.input()), 0.0, atol=1e-10)


def test_nodes_at_the_same_place_make_no_force_and_no_nan():
    model, _ = even_surface(2, 2, gravity=np.zeros(3))
    x = np.zeros(24)
    np.testing.assert_array_equal(model.f(x, model.input()), 0.0)
    assert np.isfinite(ImplicitEuler().step_jac(model, x, model.input(), 0.01)[1]).all()


# --- the implicit solve


@pytest.mark.parametrize(('rows', 'cols', 'driven'), [*MESHES, (10, 9, range(9))])
@pytest.mark.parametrize('rest', [(0.7, 0.95), (0.7, 1.3), (1.5, 3.0)])
def test_solver_equals_a_dense_solve(rows, cols, driven, rest):
    rng = np.random.default_rng(2)
    model, x, u = random_surface(rng, rows, cols, driven, rest)
    dt, n = 0.01, model.dim_x // 2
    J = state_jacobian(model, model.surface(x, u)[0], clamp=True)
    mass = model.mass[model.free].repeat(3)[:, None]
    matrix = mass * (np.eye(n) - dt**2 * J[n:, :n] - dt * J[n:, n:])
    b = rng.normal(size=(n, 20))
    expected = np.linalg.solve(matrix, b)
    solve = model.linearise(x, u).solver(dt)
    tolerance = 1e-15 * np.linalg.cond(matrix) * np.abs(expected).max()  # rounding of both solves
    np.testing.assert_allclose(solve(b), expected, atol=tolerance)
    np.testing.assert_allclose(solve(b[:, :2]), expected[:, :2], atol=tolerance)
    np.testing.assert_allclose(solve(b[:, 1]), expected[:, 1], atol=tolerance)


def test_a_solver_of_a_state_nearby_keeps_the_step_consistent():
    model, x, u = random_surface(np.random.default_rng(3), 4, 3, (0,))
    near = x + np.random.default_rng(4).normal(0, 0.01, len(x))
    steps = np.array([4e-4, 2e-4, 1e-4])
    errors = []
    for dt in steps:
        change = model.linearise(x, u).change(dt, model.linearise(near, u).solver(dt))
        errors.append(np.abs(change - dt * model.f(x, u)).max())
    # the error of one step is of second order
    assert order_of(errors, steps) == pytest.approx(2, abs=0.2)


def test_step_equals_equation_3_32_where_all_springs_are_stretched():
    model, x, u = random_surface(np.random.default_rng(9), 4, 3, rest=(0.5, 0.95))
    dt, n = 0.02, 36
    jap, jav = acceleration_jacobians(model.springs, model.mass, model.surface(x, u)[0])
    a0, v0 = model.acceleration(x, u).ravel(), x[n:]
    matrix = np.eye(n) - dt**2 * jap - dt * jav
    dv = np.linalg.solve(matrix, dt * a0 + dt**2 * jap @ v0)
    expected = np.append(x[:n] + dt * (dv + v0), v0 + dv)
    found = ImplicitEuler().step(model, x, u, dt)
    np.testing.assert_allclose(found, expected, atol=1e-12)  # rounding, condition below 1e3


def test_dense_and_banded_path_agree(monkeypatch):
    rng = np.random.default_rng(12)
    _, x, u = random_surface(rng, 8, 7, range(7))
    # and the 10 x 9 mesh above takes the banded path by itself
    assert len(x) // 2 <= blocks.MOST_DENSE < 3 * (90 - 9)
    found = []
    for most in (blocks.MOST_DENSE, 0):
        monkeypatch.setattr(blocks, 'MOST_DENSE', most)
        model = random_surface(np.random.default_rng(12), 8, 7, range(7))[0]
        after, tangent = ImplicitEuler().step_tangent(model, x, u, 0.01)
        columns = np.random.default_rng(1).normal(size=(len(x), 30))
        inputs = np.random.default_rng(2).normal(size=(model.dim_u, 3))
        parts = (tangent.push(columns), tangent.pull(columns.T).T, tangent.drive(inputs))
        found.append(np.column_stack([after, *parts]))
    # rounding times a condition number below 1e3
    np.testing.assert_allclose(found[1], found[0], atol=1e-12 * np.abs(found[0]).max())


def test_solver_exists_for_strongly_compressed_states():
    rng = np.random.default_rng(13)
    indefinite = 0
    for _ in range(100):
        model, x, u = random_surface(rng, 4, 4, (0,), rest=(1.0, 20.0))
        x[:45] *= 10 ** rng.uniform(-6, 0)  # crumpled, down to a micrometre
        dt = 10 ** rng.uniform(-3, 0)
        b = rng.normal(size=45)
        y = model.linearise(x, u).solver(dt)(b)
        J = state_jacobian(model, model.surface(x, u)[0], clamp=True)
        mass = model.mass[model.free].repeat(3)
        A = np.diag(mass) - dt * mass[:, None] * (dt * J[45:, :45] + J[45:, 45:])
        residual = A @ y - b
        scale = np.abs(y).max() * np.abs(A).sum(axis=1).max()
        assert np.abs(residual).max() < 1e-13 * scale  # rounding of a backward stable solve
        J = state_jacobian(model, model.surface(x, u)[0])
        force_jac = model.mass[model.free].repeat(3)[:, None] * J[45:]
        plain = np.diag(model.mass[model.free].repeat(3)) - dt * (
            dt * force_jac[:, :45] + force_jac[:, 45:]
        )
        indefinite += np.linalg.eigvalsh(plain)[0] < 0
    assert indefinite > 50  # without the clamp most of these have no Cholesky factor


# --- the contract


def test_inputs_are_never_written_to():
    model, x, u = random_surface(np.random.default_rng(14), 3, 3, (1,))
    x.flags.writeable = u.flags.writeable = False
    before = x.copy(), u.copy()
    for method in (ImplicitEuler(), RungeKutta()):
        method.step(model, x, u, 0.01)
        method.step_jac(model, x, u, 0.01)
    model.jac(x, u)
    at = model.linearise(x, u)
    solver = at.solver(0.01)
    change = at.change(0.01, solver)
    columns, inputs = np.ones((model.dim_x, 2)), np.ones((model.dim_u, 2))
    for array in (change, columns, inputs):
        array.flags.writeable = False
    tangent = at.tangent(0.01, solver, change)
    first = tangent.push(columns), tangent.pull(columns.T), tangent.drive(inputs)
    again = tangent.push(columns), tangent.pull(columns.T), tangent.drive(inputs)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(x, before[0])
    np.testing.assert_array_equal(u, before[1])


def test_two_jacobians_do_not_share_their_values():
    model, x, u = random_surface(np.random.default_rng(15), 3, 2)
    first = model.jac(x, u)
    kept = first.toarray()
    model.jac(2 * x, u)
    np.testing.assert_array_equal(first.toarray(), kept)


def test_input_and_surface_put_nodes_in_their_places():
    model, flat = even_surface(2, 3, driven=(4, 1))
    np.testing.assert_array_equal(model.driven, [1, 4])
    np.testing.assert_array_equal(model.free, [0, 2, 3, 5])
    velocity = 10 + flat
    u = model.input(flat[[1, 4]], velocity[[1, 4]])
    x = np.append(flat[model.free], velocity[model.free])
    found = model.surface(x, u)
    np.testing.assert_array_equal(found[0], flat)
    np.testing.assert_array_equal(found[1], velocity)
    assert (model.dim_x, model.dim_u) == (24, 24)


PAIR = np.array([[0, 1]])


@pytest.mark.parametrize(
    ('make', 'words'),
    [
        (lambda: Springs(PAIR, [-1.0], [0.1], [1.0]), 'stiffness'),
        (lambda: Springs(PAIR, [1.0], [np.nan], [1.0]), 'damping'),
        (lambda: Springs(PAIR, [1.0], [0.1], [np.inf]), 'rest_length'),
        (lambda: Springs(PAIR, [1.0, 2.0], [0.1], [1.0]), 'shape'),
        (lambda: MassSpring(springs_of(PAIR), [1.0, 0.0]), 'mass'),
        (lambda: MassSpring(springs_of(PAIR), [1.0, np.nan]), 'mass'),
        (lambda: MassSpring(springs_of(PAIR), [1.0, 1.0], [2]), 'driven'),
        (lambda: MassSpring(springs_of(PAIR), [1.0, 1.0], [-1]), 'driven'),
        (lambda: MassSpring(springs_of(PAIR), [1.0, 1.0], [0, 1]), 'driven'),
        (lambda: MassSpring(springs_of(PAIR + 1), [1.0, 1.0]), 'springs'),
        (lambda: MassSpring(springs_of(PAIR - 1), [1.0, 1.0]), 'springs'),
    ],
)
def test_invalid_arguments_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


# --- springs that resist compression less


def test_a_compressed_spring_pushes_with_its_share_of_the_stiffness():
    springs = Springs(np.array([[0, 1]]), 50.0, 0.0, 1.0, compression=0.2)
    model = MassSpring(springs, np.ones(2), gravity=np.zeros(3))
    for length, force in ((1.3, -50.0 * 0.3), (0.7, 0.2 * 50.0 * 0.3)):
        x = np.zeros(12)
        x[3] = length
        # the force on the second node, along x; rounding
        assert model.acceleration(x, model.input())[1, 0] == pytest.approx(force, rel=1e-14)


@pytest.mark.parametrize('compression', [0.0, 0.3])
def test_jacobians_with_springs_that_resist_compression_less(compression):
    rng = np.random.default_rng(21)
    model, x, u = random_surface(rng, 3, 4, (0, 3), rest=(0.6, 1.6), compression=compression)
    expected = central_differences(lambda y: model.f(y, u), x, 1e-6)
    atol = 1e-8 * np.abs(expected).max()  # rounding, 1e-9 of the largest entry
    np.testing.assert_allclose(model.jac(x, u).toarray(), expected, atol=atol)
    method = ImplicitEuler()
    expected = central_differences(lambda y: method.step(model, y, u, 0.01), x, 1e-6)
    _, found = method.step_jac(model, x, u, 0.01)
    np.testing.assert_allclose(found, expected, atol=1e-7)  # entries up to 1e2; rounding


def test_compression_is_a_share():
    with pytest.raises(ValueError, match='compression'):
        Springs(np.array([[0, 1]]), 1.0, 0.0, 1.0, compression=1.1)
