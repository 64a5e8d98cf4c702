"""The exponential step and its linear part: exact where the model is linear, else of order 2."""

import numpy as np
import pytest
from bodies import body
from references import (
    Linear,
    central_differences,
    damped_oscillators,
    order_of,
    random_covariance,
)
from scipy import sparse
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cloth_predict.integrators.exponential import Exponential
from cloth_predict.integrators.runge_kutta import RK4, RungeKutta
from cloth_predict.models.linear_part import LinearPart

NO_INPUT = np.zeros(0)
STEP = Exponential()


class Pendulums:
    """Coupled pendulums pushed by an input that moves: x' = A x + n(x, u), u = (value, rate)."""

    dim_u = 4

    def __init__(self, rng):
        self.A = damped_oscillators(rng, 3).A
        self.linear_part = LinearPart.of_matrix(self.A)
        self.gain, self.push = rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
        self.dim_x = 6

    def f(self, x, u):
        return self.A @ x + np.append(np.zeros(3), np.sin(self.gain @ x[:3]) + self.push @ u[:2])

    def jac(self, x, u):
        bent = np.zeros((6, 6))
        bent[3:, :3] = np.cos(self.gain @ x[:3])[:, None] * self.gain
        return sparse.csr_array(self.A + bent)

    def jac_input(self, x, u):
        full = np.zeros((6, 4))
        full[3:, :2] = self.push
        return sparse.csr_array(full)

    def input_after(self, u, dt):
        return np.append(u[:2] + dt * u[2:], u[2:])


def fixed_width(nodes=20):
    """The same with the aspect ratios held, and without local displacements."""
    free = np.ones(11, bool)
    free[1:4] = False
    return body(nodes, free=free, local=False)


def run(model, x, u, duration, steps):
    dt = duration / steps
    for k in range(steps):
        x = STEP.step(model, x, model.input_after(u, k * dt), dt)
    return x


# --- exact where the model is linear


@pytest.mark.parametrize('dt', [0.01, 3.0])
def test_a_linear_model_is_stepped_exactly_however_long_the_step(dt):
    rng = np.random.default_rng(2)
    model = damped_oscillators(rng, 4)
    x = rng.normal(size=8)
    after, step_jac = STEP.step_jac(model, x, NO_INPUT, dt)
    np.testing.assert_allclose(step_jac, expm(dt * model.A), atol=1e-14)  # rounding
    np.testing.assert_allclose(after, expm(dt * model.A) @ x, atol=1e-13)  # rounding


def test_a_linear_model_with_a_ramp_as_input_is_stepped_exactly():
    # x' = A x + B (u + t u'): the same as a linear model that has u and u' as states
    rng = np.random.default_rng(3)
    model = Pendulums(rng)
    model.gain[:] = 0.0
    x, u = rng.normal(size=6), rng.normal(size=4)
    both = np.zeros((10, 10))
    both[:6, :6], both[:6, 6:] = model.A, model.jac_input(x, u).toarray()
    both[6:8, 8:] = np.eye(2)
    exact = (expm(0.7 * both) @ np.append(x, u))[:6]
    np.testing.assert_allclose(STEP.step(model, x, u, 0.7), exact, atol=1e-14)  # rounding


@pytest.mark.parametrize('make', [body, fixed_width])
@pytest.mark.parametrize('dt', [0.01, 0.1])
def test_the_modes_of_a_body_are_its_matrix(make, dt):
    model, x, _ = make()
    rest = np.zeros(model.dim_u)
    A = model.jac(x, rest).toarray()
    after, step_jac = STEP.step_jac(model, x, rest, dt)
    np.testing.assert_allclose(step_jac, expm(dt * A), atol=1e-12)  # rounding of entries of 50
    # and gravity: x(t) = e^tA x + int e^sA g ds, from one exponential
    with_fall = np.zeros((model.dim_x + 1,) * 2)
    with_fall[:-1, :-1], with_fall[:-1, -1] = A, model.f(x, rest) - A @ x
    exact = (expm(dt * with_fall) @ np.append(x, 1.0))[:-1]
    np.testing.assert_allclose(after, exact, atol=1e-12)  # the same


def test_functions_of_the_matrix_are_what_they_are_called():
    model, x, _ = body(9)
    part, t = model.linear_part, 0.05
    A = part.matrix.toarray()
    one, zero = np.eye(model.dim_x), np.zeros((model.dim_x,) * 2)
    chained = expm(t * np.block([[A, one, zero], [zero, zero, one], [zero, zero, zero]]))
    for k, which in enumerate(('exp', 'once', 'twice')):
        expected = chained[: model.dim_x, k * model.dim_x : (k + 1) * model.dim_x]
        found = part.apply(which, t, one)
        np.testing.assert_allclose(found, expected, atol=1e-12)  # rounding of entries of 50
        np.testing.assert_allclose(part.apply(which, t, one, back=True), found.T, atol=1e-12)
        np.testing.assert_allclose(part.apply(which, t, x), found @ x, atol=1e-12)  # rounding
    local = part.modes[1]
    rows = local.rows[0].ravel()
    found = local.matrix('exp', t).reshape(18, 18)
    np.testing.assert_allclose(found, expm(t * A)[np.ix_(rows, rows)], atol=1e-12)  # rounding


def test_what_does_not_move_stays():
    model, x, u = fixed_width()
    after = STEP.step(model, x, u, 0.05)
    held = np.concatenate([~model.moving, ~model.moving])
    np.testing.assert_array_equal(after[held], x[held])


# --- of second order elsewhere


@pytest.mark.parametrize('inertial', [False, True])
def test_order_of_convergence_on_a_body(inertial):
    model, x, u = body(inertial=inertial)
    fine = RungeKutta(RK4)  # fourth order: at 1e-4 s its error is far below those judged
    exact = x
    for _ in range(500):
        exact = fine.step(model, exact, u, 1e-4)
    counts = np.array([4, 8, 16])
    errors = [np.abs(run(model, x, u, 0.05, n) - exact).max() for n in counts]
    assert order_of(errors, 0.05 / counts) == pytest.approx(2.0, abs=0.2)  # house rule


def test_order_of_convergence_with_an_input_that_moves():
    rng = np.random.default_rng(4)
    model = Pendulums(rng)
    x, u = rng.normal(size=6), rng.normal(size=4)
    exact = solve_ivp(
        lambda t, y: model.f(y, model.input_after(u, t)),
        (0, 1.0),
        x,
        method='DOP853',
        rtol=1e-12,
        atol=1e-12,
    ).y[:, -1]
    counts = np.array([16, 32, 64])
    errors = [np.abs(run(model, x, u, 1.0, n) - exact).max() for n in counts]
    assert order_of(errors, 1.0 / counts) == pytest.approx(2.0, abs=0.2)  # house rule


def test_stiffness_limits_no_step():
    model, x, u = body(w1=5e3)
    rates = np.linalg.eigvals(model.linear_part.matrix.toarray())
    assert 0.05 * np.abs(rates).max() > 100  # RK4 is unstable beyond 3
    coarse, fine = run(model, x, u, 0.05, 1), run(model, x, u, 0.05, 20)
    # forces held in space turn within the body, by some degrees: N of 0.002 on springs of 5e3 N/m
    assert np.abs(coarse - fine)[18 : model.dim_q].max() < 1e-4 * np.abs(x[18 : model.dim_q]).max()


# --- its derivative


@pytest.mark.parametrize('case', ['pendulums', 'body', 'inertial'])
def test_derivative_of_the_step_equals_central_differences(case):
    rng = np.random.default_rng(5)
    if case == 'pendulums':
        model = Pendulums(rng)
        x, u, dt = rng.normal(size=6), rng.normal(size=4), 0.3
    else:
        model, x, u = body(9, inertial=case == 'inertial')
        dt = 0.02
    after, step_jac = STEP.step_jac(model, x, u, dt)
    np.testing.assert_array_equal(after, STEP.step(model, x, u, dt))
    expected = central_differences(lambda y: STEP.step(model, y, u, dt), x, 1e-6)
    # the step of 1e-6 errs by 1e-12 of third derivatives, rounding by 1e-10
    np.testing.assert_allclose(step_jac, expected, atol=1e-8 * np.abs(expected).max())

    _, tangent = STEP.step_tangent(model, x, u, dt)
    rows, cov = rng.normal(size=(7, model.dim_x)), random_covariance(rng, model.dim_x)
    pulled = rows @ step_jac
    np.testing.assert_allclose(tangent.pull(rows), pulled, atol=1e-13 * np.abs(pulled).max())
    expected = step_jac @ cov @ step_jac.T
    np.testing.assert_allclose(tangent.sandwich(cov), expected, atol=1e-13 * expected.max())
    driven = central_differences(lambda y: STEP.step(model, x, y, dt), u, 1e-6)
    found = tangent.drive(np.eye(model.dim_u))
    np.testing.assert_allclose(found, driven, atol=1e-8 * np.abs(driven).max())  # as above


def test_the_derivative_of_a_linear_model_is_said_to_be_linear():
    model, x, _ = body(9)
    assert STEP.step_tangent(model, x, np.zeros(model.dim_u), 0.01)[1].linear
    model, x, u = body(9, inertial=True)
    assert not STEP.step_tangent(model, x, u, 0.01)[1].linear
    assert STEP.step_tangent(Linear(np.eye(2)), np.ones(2), NO_INPUT, 0.1)[1].linear
