"""Unknown forces as states: derivatives, the joined solve, variance, and that they are found."""

import numpy as np
import pytest
from references import central_differences, even_surface, order_of, random_surface, state_jacobian
from scipy.linalg import expm, solve_continuous_lyapunov

from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.linear import propagate
from cloth_predict.integrators.dense_tangent import DenseTangent
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed, ForceProcess
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import Gaussian

TAU = 0.3


@pytest.fixture
def example():
    """A disturbed mesh at a random state, compressed springs among them."""
    rng = np.random.default_rng(1)
    model, x, u = random_surface(rng, 3, 4, (0, 3), rest=(0.6, 1.6))
    return Disturbed(model, TAU), np.append(x, rng.normal(0, 0.2, 30)), u


def test_slope_is_that_of_the_model_under_the_forces(example):
    model, x, u = example
    under = u.copy()
    under[-30:] += x[60:]
    expected = np.append(model.model.f(x[:60], under), -x[60:] / TAU)
    np.testing.assert_allclose(model.f(x, u), expected, rtol=1e-12)  # sums in another order
    assert (model.dim_x, model.dim_u) == (90, model.model.dim_u)


def test_jacobian_equals_central_differences(example):
    model, x, u = example
    expected = central_differences(lambda y: model.f(y, u), x, 1e-6)
    # entries up to 4e4 1/s^2; rounding 1e-9 of that
    atol = 1e-8 * np.abs(expected).max()
    np.testing.assert_allclose(model.jac(x, u).toarray(), expected, atol=atol)


@pytest.mark.parametrize('kind', ['ornstein_uhlenbeck', 'matern'])
def test_step_is_that_of_model_and_forces_together(example, kind):
    model, x, u = example
    model = Disturbed(model.model, getattr(ForceProcess, kind)(0.2, TAU))
    inner, dt, drift = model.model, 0.01, model.unknown[0].process.drift
    rng = np.random.default_rng(2)
    x = np.append(x[:60], rng.normal(0, 0.2, 30 * len(drift)))
    u[6:12] = 0.0  # the driven nodes stand still; that they move is tested with the derivative
    A = np.zeros((len(x), len(x)))
    A[:60, :60] = state_jacobian(inner, inner.surface(x[:60], u)[0], clamp=True)
    A[30:60, 60:90] = np.diag(np.repeat(1 / inner.mass[inner.free], 3))
    A[60:, 60:] = np.kron(drift, np.eye(30))
    expected = np.linalg.solve(np.eye(len(x)) - dt * A, dt * model.f(x, u))
    found = ImplicitEuler().step(model, x, u, dt) - x
    np.testing.assert_allclose(found, expected, atol=1e-11)  # rounding, condition 1e4


def test_tau_must_be_positive(example):
    with pytest.raises(ValueError, match='tau'):
        Disturbed(example[0].model, 0.0)


# --- the force's own statistics


def force_variance_ratio(name, dt):
    """Variance of the force that `propagate` keeps, over sigma^2, for q = 2 sigma^2 / tau."""
    mesh, flat = even_surface(1, 2, driven=(0,))
    model = Disturbed(mesh, TAU)
    x = np.append(flat[1], np.zeros(6))
    _, F = INTEGRATORS[name].step_jac(model, x, mesh.input(flat[:1]), dt)
    a = F[-1, -1]
    np.testing.assert_array_equal(F[-1, :-1], 0.0)
    # P = a^2 (P + n/2) + n/2 solved for P; then seen to be kept by the filter's own step
    noise = 2 / TAU * dt
    kept = noise / 2 * (1 + a**2) / (1 - a**2)
    cov = np.diag([0.0] * 6 + [kept] * 3)
    after = propagate(cov, DenseTangent(F), noise * np.array([0.0] * 6 + [1.0] * 3))
    np.testing.assert_allclose(np.diag(after)[6:], kept, rtol=1e-13)  # rounding
    return kept


@pytest.mark.parametrize(
    ('name', 'order', 'lead'), [('implicit_euler', 1, 1 / 2), ('rk4', 2, 1 / 3)]
)
def test_variance_of_the_force_is_stationary(name, order, lead):
    """The deviation is lead (dt/tau)^order: (2+2h+h^2)/(2+h) - 1 and h coth(h) - 1, h = dt/tau."""
    steps = np.array([0.02, 0.01, 0.005])
    deviation = np.array([force_variance_ratio(name, dt) - 1 for dt in steps])
    assert order_of(deviation, steps) == pytest.approx(order, abs=0.1)  # next term: 7 % at 0.02 s
    # the same next term, at most 2 % at the shortest step
    assert deviation[-1] == pytest.approx(lead * (steps[-1] / TAU) ** order, rel=0.02)


def test_covariance_of_force_and_velocity_equals_the_integral():
    """A free mass under the force: compared with the integral of expm(A t) Q expm(A t)'."""
    mesh, flat = even_surface(1, 2, driven=(0,), stiffness=0.0, damping=0.0, mass=0.5)
    model = Disturbed(mesh, TAU)
    u, x = mesh.input(flat[:1]), np.append(flat[1], np.zeros(6))
    q = np.array([0.0] * 3 + [0.1] * 3 + [2 * 0.2**2 / TAU] * 3)
    A, end = model.jac(x, u).toarray(), 0.4
    # Van Loan 1978: the blocks of one exponential hold the integral
    both = expm(np.block([[-A, np.diag(q)], [np.zeros((9, 9)), A.T]]) * end)
    exact = both[9:, 9:].T @ both[:9, 9:]
    errors, counts = [], np.array([20, 40, 80])
    for n in counts:
        belief = Gaussian(x, np.zeros((9, 9)))
        for _ in range(n):
            kalman = ExtendedKalmanFilter(INTEGRATORS['rk4'])
            belief = kalman.predict(belief, model, u, q, end / n)
        errors.append(np.abs(belief.cov - exact).max())
    assert errors[-1] < 1e-4 * np.abs(exact).max()  # (dt / tau)^2 / 3 = 1e-4
    assert order_of(errors, end / counts) == pytest.approx(2, abs=0.1)  # the trapezoid rule


def test_a_constant_force_is_found():
    mesh, flat = even_surface(3, 2, driven=(0, 1), damping=0.2)
    force = np.zeros((4, 3))
    force[2] = [0.05, 0.02, -0.1]
    force[3] = [0.0, 0.0, 0.08]
    u, pushed = mesh.input(flat[:2]), mesh.input(flat[:2], force=force)
    tau, sigma = 30.0, 0.1
    model = Disturbed(mesh, tau)
    kalman = ExtendedKalmanFilter(ImplicitEuler())
    truth = np.append(flat[2:], np.zeros(12))
    belief = Gaussian(
        np.append(truth, np.zeros(12)), np.diag([1e-8] * 12 + [0.01] * 12 + [0.01] * 12)
    )
    q = np.repeat([0.0, 1e-6, 2 * sigma**2 / tau], 12)
    obs = VisiblePositions.of_nodes(np.arange(4), 3e-4)
    for _ in range(300):
        truth = ImplicitEuler().step(mesh, truth, pushed, 0.01)
        belief = kalman.predict(belief, model, u, q, 0.01)
        belief, _ = kalman.update(belief, obs, truth[:12])
    found = belief.mean[24:].reshape(4, 3)
    # no noise in the markers, so what is left is the pull to zero over tau between corrections
    np.testing.assert_allclose(found, force, atol=1e-3)
    assert np.sqrt(belief.cov[-1, -1]) < 0.1 * sigma  # and the filter knows that it has found it


# --- a smooth force, with its rate


@pytest.fixture
def smooth():
    """As `example`, with a Matern process."""
    rng = np.random.default_rng(1)
    model, x, u = random_surface(rng, 3, 4, (0, 3), rest=(0.6, 1.6))
    process = ForceProcess.matern(0.2, TAU)
    return Disturbed(model, process), np.append(x, rng.normal(0, 0.2, 60)), u


def test_smooth_force_jacobian_equals_central_differences(smooth):
    model, x, u = smooth
    assert model.dim_x == 120
    expected = central_differences(lambda y: model.f(y, u), x, 1e-6)
    # entries up to 4e4 1/s^2; rounding 1e-9 of that
    atol = 1e-8 * np.abs(expected).max()
    np.testing.assert_allclose(model.jac(x, u).toarray(), expected, atol=atol)
    np.testing.assert_allclose(expected[60:90, 90:], np.eye(30), atol=1e-8)  # F' is the rate


@pytest.mark.parametrize('name', ['euler', 'rk4', 'implicit_euler'])  # any model will do for them
def test_smooth_force_step_jacobian_equals_central_differences(smooth, name):
    model, x, u = smooth
    method = INTEGRATORS[name]
    dt = 0.01 if name == 'implicit_euler' else 0.002
    expected = central_differences(lambda y: method.step(model, y, u, dt), x, 1e-6)
    after, found = method.step_jac(model, x, u, dt)
    # entries up to 1e2; rounding of 1 m/s over the step of the difference, 1e-10
    np.testing.assert_allclose(found, expected, atol=1e-7)
    rows = np.random.default_rng(3).normal(size=(4, 120))
    pulled_after, tangent = method.step_tangent(model, x, u, dt)
    np.testing.assert_allclose(tangent.pull(rows), rows @ found, atol=1e-10)  # rounding
    np.testing.assert_array_equal(pulled_after, after)


@pytest.mark.parametrize('make', [ForceProcess.ornstein_uhlenbeck, ForceProcess.matern])
def test_variance_at_rest_solves_the_lyapunov_equation(make):
    process = make(0.2, 0.7)
    noise = np.zeros_like(process.drift)
    noise[-1, -1] = process.density
    at_rest = solve_continuous_lyapunov(process.drift, -noise)
    # rounding of numbers below 1
    np.testing.assert_allclose(at_rest, np.diag(process.variance), atol=1e-14)
    assert at_rest[0, 0] == pytest.approx(0.04, rel=1e-12)


def test_matern_covariance_over_time():
    """(1 + t/tau) exp(-t/tau), which is that of smoothness 3/2."""
    process, t = ForceProcess.matern(1.0, 0.4), 0.3
    carried = expm(process.drift * t) @ np.diag(process.variance)
    assert carried[0, 0] == pytest.approx((1 + t / 0.4) * np.exp(-t / 0.4), rel=1e-12)
