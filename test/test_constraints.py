"""Bodies joined at points: the forces against the whole system, errors that die out, Jacobians."""

import numpy as np
import pytest
from references import central_differences, order_of
from scipy.sparse.linalg import expm_multiply

from cloth_predict.errors import ConfigError
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.constraints import Articulated, Joint, drift
from cloth_predict.models.constraints_first_order import ArticulatedFirstOrder
from cloth_predict.models.first_order import FirstOrder
from cloth_predict.models.joints import Linkage
from cloth_predict.models.superquadric import ROTATION, TRANSLATION, Superquadric

NODES = 8
MESH = ClosedMesh.even(NODES)
SHAPE = np.array([1.0, 0.3, 0.4, 0.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5])
BENT = np.array([1.2, 0.4, 0.6, 0.7, 0.8, 1.3, 0.2, -0.3, 0.4, 0.1, 0.6])
RIGID = {'free': np.zeros(11, bool), 'local': False}
TAPERS = np.isin(np.arange(11), (6, 7))
STILL = np.array([1.0, 0.0, 0.0, 0.0])
RK4 = INTEGRATORS['rk4']

ARRANGEMENTS = {
    'one': [Joint(0, 3, 1, 4)],
    'two between the same parts': [Joint(0, 3, 1, 4), Joint(1, 6, 0, 1)],
    'chain': [Joint(0, 1, 1, 6), Joint(1, 2, 2, 5), Joint(2, 0, 3, 7)],
    'star': [Joint(0, n, n + 1, 3) for n in range(4)],
    'loop': [Joint(0, 1, 1, 6), Joint(1, 1, 2, 6), Joint(2, 1, 0, 6)],
    'three at one point': [Joint(0, 3, 1, 4), Joint(1, 4, 2, 5)],
    'within a part': [Joint(0, 3, 0, 4), Joint(0, 1, 1, 2)],
    'none': [],
}


def part(index=0, **options):
    options = {'beta': 0.02, 'gravity': (0.0, 0.0, -9.81), **options}
    return Superquadric(MESH, mass=1.0 + 0.5 * index, reference=SHAPE, **options)


def random_state(body, rng):
    """A bent, displaced body that moves in every way; the quaternion has a length of its own."""
    d = rng.normal(0, 0.1, (body.nodes, 3))
    x = body.state(rng.normal(size=3), rng.normal(size=4), BENT, d)
    x[body.dim_q :] = rng.normal(size=body.dim_q)
    return x


def jumble(joints, alpha=3.0, seed=1, **options):
    """Bodies anywhere and in any motion, far from where their joints hold; state and forces.

    One of them does not change its shape.
    """
    rng = np.random.default_rng(seed)
    count = 1 + max((max(joint.part_a, joint.part_b) for joint in joints), default=1)
    parts = [part(i, **options) for i in range(count - 1)] + [
        part(count - 1, **{**options, **RIGID})
    ]
    model = Articulated(parts, joints, alpha)
    x = model.join([random_state(body, rng) for body in parts])
    return model, x, rng.normal(size=model.dim_u)


@pytest.fixture(params=ARRANGEMENTS.values(), ids=ARRANGEMENTS.keys())
def joints(request):
    return request.param


# --- the forces of the joints


@pytest.mark.parametrize('inertial', [False, True])
def test_the_fast_solver_equals_the_augmented_system(joints, inertial):
    model, x, u = jumble(joints, inertial=inertial)
    acceleration, multipliers = model.augmented(x, u)
    scale = np.abs(acceleration).max()
    found = model.f(x, u)[model.dim_q :]
    np.testing.assert_allclose(found, acceleration, rtol=1e-8, atol=1e-10 * scale)
    forces = -model.joint_forces(x, u).ravel()
    np.testing.assert_allclose(forces, multipliers, rtol=1e-8, atol=1e-10 * scale)


def test_violations_obey_the_equation_of_baumgarte(joints):
    model, x, u = jumble(joints, inertial=True)
    rate, acceleration = np.split(model.f(x, u), 2)

    def along(t):
        place = x[: model.dim_q] + t * rate + 0.5 * t**2 * acceleration
        return model.joints.violation(place)

    step = 1e-5
    first = (along(step) - along(-step)) / (2 * step)
    second = (along(step) - 2 * along(0.0) + along(-step)) / step**2
    left = second + 2 * model.alpha * first + model.alpha**2 * along(0.0)
    # the square of the step by the fourth derivatives, up to 1e6, and rounding by that square
    np.testing.assert_allclose(left, 0.0, atol=1e-3)
    assert all(np.linalg.norm(model.violation(x), axis=1) > 0.1)


def test_with_the_forces_of_the_joints_each_part_moves_by_itself_as_joined():
    model, x, u = jumble(ARRANGEMENTS['star'])
    expected = model.split(model.f(x, u))
    loads = np.split(model.joined_input(x, u), len(model.parts))
    for body, state, load, there in zip(model.parts, model.split(x), loads, expected, strict=True):
        np.testing.assert_allclose(body.f(state, load), there, atol=1e-10)  # rounding


def test_without_joints_nothing_holds_the_parts():
    model, x, u = jumble([], inertial=True)
    by_part = zip(model.parts, model.split(x), np.split(u, 2), strict=True)
    expected = model.join([body.f(state, load) for body, state, load in by_part])
    np.testing.assert_array_equal(model.f(x, u), expected)
    np.testing.assert_array_equal(drift(model, x, lambda _: u, 1e-3, 2, RK4), 0.0)


# --- closed forms


def row_of(masses, alpha=0.0, **options):
    """Rigid octahedra at rest in a row along z, joined at their poles: -z is node 4, +z node 5."""
    corners = np.concatenate([np.eye(3)[:2], -np.eye(3)[:2], [[0, 0, -1], [0, 0, 1]]])
    mesh = ClosedMesh.through(corners, np.zeros(3), np.eye(3), np.ones(3))
    options = {'reference': SHAPE, 'alpha': alpha, **RIGID, **options}
    parts = [Superquadric(mesh, mass=mass, **options) for mass in masses]
    places = np.arange(len(masses))[:, None] * [0.0, 0.0, 2 * SHAPE[3]]
    joints = [Joint(i, 5, i + 1, 4) for i in range(len(masses) - 1)]
    model = Articulated(parts, joints, 3.0)
    states = zip(parts, places, strict=True)
    return model, model.join([body.state(place, STILL, SHAPE) for body, place in states])


def force_at(model, index, node, force):
    """The input of a force [N] on one node of a part."""
    u = np.zeros(model.dim_u)
    start = model.joints.inputs[index].start + 3 * node
    u[start : start + 3] = force
    return u


def test_each_joint_of_a_towed_row_pulls_what_follows():
    masses = np.array([1.0, 2.0, 4.0])
    model, x = row_of(masses)
    u = force_at(model, 2, 5, [0.0, 0.0, 14.0])
    # joints pull their part_a, 1 kg and then 3 kg, at 2 m/s^2
    np.testing.assert_allclose(model.joint_forces(x, u)[:, 2], [2.0, 6.0], atol=1e-12)  # rounding
    for body, change in zip(model.parts, model.split(model.f(x, u)), strict=True):
        np.testing.assert_allclose(change[body.dim_q :][TRANSLATION], [0, 0, 2.0], atol=1e-12)


def test_a_push_across_a_joint_is_shared_by_what_gives_way():
    model, x = row_of([1.0, 3.0])
    u = force_at(model, 0, 5, [5.0, 0.0, 0.0])
    # a pole at h gives way by 1 / m + h^2 / I, I = m_theta / 4
    ways = [
        1 / body.node_mass.sum() + 4 * SHAPE[3] ** 2 / body.mass[ROTATION][0]
        for body in model.parts
    ]
    expected = -5.0 * ways[0] / (ways[0] + ways[1])
    np.testing.assert_allclose(
        model.joint_forces(x, u), [[expected, 0, 0]], atol=1e-12
    )  # rounding


def test_what_falls_freely_needs_no_forces():
    model, x = row_of([1.0, 2.0, 4.0], gravity=(0.0, 0.0, -9.81))
    # rounding
    np.testing.assert_allclose(model.joint_forces(x, np.zeros(model.dim_u)), 0.0, atol=1e-13)


def test_joints_keep_the_momentum():
    model, x, u = jumble(ARRANGEMENTS['loop'], alpha=3.0)
    model = Articulated(
        [part(i, alpha=0.0, gravity=(0, 0, 0)) for i in range(3)], model.joints.joints, 3.0
    )
    change = sum(
        body.node_mass.sum() * rate[body.dim_q :][TRANSLATION]
        for body, rate in zip(model.parts, model.split(model.f(x, u)), strict=True)
    )
    # rounding
    np.testing.assert_allclose(change, u.reshape(-1, 3).sum(axis=0), atol=1e-11)
    assert np.abs(model.joint_forces(x, u)).max() > 1.0


def assembled(joints, rate, gap=0.0, seed=2, **options):
    """Bodies of any pose and shape, at rest, whose joints hold but for a gap [m] each."""
    rng = np.random.default_rng(seed)
    parts = [part(i, **options) for i in range(1 + max(joint.part_b for joint in joints))]
    states = [
        body.state(
            np.zeros(3), STILL + rng.normal(0, 0.5, 4), SHAPE, rng.normal(0, 0.03, (NODES, 3))
        )
        for body in parts
    ]
    for joint in joints:
        at_a = parts[joint.part_a].position(states[joint.part_a])[joint.node_a]
        at_b = parts[joint.part_b].position(states[joint.part_b])[joint.node_b]
        states[joint.part_b][TRANSLATION] += at_a - at_b + gap * rng.normal(size=3)
    model = Articulated(parts, joints, rate)
    return model, model.join(states)


def energy(body, state):
    """Kinetic, elastic, and that of the pull on the quaternion [J], of constant masses."""
    q, rate = np.split(state, 2)
    pull = -body.f(body.state(np.zeros(3), STILL, SHAPE), np.zeros(body.dim_u))[body.dim_q + 3]
    still = 0.5 * pull * body.mass[ROTATION][0] * (q[ROTATION] @ q[ROTATION])
    return 0.5 * (rate @ (body.mass * rate) + q @ (body.stiffness @ q)) + still


def test_joints_hand_energy_on_and_keep_it():
    options = {'gravity': (0, 0, 0), 'alpha': 0.0, 'beta': 0.0, 'w0': 20.0, 'w1': 5.0}
    model, x = assembled(ARRANGEMENTS['chain'], 3.0, free=TAPERS, **options)
    first = np.array([energy(*of) for of in zip(model.parts, model.split(x), strict=True)])
    u = np.zeros(model.dim_u)
    for _ in range(50):
        x = RK4.step(model, x, u, 4e-3)
    last = np.array([energy(*of) for of in zip(model.parts, model.split(x), strict=True)])
    exchanged = np.abs(last - first).max()
    # the error of the steps, which is of fourth order
    assert abs(last.sum() - first.sum()) < 1e-6 * exchanged


# --- stabilisation


def pull_and_push(model):
    """Forces that change with time, at a node of the first and of the last part."""

    def at(time):
        u = np.zeros((model.dim_u // 3, 3))
        u[0] = [1.0, np.sin(9.0 * time), 0.5]
        u[-1] = [-np.cos(5.0 * time), 0.3, 1.0]
        return u.ravel()

    return at


def violations(model, x, dt, steps):
    """C of the first joint at the start and after each step, shape (steps + 1, 3)."""
    result, forces = [model.violation(x)[0]], pull_and_push(model)
    for step in range(steps):
        x = RK4.step(model, x, forces(step * dt), dt)
        result.append(model.violation(x)[0])
    return np.array(result)


def test_a_violation_at_rest_dies_out_as_critical_damping_has_it():
    model, x = assembled(ARRANGEMENTS['one'], 8.0, gap=0.2, inertial=True)
    found = violations(model, x, 0.012, 40)
    time = model.alpha * 0.012 * np.arange(41)[:, None]
    # the error of the steps
    np.testing.assert_allclose(found, found[0] * (1 + time) * np.exp(-time), atol=1e-5)
    printed = found[0] * np.exp(-time)  # of section III: it takes a C' to begin with
    assert np.abs(found - printed).max() > 0.3 * np.abs(found[0]).max()
    x[model.rows[0][model.parts[0].dim_q :][TRANSLATION]] -= model.alpha * found[0]
    np.testing.assert_allclose(violations(model, x, 0.012, 40), printed, atol=1e-5)


def test_settled_joints_hold_while_forces_act():
    model, x = assembled(ARRANGEMENTS['star'], 25.0, gap=0.1, free=TAPERS, inertial=True)
    found = drift(model, x, pull_and_push(model), 0.01, 80, RK4)
    assert found[0] > 0.1
    size = np.ptp(model.parts[0].position(model.split(x)[0]), axis=0).max()
    assert found[-20:].max() < 1e-6 * size


def drifting(alpha, steps, time=1.2, integrator='euler'):
    """Violations of one joint under forces, which holds at the start, shape (steps + 1,)."""
    model, x = assembled(ARRANGEMENTS['one'], alpha, free=TAPERS, inertial=True)
    forces, stepper = pull_and_push(model), INTEGRATORS[integrator]
    return drift(model, x, forces, time / steps, steps, stepper)


def test_without_stabilisation_a_joint_drifts_apart_and_with_it_it_holds():
    free, slow, fast = (drifting(alpha, 200) for alpha in (0.0, 30.0, 300.0))
    assert free[0] < 1e-15
    assert free[-1] > 4.0 * free[100] > 16.0 * free[50]
    assert free.max() > 3.0 * slow.max() > 15.0 * fast.max()


@pytest.mark.parametrize(('integrator', 'limit'), [('euler', 2.0), ('rk4', 2.785)])
def test_explicit_steps_are_unstable_from_their_limit_on(integrator, limit):
    """The errors have the double eigenvalue -alpha: the limit is where a method's region ends."""
    dt, ratios = 0.002, []
    for share in (0.95, 1.05):
        model, x = assembled(ARRANGEMENTS['one'], share * limit / dt, gap=1e-4)
        none = np.zeros(model.dim_u)
        found = drift(model, x, lambda _, u=none: u, dt, 80, INTEGRATORS[integrator])
        ratios.append(found[-1] / found[0])
    assert ratios[0] < 0.1
    assert np.isinf(ratios[1])


def test_what_explicit_euler_leaves_falls_with_alpha():
    """A step misses dt^2 C_q' q' / 2 of C, to which C = dt C_q' q' / alpha is the balance."""
    model, x = assembled(ARRANGEMENTS['one'], 400.0, free=TAPERS, inertial=True)
    forces, dt = pull_and_push(model), 0.004
    for step in range(250):
        x = INTEGRATORS['euler'].step(model, x, forces(step * dt), dt)
    expected = dt * model.joints.transport(*np.split(x, 2)) / model.alpha
    # the transport changes by some per cent within a few 1 / alpha
    error = np.linalg.norm(model.violation(x)[0] - expected)
    assert error < 0.05 * np.linalg.norm(expected)


def test_drift_is_the_error_of_the_steps():
    steps = np.array([40, 80, 160])
    ends = [drifting(0.0, number, 0.4)[-1] for number in steps]
    assert abs(order_of(ends, 1.0 / steps) - 1.0) < 0.2


# --- derivatives


def assert_jacobians(model, x, u):
    """Both, along some directions, against central differences."""
    rng = np.random.default_rng(5)
    jac, jac_input = model.jac(x, u), model.jac_input(x, u)
    for _ in range(4):
        d, push = rng.normal(size=model.dim_x), rng.normal(size=model.dim_u)
        along = central_differences(lambda t, d=d: model.f(x + t * d, u), np.zeros(1), 2e-6)[:, 0]
        # the square of the step by third derivatives, up to 1e8, and rounding by the step
        np.testing.assert_allclose(jac @ d, along, rtol=1e-6, atol=1e-6 * np.abs(along).max())
        change = model.f(x, u + push) - model.f(x, u)
        # f is linear in u; rounding of terms of some thousand
        np.testing.assert_allclose(jac_input @ push, change, atol=1e-9)


@pytest.mark.parametrize('inertial', [False, True])
def test_the_jacobians_are_those_of_central_differences(joints, inertial):
    assert_jacobians(*jumble(joints, inertial=inertial))


def test_the_linear_part_is_that_of_the_parts():
    model, x, _ = jumble(ARRANGEMENTS['chain'], gravity=(0, 0, 0))
    by_part = zip(model.parts, model.split(x), strict=True)
    expected = model.join([body.f(state, np.zeros(body.dim_u)) for body, state in by_part])
    np.testing.assert_allclose(model.linear_part.matrix @ x, expected, atol=1e-10)  # rounding
    modal = model.linear_part.apply('exp', 0.1, x)
    exact = expm_multiply(0.1 * model.linear_part.matrix, x)
    np.testing.assert_allclose(modal, exact, atol=1e-10)  # rounding


# --- first order


def first_order(joints, alpha=3.0, **options):
    model, x, u = jumble(joints, **options)
    parts = [FirstOrder(body, 0.5 + i) for i, body in enumerate(model.parts)]
    return ArticulatedFirstOrder(parts, joints, alpha), x[: model.dim_q], u


def test_first_order_joints_equal_the_augmented_system(joints):
    model, x, u = first_order(joints)
    by_part = zip(model.parts, model.split(x), np.split(u, len(model.parts)), strict=True)
    free = np.concatenate([body.f(q, load) for body, q, load in by_part])
    moving, rows = model.mobility > 0.0, model.joints.jacobian(x)
    damping, held = np.diag(1.0 / model.mobility[moving]), rows[:, moving]
    whole = np.block([[damping, held.T], [held, np.zeros((len(held), len(held)))]])
    approach = -model.alpha * model.violation(x).ravel()
    solution = np.linalg.solve(whole, np.concatenate([damping @ free[moving], approach]))
    found = model.f(x, u)
    np.testing.assert_allclose(found[moving], solution[: moving.sum()], rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(found[~moving], 0.0)


def test_a_violation_of_first_order_dies_out_exponentially():
    model, x, u = first_order(ARRANGEMENTS['chain'], free=TAPERS)
    start = model.violation(x)
    for _ in range(50):
        x = RK4.step(model, x, u, 0.02)
    # the error of the steps
    np.testing.assert_allclose(model.violation(x), start * np.exp(-3.0), atol=1e-4)


def test_the_jacobians_of_first_order_are_those_of_central_differences(joints):
    assert_jacobians(*first_order(joints))


# --- states, and what cannot be


def test_states_are_stacked_coordinates_first():
    model, x, _ = jumble(ARRANGEMENTS['chain'])
    states = model.split(x)
    np.testing.assert_array_equal(model.join(states), x)
    sizes = [body.dim_q for body in model.parts]
    np.testing.assert_array_equal(x[: sizes[0]], states[0][: sizes[0]])
    np.testing.assert_array_equal(x[-sizes[-1] :], states[-1][sizes[-1] :])
    positions = [body.position(state) for body, state in zip(model.parts, states, strict=True)]
    np.testing.assert_array_equal(model.position(x), np.concatenate(positions))
    chain = model.joints.joints
    apart = [positions[j.part_a][j.node_a] - positions[j.part_b][j.node_b] for j in chain]
    np.testing.assert_allclose(model.violation(x), apart, atol=1e-15)  # rounding


def test_admissible_states_have_unit_quaternions_and_the_same_places():
    model, x, _ = jumble(ARRANGEMENTS['chain'])
    made = model.admissible(x)
    np.testing.assert_allclose(model.position(made), model.position(x), atol=1e-13)  # rounding
    lengths = [np.linalg.norm(state[ROTATION]) for state in model.split(made)]
    np.testing.assert_allclose(lengths, 1.0, atol=1e-15)  # rounding


@pytest.mark.parametrize(
    ('joint', 'message'),
    [
        (Joint(0, 0, 5, 0), 'joint 1: there is no part 5, the parts are 0 to 1'),
        (Joint(-1, 0, 1, 0), 'joint 1: there is no part -1, the parts are 0 to 1'),
        (Joint(0, 0, 1, 99), 'joint 1: part 1 has no node 99, its nodes are 0 to 7'),
        (Joint(0, -1, 1, 0), 'joint 1: part 0 has no node -1, its nodes are 0 to 7'),
        (Joint(1, 3, 1, 3), 'joint 1: node 3 of part 1 is joined to itself'),
    ],
)
def test_a_joint_that_cannot_be_is_named(joint, message):
    parts, joints = [part(), part()], [Joint(0, 0, 1, 0), joint]
    with pytest.raises(ConfigError, match=message):
        Articulated(parts, joints, 1.0)
    with pytest.raises(ConfigError, match=message):
        ArticulatedFirstOrder([FirstOrder(body) for body in parts], joints, 1.0)


@pytest.mark.parametrize('alpha', [-1.0, np.nan, np.inf])
def test_alpha_is_a_number_from_0_on(alpha):
    with pytest.raises(ConfigError, match=f'alpha of the joints is {alpha:g}, expected a number'):
        Articulated([part(), part()], [], alpha)


@pytest.mark.parametrize(
    ('extra', 'named'),
    [
        ([Joint(0, 1, 1, 6)], '0, 3'),
        ([Joint(1, 6, 0, 1)], '0, 3'),
        ([Joint(1, 6, 2, 4), Joint(0, 1, 2, 4)], '0, 3, 4'),
    ],
    ids=['twice', 'twice, turned round', 'three ways between three points'],
)
def test_joints_that_depend_on_each_other_are_named(extra, named):
    model, x, u = jumble([*ARRANGEMENTS['chain'], *extra])
    with pytest.raises(ConfigError, match=f'joints {named} depend on each other'):
        model.f(x, u)


def test_joints_that_all_but_depend_on_each_other_are_named():
    rows = np.random.default_rng(6).normal(size=(3, 20))
    linkage = Linkage((Joint(0, 1, 1, 2), Joint(0, 1, 1, 2)), np.tile(rows, (2, 1)), np.ones(20))
    linkage.rows[3:] += 1e-7 * np.random.default_rng(7).normal(size=(3, 20))
    with pytest.raises(ConfigError, match='joints 0, 1 depend on each other'):
        linkage.solve(np.ones(6))


def test_a_body_that_does_not_change_its_shape_cannot_be_pinched():
    model = Articulated([part(**RIGID)], [Joint(0, 1, 0, 5)], 1.0)
    x = random_state(model.parts[0], np.random.default_rng(3))
    with pytest.raises(
        ConfigError,
        match='joints 0 depend on each other, or hold what cannot move: node 1 of part 0',
    ):
        model.f(x, np.zeros(model.dim_u))
