"""The motion of a deformable superquadric: kinematics, mass, invariants, exact Jacobians."""

from dataclasses import replace

import numpy as np
import pytest
from references import central_differences, order_of
from scipy.linalg import expm

from cloth_predict.errors import ConfigError
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models import rotation, superquadric_shape
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.first_order import FirstOrder
from cloth_predict.models.superquadric import GLOBAL, LOCAL, ROTATION, TRANSLATION, Superquadric

NODES = 12
BENT = np.array([2.0, 0.4, 0.6, 0.7, 0.8, 1.3, 0.2, -0.3, 0.4, 0.1, 0.6])
ELLIPSOID = np.array([1.0, 0.3, 0.4, 0.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5])
NO_FORCE = np.zeros(3 * NODES)
RK4 = INTEGRATORS['rk4']
SOME = np.ones(11, bool)
SOME[[0, 9]] = False
"""Parameters that are free: all but a0, which is redundant, and b2."""


def body(mesh=None, reference=BENT, mass=1.3, **options):
    return Superquadric(mesh or ClosedMesh.even(NODES), mass=mass, reference=reference, **options)


def random_state(model, seed=1):
    """A bent, displaced body that moves in every way; the quaternion has a length of its own."""
    rng = np.random.default_rng(seed)
    x = model.state(rng.normal(size=3), rng.normal(size=4), BENT, rng.normal(0, 0.1, (NODES, 3)))
    x[model.dim_q :] = rng.normal(size=model.dim_q)
    return x


def split(model, x):
    return x[: model.dim_q], x[model.dim_q :]


# --- kinematics


def test_l_is_the_derivative_of_the_positions():
    model = body()
    q, rate = split(model, random_state(model))
    expected = central_differences(lambda p: model.position(p).ravel(), q, 1e-5)
    whole = model.kinematics.jacobian(q).toarray()
    np.testing.assert_allclose(whole, expected, atol=1e-8)  # the square of the step, and rounding
    np.testing.assert_allclose(model.global_jacobian(q).reshape(-1, LOCAL), whole[:, :LOCAL])
    np.testing.assert_array_equal(model.node_jacobian(q, 5), whole[15:18])
    # rounding
    found = model.velocity(np.concatenate([q, rate])).ravel()
    np.testing.assert_allclose(found, whole @ rate, atol=1e-13)


def test_some_nodes_are_those_of_all():
    model, some = body(), np.array([7, 2])
    x = random_state(model)
    np.testing.assert_array_equal(model.position(x, some), model.position(x)[some])
    np.testing.assert_array_equal(model.global_jacobian(x, some), model.global_jacobian(x)[some])
    # rounding of products of other sizes
    np.testing.assert_allclose(model.transport(x, some), model.transport(x)[some], atol=1e-13)


def test_the_transport_is_the_rate_of_l():
    model = body()
    q, rate = split(model, random_state(model))
    along = central_differences(
        lambda t: model.kinematics.jacobian(q + t[0] * rate) @ rate, np.zeros(1), 1e-5
    )
    found = model.transport(np.concatenate([q, rate])).ravel()
    # the square of the step by the fourth derivative, some hundreds
    np.testing.assert_allclose(found, along[:, 0], atol=1e-7)


def printed_transport(model, x):
    """Equation 43 as it is printed, with 44 to 46."""
    q, rate = split(model, x)
    turn = model.rotation(q)
    omega = rotation.rate_map(q[ROTATION]) @ rate[ROTATION]
    shape_rate = superquadric_shape.jacobian(q[GLOBAL], model.mesh.coordinates) @ rate[GLOBAL]
    p_rate = shape_rate + rate[LOCAL:].reshape(-1, 3)
    arm = model.position(q) - q[TRANSLATION]
    return np.cross(omega, np.cross(omega, arm)) + 2 * np.cross(omega, p_rate @ turn.T)


def test_equation_43_lacks_the_change_of_the_shape_jacobian():
    model = body()
    x = model.admissible(random_state(model))
    q, rate = split(model, x)
    lack = superquadric_shape.motion(q[GLOBAL], rate[GLOBAL], model.mesh.coordinates).second
    expected = printed_transport(model, x) + lack @ model.rotation(q).T
    np.testing.assert_allclose(model.transport(x), expected, atol=1e-12)  # rounding
    rate[GLOBAL] = 0.0
    still = np.concatenate([q, rate])
    np.testing.assert_allclose(model.transport(still), printed_transport(model, still), atol=1e-12)


def test_equation_43_is_that_of_a_quaternion_that_keeps_its_length():
    """Otherwise -2 (theta . theta' / |theta|^2) omega x R p joins it."""
    model = body()
    x = model.admissible(random_state(model))
    q, rate = split(model, x)
    rate[GLOBAL] = 0.0
    rate[ROTATION] += 0.7 * q[ROTATION]
    x = np.concatenate([q, rate])
    omega = rotation.rate_map(q[ROTATION]) @ rate[ROTATION]
    joins = -2 * 0.7 * np.cross(omega, model.position(q) - q[TRANSLATION])
    expected = printed_transport(model, x) + joins
    np.testing.assert_allclose(model.transport(x), expected, atol=1e-12)  # rounding


@pytest.mark.parametrize('inertial', [False, True])
def test_accelerations_are_those_of_the_motion(inertial):
    """Equation 42, by second differences of the positions along the motion."""
    model = body(inertial=inertial)
    x, u = random_state(model), np.random.default_rng(2).normal(size=3 * NODES)
    h = 1e-3
    there, back = RK4.step(model, x, u, h), RK4.step(model, x, u, -h)
    found = (model.position(there) - 2 * model.position(x) + model.position(back)) / h**2
    # the square of the step by the fourth derivative
    expected = model.acceleration(x, u)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


# --- mass


def consistent_mass(model, q):
    """M of equation 48, int mu L'L, shape (dim_q, dim_q)."""
    whole = model.kinematics.jacobian(q).toarray()
    return whole.T * np.repeat(model.node_mass, 3) @ whole


def test_the_printed_mass_matrix_is_singular():
    """Displacements can do all that the 18 other coordinates do: its rank is 3N, not 3N + 18."""
    model = body()
    q, _ = split(model, random_state(model))
    assert np.linalg.matrix_rank(consistent_mass(model, q)) == 3 * NODES == model.dim_q - 18


def test_the_lumped_mass_is_the_diagonal_at_the_reference():
    model = body()
    rng = np.random.default_rng(1)
    diagonals = []
    for theta in rng.normal(size=(4, 4)):
        q = model.state(np.zeros(3), theta / np.linalg.norm(theta), BENT)[: model.dim_q]
        diagonal = np.diag(consistent_mass(model, q)).copy()
        # over the three directions that turn; those of the length has no mass
        diagonal[ROTATION] = diagonal[ROTATION].sum() / 3
        diagonals.append(diagonal)
    # rounding; the same at all orientations
    np.testing.assert_allclose(diagonals, np.tile(model.mass, (4, 1)), rtol=1e-12)


def test_parameters_that_move_nothing_have_a_mass():
    model = body(reference=ELLIPSOID)
    size = np.sqrt(model.mass[ROTATION][0] * 3 / 8 / 1.3)
    parameters = dict(zip(superquadric_shape.PARAMETERS, model.mass[GLOBAL], strict=True))
    for name in ('b2', 'b3'):  # without a bend they change nothing
        np.testing.assert_allclose(parameters[name], 1.3 * (0.1 * size) ** 2)
    assert np.all(model.mass > 0.0)


# --- invariants


def unlumped(model, moving):
    """Motion of some of the coordinates by the printed M, with g_q alone; for RK4."""

    class Unlumped:
        def f(self, x, u):
            q, rate = split(model, x)
            whole = model.kinematics.jacobian(q).toarray()[:, moving]
            weighted = whole.T * np.repeat(model.node_mass, 3)
            inertial = -weighted @ model.kinematics.transport(q, rate).ravel()
            result = np.zeros(model.dim_q)
            # what is redundant, as the length of the quaternion, stays as it is
            result[moving] = np.linalg.lstsq(weighted @ whole, inertial, rcond=1e-10)[0]
            return np.concatenate([rate, result])

        def input_after(self, u, dt):
            return u

    return Unlumped()


def invariants(model, x):
    """Energy, momentum and angular momentum of the nodes, shape (7,)."""
    v, m = model.velocity(x), model.node_mass
    turning = np.cross(model.position(x), v)
    return np.array([m @ np.sum(v**2, axis=1) / 2, *(m @ v), *(m @ turning)])


@pytest.mark.parametrize('coordinates', [7, 18])
def test_inertial_forces_conserve_energy_and_momentum(coordinates):
    """Of a rigid body (7), which precesses as Euler's equations say, and of one that deforms."""
    model = body()
    start = model.admissible(random_state(model))
    moving = np.arange(coordinates)
    start[model.dim_q :][coordinates:] = 0.0
    start[model.dim_q :][GLOBAL] *= 0.1  # stays within the ranges
    motion, drifts, counts = unlumped(model, moving), [], np.array([10, 20, 40])
    for steps in counts:
        x = start
        for _ in range(steps):
            x = RK4.step(motion, x, NO_FORCE, 0.2 / steps)
        drifts.append(np.abs(invariants(model, x) - invariants(model, start)).max())
    # the error of RK4, and nothing else
    assert order_of(drifts, 1 / counts) > 3.7
    assert drifts[-1] < 1e-6
    assert np.linalg.norm(model.velocity(x) - model.velocity(start)) > 0.1


def test_without_the_lacking_term_energy_is_not_conserved(monkeypatch):
    model = body()
    start = model.admissible(random_state(model))
    start[model.dim_q :][LOCAL:] = 0.0
    right = superquadric_shape.motion

    def as_printed(*at):
        return replace(right(*at), second=np.zeros((NODES, 3)))

    monkeypatch.setattr(superquadric_shape, 'motion', as_printed)
    slope = central_differences(
        lambda t: invariants(
            model, start + t[0] * unlumped(model, np.arange(18)).f(start, NO_FORCE)
        )[:1],
        np.zeros(1),
        1e-5,
    )
    assert abs(slope.item()) > 0.1  # W; 0 with it, as above


def octahedron():
    """Six nodes, so that all moments of inertia about the centre are alike, and it is no lever."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    return ClosedMesh.through(points, np.zeros(3), np.eye(3), np.ones(3))


def test_a_ball_turns_at_a_steady_rate():
    """Lumped, with inertial forces, and a quaternion that is brought back to its length."""
    ball = np.array([1.0, 0.5, 0.5, 0.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    held = {'free': np.zeros(11, bool), 'local': False}
    model = body(octahedron(), ball, alpha=0.0, inertial=True, **held)
    omega, no_force = np.array([1.0, -2.0, 0.5]), np.zeros(18)
    x = model.state(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), ball)
    x[model.dim_q :][ROTATION] = rotation.rate_map(x[ROTATION]).T @ omega / 4
    spin = np.cross(omega, np.eye(3)).T
    expected, errors, counts = model.position(x) @ expm(spin).T, [], np.array([25, 50, 100])
    for steps in counts:
        after = x
        for _ in range(steps):
            after = model.admissible(RK4.step(model, after, no_force, 1 / steps))
        q, rate = split(model, after)
        errors.append(np.abs(model.position(after) - expected).max())
        turning = rotation.derivative(q[ROTATION]) @ rate[ROTATION] @ model.rotation(q).T
        np.testing.assert_allclose(turning, spin, atol=5 * errors[-1])  # per second
    # the mass of the rotation is that of a unit quaternion, from which a step strays by its square
    assert order_of(errors, 1 / counts) > 2.8
    assert errors[-1] < 1e-5


def energy(model, x):
    """What the lumped, linear motion would conserve without damping."""
    q, rate = split(model, x)
    elastic = q @ (model.stiffness @ q)
    pull = model.mass[ROTATION] @ q[ROTATION] ** 2
    return (model.mass @ rate**2 + elastic + pull) / 2


@pytest.mark.parametrize('beta', [0.0, 0.2])
def test_damping_takes_energy_as_equation_11_says(beta):
    model = body(alpha=0.7, beta=beta)
    x = random_state(model)
    _, rate = split(model, x)
    rate_of_change = central_differences(
        lambda t: np.array([energy(model, x + t[0] * model.f(x, NO_FORCE))]), np.zeros(1), 1e-3
    ).item()
    expected = -0.7 * model.mass @ rate**2 - beta * rate @ (model.stiffness @ rate)
    np.testing.assert_allclose(rate_of_change, expected, rtol=1e-9)  # a parabola: rounding alone


def test_at_rest_nothing_moves():
    model = body(inertial=True)
    x = model.state(np.ones(3), np.array([0.5, -0.5, 0.5, 0.5]), BENT)
    np.testing.assert_allclose(model.acceleration(x, NO_FORCE), 0.0, atol=1e-14)  # rounding
    np.testing.assert_array_equal(model.velocity(x), 0.0)


def test_gravity_lets_every_node_fall_alike():
    gravity = np.array([0.0, 0.0, -9.81])
    model = body(gravity=gravity)
    x = model.state(np.ones(3), np.array([0.5, -0.5, 0.5, 0.5]), BENT)
    found = model.acceleration(x, NO_FORCE)
    np.testing.assert_allclose(found, np.tile(gravity, (NODES, 1)), atol=1e-13)  # rounding


# --- forces


def test_generalised_forces_do_the_work_of_the_forces():
    model = body()
    q, _ = split(model, random_state(model))
    rng = np.random.default_rng(3)
    force, change = rng.normal(size=(NODES, 3)), rng.normal(size=model.dim_q)
    work = central_differences(
        lambda t: np.array([np.sum(force * model.position(q + t[0] * change))]), np.zeros(1), 1e-5
    ).item()
    # the square of the step
    np.testing.assert_allclose(model.kinematics.pulled_back(q, force) @ change, work, rtol=1e-7)


def test_what_is_held_stays():
    model = body(free=SOME, local=False, inertial=True)
    x = random_state(model)
    change = model.f(x, np.random.default_rng(2).normal(size=3 * NODES))
    moves = np.concatenate([model.moving, model.moving])
    np.testing.assert_array_equal(change[~moves], 0.0)
    assert np.all(change[moves] != 0.0)
    other = x.copy()
    other[~np.concatenate([np.ones(model.dim_q, bool), model.moving])] = 7.0
    np.testing.assert_array_equal(model.velocity(other), model.velocity(x))


# --- Jacobians


@pytest.mark.parametrize('inertial', [False, True])
@pytest.mark.parametrize('held', [{}, {'free': SOME, 'local': False}])
@pytest.mark.parametrize('pushed', [False, True])
def test_jacobians_equal_central_differences(inertial, held, pushed):
    model = body(inertial=inertial, beta=0.2, gravity=(0.0, 0.0, -9.81), **held)
    x = random_state(model)
    u = np.random.default_rng(2).normal(size=3 * NODES) if pushed else NO_FORCE
    expected = central_differences(lambda y: model.f(y, u), x, 1e-5)
    # the square of the step by third derivatives, of some hundreds
    np.testing.assert_allclose(model.jac(x, u).toarray(), expected, atol=1e-6)
    expected = central_differences(lambda y: model.f(x, y), u, 1e-3)
    np.testing.assert_allclose(model.jac_input(x, u).toarray(), expected, atol=1e-9)  # linear


def test_without_forces_the_motion_is_linear():
    model = body(beta=0.05, gravity=(0.0, 0.0, -9.81))
    assert model.linear
    assert not body(inertial=True).linear
    x, other = random_state(model), random_state(model, 2)
    jac = model.jac(x, NO_FORCE)
    assert model.jac(other, NO_FORCE) is jac
    constant = model.f(np.zeros(model.dim_x), NO_FORCE)
    np.testing.assert_allclose(model.f(x, NO_FORCE), jac @ x + constant, atol=1e-12)  # rounding


# --- admissible states


def test_an_admissible_state_moves_nothing():
    model = body()
    x = random_state(model)
    there = model.admissible(x)
    q, rate = split(model, there)
    # rounding
    np.testing.assert_allclose(np.linalg.norm(q[ROTATION]), 1.0, rtol=1e-14)
    np.testing.assert_allclose(q[ROTATION] @ rate[ROTATION], 0.0, atol=1e-14)
    np.testing.assert_allclose(model.position(there), model.position(x), atol=1e-14)
    np.testing.assert_allclose(model.velocity(there), model.velocity(x), atol=1e-13)


def test_parameters_are_put_back_into_their_ranges():
    model = body()
    x = random_state(model)
    q, rate = split(model, x)
    q[GLOBAL][[1, 4, 6]] = 1.2, -0.1, 1.5
    rate[GLOBAL][[1, 4, 6]] = 0.3, -0.2, -0.4
    before = x.copy()
    there_q, there_rate = split(model, model.admissible(x))
    superquadric_shape.check_parameters(there_q[GLOBAL])
    np.testing.assert_array_equal(there_q[GLOBAL][[1, 4, 6]], [1.0, 0.0, 1.0])
    # t1 is on its way back
    np.testing.assert_array_equal(there_rate[GLOBAL][[1, 4, 6]], [0.0, 0.0, -0.4])
    np.testing.assert_array_equal(x, before)


def test_a_state_out_of_range_is_refused():
    out = BENT.copy()
    out[10] = 0.0
    with pytest.raises(ConfigError, match='b3 is 0'):
        body().state(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), out)
    with pytest.raises(ConfigError, match='b3 is 0'):
        body(reference=out)


# --- first order


@pytest.mark.parametrize('held', [{}, {'free': SOME, 'local': False}])
def test_jacobians_of_the_first_order_equal_central_differences(held):
    motion = FirstOrder(body(**held), 0.5)
    q, _ = split(motion.body, random_state(motion.body))
    u = np.random.default_rng(2).normal(size=3 * NODES)
    np.testing.assert_array_equal(motion.f(q, u) != 0.0, motion.body.moving)
    expected = central_differences(lambda y: motion.f(y, u), q, 1e-5)
    # the square of the step by third derivatives
    np.testing.assert_allclose(motion.jac(q, u).toarray(), expected, atol=1e-7)
    expected = central_differences(lambda y: motion.f(q, y), u, 1e-3)
    np.testing.assert_allclose(motion.jac_input(q, u).toarray(), expected, atol=1e-9)  # linear


def test_the_first_order_goes_down_its_energy():
    """D q' + K q = f_q: the elastic energy and that of steady forces fall by q'D q'."""
    motion = FirstOrder(body(), 0.5)
    q, _ = split(motion.body, random_state(motion.body))
    u = np.random.default_rng(2).normal(size=3 * NODES)

    def potential(p):
        return p @ (motion.body.stiffness @ p) / 2 - u @ motion.body.position(p).ravel()

    rate = motion.f(q, u)
    slope = central_differences(
        lambda t: np.array([potential(q + t[0] * rate)]), np.zeros(1), 1e-6
    )
    np.testing.assert_allclose(slope.item(), -0.5 * rate @ rate, rtol=1e-7)  # the step's square
    # and the quaternion keeps its length
    np.testing.assert_allclose(q[ROTATION] @ rate[ROTATION], 0.0, atol=1e-13)  # rounding
