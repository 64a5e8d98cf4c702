"""Every step in time: its order by regression, its exact Jacobian, its stability."""

import numpy as np
import pytest
from references import (
    Linear,
    central_differences,
    damped_oscillators,
    even_surface,
    order_of,
    random_covariance,
    random_surface,
)
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.integrators.runge_kutta import EULER, RK4, RungeKutta, Tableau
from cloth_predict.models.disturbed import Disturbed, ForceProcess, Unknown

ORDERS = {'euler': 1, 'rk4': 4, 'implicit_euler': 1, 'implicit_midpoint': 2, 'exponential': 2}
ON_SURFACES = ('euler', 'rk4', 'implicit_euler', 'implicit_midpoint')
"""A surface offers no linear part: it has springs that turn."""
NO_INPUT = np.zeros(0)


def run(method, model, x, u, dt, steps):
    for k in range(steps):
        x = method.step(model, x, model.input_after(u, k * dt), dt)
    return x


def test_every_integrator_is_tested():
    assert ORDERS.keys() == INTEGRATORS.keys()
    assert {name: method.order for name, method in INTEGRATORS.items()} == ORDERS


@pytest.mark.parametrize('name', ON_SURFACES)  # the exponential step has no error here
def test_order_of_convergence_against_expm(name):
    rng = np.random.default_rng(1)
    model = damped_oscillators(rng, 4)
    x = rng.normal(size=8)
    exact = expm(2.0 * model.A) @ x
    counts = np.array([32, 64, 128, 256])
    errors = [
        np.linalg.norm(run(INTEGRATORS[name], model, x, NO_INPUT, 2.0 / n, n) - exact)
        for n in counts
    ]
    assert min(errors) > 1e-11  # above rounding, so that the slope is that of the method
    assert order_of(errors, 2.0 / counts) == pytest.approx(ORDERS[name], abs=0.2)  # house rule


@pytest.mark.parametrize('name', ON_SURFACES)
def test_order_of_convergence_on_a_surface(name):
    # all springs stay taut: a spring that goes slack has a kink in the implicit step's matrix
    model, x, u = random_surface(np.random.default_rng(2), 3, 3, (0, 2), rest=(0.3, 0.6))
    x[21:] *= 0.1
    end = 0.005
    exact = solve_ivp(
        lambda t, y: model.f(y, model.input_after(u, t)),
        (0, end),
        x,
        method='DOP853',
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    counts = np.array([16, 32, 64] if name == 'rk4' else [128, 256, 512])
    errors = [
        np.linalg.norm(run(INTEGRATORS[name], model, x, u, end / n, n) - exact) for n in counts
    ]
    assert order_of(errors, end / counts) == pytest.approx(ORDERS[name], abs=0.2)  # house rule


def test_the_classic_method_by_hand():
    # Gomes 2016, eq. 3.27
    model, x, u = random_surface(np.random.default_rng(3), 2, 3, (1,))
    dt = 0.004
    k1 = model.f(x, u)
    middle, end = model.input_after(u, dt / 2), model.input_after(u, dt)
    k2 = model.f(x + dt / 2 * k1, middle)
    k3 = model.f(x + dt / 2 * k2, middle)
    k4 = model.f(x + dt * k3, end)
    expected = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    found = RungeKutta(RK4).step(model, x, u, dt)
    np.testing.assert_allclose(found, expected, atol=1e-13)  # rounding of velocities of 1 m/s
    found = RungeKutta(EULER).step(model, x, u, dt)
    np.testing.assert_array_equal(found, x + dt * k1)


def test_implicit_euler_on_a_linear_model_is_the_backward_step():
    model = damped_oscillators(np.random.default_rng(4), 3)
    x = np.arange(1.0, 7.0)
    backward = np.linalg.inv(np.eye(6) - 0.1 * model.A)
    found, step_jac = ImplicitEuler().step_jac(model, x, NO_INPUT, 0.1)
    np.testing.assert_allclose(found, backward @ x, atol=1e-14)  # rounding
    np.testing.assert_allclose(step_jac, backward, atol=1e-14)  # rounding


def test_the_midpoint_step_damps_no_oscillation_and_the_first_order_one_does():
    # x'' = -w^2 x, with w dt = 0.5; backward Euler divides by 1 - i w dt in each step
    model, x = Linear(np.array([[0.0, 1.0], [-25.0, 0.0]])), np.array([0.0, 5.0])
    for name, left in (('implicit_midpoint', 1.0), ('implicit_euler', 1.25**-20)):
        after = run(INTEGRATORS[name], model, x, NO_INPUT, 0.1, 40)
        amplitude = np.hypot(after[0], after[1] / 5.0)
        assert amplitude == pytest.approx(left, rel=1e-12)  # rounding


@pytest.mark.parametrize('disturbed', [False, True, 'air'])
@pytest.mark.parametrize('rest', [(0.6, 0.95), (1.05, 1.6), (0.6, 1.6)])
@pytest.mark.parametrize('name', ON_SURFACES)
def test_jacobian_of_the_step_equals_central_differences(name, rest, disturbed):
    rng = np.random.default_rng(5)
    model, x, u = random_surface(rng, 3, 4, (0, 3), rest, air=disturbed == 'air')
    # away from the kink of the clamp at l = r, where a step of 1e-7 m must not change the side
    position, _ = model.surface(x, u)
    i, j = model.springs.pairs.T
    length = np.linalg.norm(position[i] - position[j], axis=1)
    assert np.abs(length - model.springs.rest_length).min() > 1e-4
    if disturbed == 'air':  # gusts that are correlated, a common wind, and forces at some nodes
        model = Disturbed(
            model,
            Unknown(ForceProcess.matern(0.1, 0.3), slice(30, 40), 4, rng.normal(size=(10, 4))),
            Unknown(ForceProcess.ornstein_uhlenbeck(0.1, 1.0), slice(40, 43), 3),
            Unknown(ForceProcess.matern(0.1, 0.2), slice(0, 30), 6, rng.normal(size=(30, 6))),
        )
        x = np.append(x, rng.normal(0, 0.2, 23))
    elif disturbed:
        model = Disturbed(model, 0.3)
        x = np.append(x, rng.normal(0, 0.2, 30))
    method, dt = INTEGRATORS[name], 0.01 if name == 'implicit_euler' else 0.003
    after, step_jac = method.step_jac(model, x, u, dt)
    np.testing.assert_array_equal(after, method.step(model, x, u, dt))
    expected = central_differences(lambda y: method.step(model, y, u, dt), x, 1e-7)
    # entries of 1 to 1e3; rounding: 1e-16 of velocities of 10 m/s over the step of 1e-7
    np.testing.assert_allclose(step_jac, expected, atol=3e-8 * np.abs(expected).max())

    also_after, tangent = method.step_tangent(model, x, u, dt)
    np.testing.assert_array_equal(also_after, after)
    rows = rng.normal(size=(7, model.dim_x))
    pulled = rows @ step_jac
    # rounding of two solves with a condition number of 1e3
    np.testing.assert_allclose(tangent.pull(rows), pulled, atol=1e-13 * np.abs(pulled).max())
    np.testing.assert_allclose(
        tangent.push(rows.T), step_jac @ rows.T, atol=1e-13 * np.abs(pulled).max()
    )  # the same
    cov = random_covariance(rng, model.dim_x)
    expected = step_jac @ cov @ step_jac.T
    np.testing.assert_allclose(
        tangent.sandwich(cov), expected, atol=1e-13 * np.abs(expected).max()
    )  # the same
    driven = central_differences(lambda y: method.step(model, x, y, dt), u, 1e-7)
    found = tangent.drive(np.eye(model.dim_u))
    np.testing.assert_allclose(found, driven, atol=3e-8 * np.abs(driven).max())  # as above


def test_implicit_step_is_stable_where_the_explicit_ones_blow_up():
    # Gomes 2016, section 6.4: k = 300 N/m, m = 0.017 kg, one step per 0.1 s
    model, flat = even_surface(5, 4, driven=range(4), stiffness=300.0, damping=0.08)
    u = model.input(flat[:4])
    start = np.append(flat[4:], np.zeros(48))
    start += np.random.default_rng(6).normal(0, 1e-3, 96)
    x = run(ImplicitEuler(), model, start, u, 0.1, 100)
    # the towel of 0.8 x 0.6 m hangs still: no node further than its own size from where it was
    assert np.abs(x[:48] - start[:48]).max() < 0.8
    # m/s; it swings out and in as a pendulum, whose amplitude falls by e every second or so
    assert np.abs(x[48:]).max() < 1e-4
    for name in ('euler', 'rk4'):
        with np.errstate(over='ignore', invalid='ignore'):
            x = run(INTEGRATORS[name], model, start, u, 0.1, 20)
        assert not np.abs(x).max() < 1e3  # m; dt times the highest frequency is 40


@pytest.mark.parametrize('name', INTEGRATORS)
def test_a_constant_slope_is_integrated_exactly(name):
    # x' = (v, 0): every consistent method moves on by v dt
    model = Linear(np.array([[0.0, 1.0], [0.0, 0.0]]))
    found, step_jac = INTEGRATORS[name].step_jac(model, np.array([1.0, 2.0]), NO_INPUT, 0.5)
    np.testing.assert_allclose(found, [2.0, 2.0], rtol=1e-15)  # rounding
    np.testing.assert_allclose(step_jac, [[1, 0.5], [0, 1]], rtol=1e-15)  # rounding


def test_a_wrong_tableau_is_refused():
    with pytest.raises(ValueError, match='strictly lower triangular'):
        Tableau(a=((), (0.5, 0.5)), b=(0.5, 0.5), order=2)
    with pytest.raises(ValueError, match='strictly lower triangular'):
        Tableau(a=((),), b=(0.5, 0.5), order=2)
    with pytest.raises(ValueError, match='add up to one'):
        Tableau(a=((), (1.0,)), b=(0.5, 0.4), order=2)
