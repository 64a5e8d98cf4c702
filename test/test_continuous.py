"""The continuous filter: closed forms, orders of its steps, blocks, steps as long as frames."""

import numpy as np
import pytest
from bodies import whole_covariance
from references import Linear, damped_oscillators, order_of, random_covariance
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cloth_predict.filters.blocks import Blocks
from cloth_predict.filters.continuous import Continuous, force, rates
from cloth_predict.filters.node_update import Seen
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.models.first_order import FirstOrder
from cloth_predict.models.superquadric import Superquadric
from cloth_predict.observations import LinearObservation, NodePositions

NO_INPUT = np.zeros(0)
ORDERS = {'euler': 1, 'splitting': 2}
FIRST = np.array([2.7, 0.1, 0.2, 0.7, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.2])
"""The initial ellipsoid of Metaxas & Terzopoulos 1993, section VI."""
PAPER_STEP = 4e-5
V, Q = 0.1, 0.1


def scalar(scheme, drift, q, v, p0, x0, z, step, duration):
    """Mean and variance of one state that is measured itself."""
    model, blocks = Linear(np.array([[drift]])), Blocks.whole(1)
    obs = LinearObservation(np.eye(1), np.zeros(1), np.array([v]))
    belief = blocks.of(np.array([x0]), np.array([[p0]]))
    after = Continuous(blocks, step, scheme).follow(
        belief, model, NO_INPUT, np.array([q]), obs, np.array([z]), duration
    )
    return after.mean[0], after.shared[0, 0]


def paper(nodes, away=0.3, **settings):
    """A body as in the paper's first experiment, the belief it begins with, and a frame of points.

    away: how far the points are from the body, in its own coordinates.
    """
    rng = np.random.default_rng(1)
    settings = {'mass': 4.0, 'reference': FIRST, **settings}
    body = Superquadric(ClosedMesh.even(nodes), **settings)
    x = body.state(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), FIRST)
    shape = FIRST + away * np.array([0, 0.05, -0.05, 0.1, 0, 0, 0.2, 0.1, 0.2, 0, 0.1])
    theta = np.array([1.0, 0.1 * away, 0.0, 0.05 * away])
    d = away * rng.normal(0, 0.05, 3 * nodes)
    there = body.state(away * np.array([0.3, -0.2, 0.1]), theta, shape, d)
    obs = NodePositions(body, np.arange(nodes), np.sqrt(V))
    return body, x, obs, obs.h(there)


def runge_kutta(blocks, body, belief, obs, z, duration, steps):
    """Fourth-order steps of eq. 37 and 38, short at first, when P falls from 1."""
    u, q = np.zeros(body.dim_u), np.full(body.dim_x, Q)

    def moved(belief, slope, dt):
        return blocks.belief(
            belief.mean + dt * slope[0], belief.shared + dt * slope[1], belief.own + dt * slope[2]
        )

    for dt in np.diff(duration * np.linspace(0, 1, steps + 1) ** 3):
        a = rates(belief, body, u, q, obs, z)
        b = rates(moved(belief, a, dt / 2), body, u, q, obs, z)
        c = rates(moved(belief, b, dt / 2), body, u, q, obs, z)
        d = rates(moved(belief, c, dt), body, u, q, obs, z)
        total = [(k + 2 * m + 2 * n + o) / 6 for k, m, n, o in zip(a, b, c, d, strict=True)]
        belief = moved(belief, total, dt)
    return belief


def followed(scheme, step, blocks, body, belief, obs, z, duration):
    u, q = np.zeros(body.dim_u), np.full(body.dim_x, Q)
    return Continuous(blocks, step, scheme).follow(belief, body, u, q, obs, z, duration)


# --- closed forms


@pytest.mark.parametrize('scheme', ORDERS)
def test_variance_and_mean_of_a_wandering_value(scheme):
    # P' = Q - P^2 / V from 0: P = sqrt(Q V) tanh(t sqrt(Q / V)), and x - z falls as 1 / cosh
    q, v, t, z = 0.5, 0.2, 1.0, 2.0
    rate = np.sqrt(q / v)
    steps, errors = np.array([0.02, 0.01, 0.005]), []
    for step in steps:
        mean, variance = scalar(scheme, 0.0, q, v, 0.0, 0.0, z, step, t)
        off = mean - z * (1 - 1 / np.cosh(rate * t)), variance - np.sqrt(q * v) * np.tanh(rate * t)
        errors.append(np.abs(off))
    for each in np.transpose(errors):
        assert order_of(each, steps) == pytest.approx(ORDERS[scheme], abs=0.2)  # house rule


@pytest.mark.parametrize('scheme', ORDERS)
def test_variance_settles_where_the_algebraic_equation_says(scheme):
    # 0 = -2 a P + Q - P^2 / V
    a, q, v, step = 0.7, 0.5, 0.2, 0.02
    settled = v * (np.sqrt(a**2 + q / v) - a)
    _, variance = scalar(scheme, -a, q, v, 1.0, 0.0, 0.0, step, 6.0)
    # Euler rests where the equation does; splitting is off by its second order
    assert variance == pytest.approx(settled, rel=1e-8 if scheme == 'euler' else step**2)


@pytest.mark.parametrize('scheme', ORDERS)
def test_riccati_equation_of_several_states_against_its_linear_system(scheme):
    # P = Y X^-1 with [X; Y]' = [[-F', H' V^-1 H], [Q, F]] [X; Y] (Gelb 1974, section 4.6)
    rng = np.random.default_rng(2)
    model, H, v, z = damped_oscillators(rng, 3), rng.normal(size=(2, 6)), 0.3, rng.normal(size=2)
    q, P0, x0, t = rng.uniform(0.1, 0.3, 6), random_covariance(rng, 6), rng.normal(size=6), 1.0
    told = H.T @ H / v
    both = np.block([[-model.A.T, told], [np.diag(q), model.A]])

    def covariance(s):
        pair = expm(s * both) @ np.vstack([np.eye(6), P0])
        return pair[6:] @ np.linalg.inv(pair[:6])

    def slope(s, x):
        return model.A @ x + covariance(s) @ H.T @ (z - H @ x) / v

    exact = solve_ivp(slope, (0, t), x0, method='DOP853', rtol=1e-11, atol=1e-11).y[:, -1]
    blocks = Blocks.whole(6)
    obs = LinearObservation(H, np.zeros(2), np.full(2, v))
    steps, errors = np.array([0.01, 0.005, 0.0025]), []
    for step in steps:
        after = Continuous(blocks, step, scheme).follow(
            blocks.of(x0, P0), model, NO_INPUT, q, obs, z, t
        )
        apart = np.abs(after.mean - exact).max(), np.abs(after.shared - covariance(t)).max()
        errors.append(apart)
    for each in np.transpose(errors):
        assert order_of(each, steps) == pytest.approx(ORDERS[scheme], abs=0.2)  # house rule


# --- on the body


@pytest.mark.parametrize('coupling', ['parts', 'pose', 'whole'])
def test_rates_are_the_blocks_of_the_equations(coupling):
    rng = np.random.default_rng(3)
    body, x, _, z = paper(9, inertial=True)
    x[body.dim_q :] = rng.normal(0, 0.1, body.dim_q)
    several = NodePositions(body, np.array([0, 4, 4, 7]), np.sqrt([0.1, 0.2, 0.3, 0.4]))
    z = z.reshape(-1, 3)[[0, 4, 3, 7]].ravel()
    whole = coupling == 'whole'
    blocks = Blocks.whole(body.dim_x) if whole else Blocks.of_body(body, coupling)
    belief = blocks.of(x, random_covariance(rng, body.dim_x))
    u, q = rng.normal(0, 0.1, body.dim_u), rng.uniform(0.1, 0.2, body.dim_x)
    P, F, H = whole_covariance(belief), body.jac(x, u).toarray(), several.jac(x)
    gain = P @ H.T / several.cov
    mean, shared, own = rates(belief, body, u, q, several, z)
    expected = body.f(x, u) + gain @ (z - several.h(x))
    np.testing.assert_allclose(mean, expected, rtol=1e-10, atol=1e-10)  # rounding
    expected = F @ P + P @ F.T + np.diag(q) - gain @ H @ P
    scale = np.abs(expected).max()
    found = blocks.belief(mean, shared, own)
    expected = whole_covariance(blocks.of(x, expected))
    np.testing.assert_allclose(whole_covariance(found), expected, atol=1e-12 * scale)  # rounding


def test_for_unit_covariance_the_forces_are_those_of_the_data():
    # D q' + K q = H' V^-1 (z - h) (eq. 16 and 18) is eq. 37 of that model with P = I
    body, x, obs, z = paper(12)
    q = x[: body.dim_q] + np.random.default_rng(4).normal(0, 0.01, body.dim_q)
    model, blocks = FirstOrder(body), Blocks.whole(body.dim_q)
    belief = blocks.of(q, np.eye(body.dim_q))
    no_forces = np.zeros(body.dim_u)
    found, _, _ = rates(belief, model, no_forces, np.zeros(body.dim_q), obs, z)
    expected = model.f(q, (z - obs.h(q)) / V)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)  # rounding
    second = Blocks.of_body(body, 'pose').of(x, np.eye(body.dim_x))
    pulled = body.kinematics.pulled_back(x[: body.dim_q], ((z - obs.h(x)) / V).reshape(-1, 3))
    found = force(second, Seen.of(second, obs, z, x))
    np.testing.assert_allclose(found[: body.dim_q], pulled, rtol=1e-10, atol=1e-10)  # rounding
    np.testing.assert_array_equal(found[body.dim_q :], 0.0)


@pytest.mark.parametrize(
    ('coupling', 'scheme', 'order'),
    [
        ('whole', 'euler', 1),
        ('whole', 'splitting', 2),
        ('pose', 'euler', 1),
        ('pose', 'splitting', 1),
    ],
)
def test_order_of_convergence_on_the_body(coupling, scheme, order):
    # after a first while, in which P falls from 1 within less than any of the steps
    body, x, obs, z = paper(4)
    whole = coupling == 'whole'
    blocks = Blocks.whole(body.dim_x) if whole else Blocks.of_body(body, coupling)
    belief = runge_kutta(blocks, body, blocks.of(x, np.eye(body.dim_x)), obs, z, 0.02, 60)
    z = z + 0.02 * np.sin(np.arange(len(z)))
    exact = runge_kutta(blocks, body, belief, obs, z, 0.005, 60)
    steps = np.array([4e-5, 2e-5] if scheme == 'euler' else [1.25e-3, 6.25e-4, 3.125e-4])
    errors = []
    for step in steps:
        after = followed(scheme, step, blocks, body, belief, obs, z, 0.005)
        errors.append(
            [
                np.abs(body.position(after.mean) - body.position(exact.mean)).max(),
                np.abs(whole_covariance(after) - whole_covariance(exact)).max(),
            ]
        )
    for each in np.transpose(errors):
        assert order_of(each, steps) == pytest.approx(order, abs=0.3)


@pytest.mark.parametrize('coupling', ['pose', 'whole'])
def test_a_step_as_long_as_a_frame_agrees_with_the_short_steps_of_the_paper(coupling):
    body, x, obs, z = paper(6)
    whole = coupling == 'whole'
    blocks = Blocks.whole(body.dim_x) if whole else Blocks.of_body(body, coupling)
    belief = blocks.of(x, np.eye(body.dim_x))
    short = followed('euler', PAPER_STEP, blocks, body, belief, obs, z, 0.05)
    moved = np.abs(body.position(short.mean) - body.position(x)).max()
    assert moved > 0.1
    for step, share in ((0.05, 0.05), (0.0125, 0.02)):
        long = followed('splitting', step, blocks, body, belief, obs, z, 0.05)
        apart = np.abs(body.position(long.mean) - body.position(short.mean)).max()
        assert apart < share * moved  # of the first frame, the hardest, as P falls from 1


def test_splitting_stands_what_blows_up_short_steps():
    # V a hundred times smaller: P H' V^-1 H of 1e6 1/s
    body, x, obs, z = paper(9)
    sharp = NodePositions(body, obs.nodes, np.sqrt(V / 100))
    blocks = Blocks.of_body(body, 'pose')
    belief = blocks.of(x, np.eye(body.dim_x))
    with np.errstate(over='ignore', invalid='ignore'):
        short = followed('euler', PAPER_STEP, blocks, body, belief, sharp, z, 100 * PAPER_STEP)
    assert not np.abs(short.shared).max() < 1e3
    long = followed('splitting', 0.05, blocks, body, belief, sharp, z, 0.05)
    assert np.linalg.eigvalsh(long.own).min() > 0
    assert np.linalg.eigvalsh(long.shared).min() > 0
    off = np.abs(body.position(long.mean).ravel() - z).max()
    assert off < 0.2 * np.abs(body.position(x).ravel() - z).max()


def test_a_frame_is_cut_into_equal_steps_that_are_no_longer():
    one = scalar('splitting', -0.5, 0.5, 0.2, 1.0, 0.0, 1.0, 0.025, 0.05)
    other = scalar('splitting', -0.5, 0.5, 0.2, 1.0, 0.0, 1.0, 0.04, 0.05)
    assert one == other
