"""Parameters as states: bounds, derivatives, filterpy's UKF, and the stiffness of a towel."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from references import central_differences, even_surface, random_covariance
from scipy.optimize import minimize

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.errors import ConfigError
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.sigma_points import SigmaPointFilter
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import Ruler
from cloth_predict.models.with_parameters import Parametrised, WithParameters
from cloth_predict.observations import VisiblePositions
from cloth_predict.simulation.ruler import ANNEX_A, measured, slide
from cloth_predict.tracking.ruler_assembly import (
    STATES,
    first_belief,
    joint_filter,
    joint_model,
    observation,
    process_noise,
)
from cloth_predict.types import Gaussian

NO_INPUT = np.zeros(0)
CONFIG = RulerConfig(g=10.0)


def bar(at=None):
    return WithParameters(
        partial(Ruler, 1.0, 0.2), ('L2', 'mu'), first=[0.2, 0.3], low=[0.1, 0.1], high=[0.5, 0.4],
        at=at,
    )  # fmt: skip


def towel(damping=0.02):
    """A 3 x 3 sheet whose stiffness is a state, its flat shape and its input."""
    mesh, flat = even_surface(3, 3, (0, 1, 2), stiffness=60.0, damping=damping, mass=0.1)

    def of(stiffness):
        k = np.full(len(mesh.springs.pairs), stiffness)
        return mesh.with_springs(replace(mesh.springs, stiffness=k))

    joint = WithParameters(of, ('stiffness',), first=[60.0], low=[1.0], high=[500.0])
    return joint, flat, mesh.input(flat[mesh.driven], np.zeros((3, 3)))


# --- the model


def test_parameters_come_last_or_where_they_are_wanted():
    own, values = np.arange(6.0), np.array([0.3, 0.2])
    np.testing.assert_array_equal(bar().joint(own, values), [0, 1, 2, 3, 4, 5, 0.3, 0.2])
    mixed = bar(at=(2, 5))
    x = mixed.joint(own, values)
    np.testing.assert_array_equal(x, [0, 1, 0.3, 2, 3, 0.2, 4, 5])
    slope = mixed.f(x, NO_INPUT)
    np.testing.assert_array_equal(slope[[2, 5]], 0.0)
    np.testing.assert_array_equal(slope[mixed.own], Ruler(1.0, 0.2, 0.3, 0.2).f(own, NO_INPUT))


def test_the_joint_state_of_the_paper_is_in_its_order():
    model = joint_model(CONFIG)
    x = model.joint(np.array([1.0, 2.0, 4.0, 5.0, 6.0, 7.0]), np.array([3.0, 8.0, 9.0, 10.0]))
    np.testing.assert_array_equal(x, np.arange(1, 11))
    assert STATES == ('x_G', 'y_G', 'L', 'alpha', 'V_x', 'V_y', 'V_alpha', 'L1', 'L2', 'mu')
    np.testing.assert_array_equal(observation(CONFIG).h(x), [1, 2, 3, 4])


def test_a_first_value_out_of_bounds_is_named():
    with pytest.raises(ConfigError, match=r'^mu: 0\.05 is not within its bounds 0\.1 to 1\.5$'):
        joint_model(replace(CONFIG, mu_low=0.1))


def test_the_model_sees_no_value_out_of_bounds():
    x = bar().joint(np.zeros((2, 6)), np.array([[0.0, 9.0], [0.3, -9.0]]))
    seen = bar().model_at(x)
    np.testing.assert_array_equal(seen.L2, [0.1, 0.3])
    np.testing.assert_array_equal(seen.mu, [0.4, 0.1])


@pytest.mark.parametrize('outside', [[0.05, 0.2], [0.6, 0.5]])
def test_a_belief_is_kept_within_bounds_at_its_likeliest_point_there(outside):
    model, P = bar(), random_covariance(np.random.default_rng(1), 8)
    belief = Gaussian(model.joint(np.ones(6), np.array(outside)), P)
    kept = model.kept(belief)
    precision = np.linalg.inv(P)
    best = minimize(
        lambda x: (x - belief.mean) @ precision @ (x - belief.mean), belief.mean,
        jac=lambda x: 2 * precision @ (x - belief.mean),
        bounds=[(None, None)] * 6 + [(0.1, 0.5), (0.1, 0.4)], tol=1e-14,
    )  # fmt: skip
    np.testing.assert_allclose(kept.mean, best.x, atol=1e-5)  # of the search
    np.testing.assert_array_equal(kept.cov, P)
    assert model.kept(kept) is kept


@pytest.mark.parametrize('at', [None, (2, 5)])
def test_jacobian_is_that_of_central_differences(at):
    model = bar(at)
    x = model.joint(np.array([0.1, 0.2, 0.3, 1.0, 0.5, 2.0]), np.array([0.3, 0.2]))
    found = model.jac(x, NO_INPUT).toarray()
    differences = central_differences(lambda x: model.f(x, NO_INPUT), x, 1e-6)
    np.testing.assert_allclose(found, differences, atol=1e-8)  # 1e-12 of the curvature
    assert model.jac_input(x, NO_INPUT).shape == (8, 0)


def test_a_towel_with_other_springs_is_one_that_was_built_with_them():
    mesh, flat = even_surface(3, 3, (0, 1, 2), stiffness=60.0, damping=0.02)
    other = even_surface(3, 3, (0, 1, 2), stiffness=20.0, damping=0.5)[0]
    changed = mesh.with_springs(other.springs)
    rng = np.random.default_rng(6)
    x, u = rng.normal(size=36), mesh.input(flat[mesh.driven], rng.normal(size=(3, 3)))
    np.testing.assert_array_equal(changed.f(x, u), other.f(x, u))
    np.testing.assert_array_equal(changed.jac(x, u).toarray(), other.jac(x, u).toarray())
    step = ImplicitEuler().step
    np.testing.assert_array_equal(step(changed, x, u, 0.01), step(other, x, u, 0.01))
    assert mesh.springs.stiffness[0] == 60.0


# --- its step


def sliding_case():
    x = bar().joint(np.array([0.1, 0.2, 0.3, 1.0, 0.5, 2.0]), np.array([0.3, 0.2]))
    return bar(), Sliding(0.01), x, NO_INPUT


def towel_case():
    model, flat, u = towel()
    rng = np.random.default_rng(2)
    own = np.concatenate([1.05 * flat[model.model.free].ravel(), rng.normal(0, 0.3, 18)])
    return model, ImplicitEuler(), model.joint(own, np.array([45.0])), u


@pytest.mark.parametrize('case', [sliding_case, towel_case])
def test_a_step_is_that_of_the_model_with_these_parameters(case):
    model, inner, x, u = case()
    after = Parametrised(inner).step(model, x, u, 0.02)
    alone = inner.step(model.model_at(x), x[model.own], u, 0.02)
    np.testing.assert_array_equal(after[model.own], alone)
    np.testing.assert_array_equal(after[model.at], x[model.at])


@pytest.mark.parametrize('case', [sliding_case, towel_case])
def test_derivative_of_a_step_is_that_of_central_differences(case):
    model, inner, x, u = case()
    rng, method = np.random.default_rng(3), Parametrised(inner)
    F = central_differences(lambda x: method.step(model, x, u, 0.02), x, 1e-6)
    after, tangent = method.step_tangent(model, x, u, 0.02)
    np.testing.assert_array_equal(after, method.step(model, x, u, 0.02))
    P, W = random_covariance(rng, model.dim_x), rng.normal(size=(3, model.dim_x))
    close = {'atol': 2e-7}  # of differences of slopes of up to 1e2
    np.testing.assert_allclose(method.step_jac(model, x, u, 0.02)[1], F, **close)
    np.testing.assert_allclose(tangent.push(P), F @ P, **close)
    np.testing.assert_allclose(tangent.pull(W), W @ F, **close)
    np.testing.assert_allclose(tangent.sandwich(P), F @ P @ F.T, **close)
    by_input = central_differences(lambda u: method.step(model, x, u, 0.02), u, 1e-6)
    if len(u):
        np.testing.assert_allclose(tangent.drive(np.eye(len(u))), by_input, **close)
        slopes = central_differences(lambda u: model.f(x, u), u, 1e-6)
        np.testing.assert_allclose(model.jac_input(x, u).toarray(), slopes, atol=1e-6)
        np.testing.assert_array_equal(model.input_after(u, 0.1), model.model.input_after(u, 0.1))


# --- filters


@pytest.mark.parametrize('version', [3, 5])
def test_the_joint_filter_is_filterpys_over_a_whole_run(version):
    shot = ANNEX_A[version]
    z = measured(slide(shot).at(np.arange(50) / 50), 1.0, np.random.default_rng(4))
    model, kalman, obs = joint_model(CONFIG), joint_filter(CONFIG), observation(CONFIG)
    belief, q, dt = first_belief(CONFIG, model, z[0]), process_noise(CONFIG), 0.02
    step = Parametrised(Sliding(CONFIG.step)).step
    points = MerweScaledSigmaPoints(10, CONFIG.alpha, beta=2.0, kappa=0.0)
    other = UnscentedKalmanFilter(
        10, 4, dt, hx=obs.h, fx=lambda x, dt: step(model, x, NO_INPUT, dt), points=points
    )
    half = 0.5 * dt * np.diag(q)  # of the noise, before and after the step
    other.x, other.P, other.Q, other.R = belief.mean, belief.cov, half, np.diag(obs.cov)
    for k in range(50):
        if k:
            belief = kalman.predict(belief, model, NO_INPUT, q, dt)
            other.P = other.P + half
            other.predict()
        belief = model.kept(kalman.update(belief, obs, z[k])[0])
        if not k:  # filterpy measures with the points of a prediction
            other.sigmas_f = points.sigma_points(other.x, other.P)
        other.update(z[k])
        other.x = model.kept(Gaussian(other.x, other.P)).mean
        np.testing.assert_allclose(belief.mean, other.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(belief.cov, other.P, rtol=1e-9, atol=1e-9)


def test_all_points_together_are_as_one_by_one():
    model, kalman = joint_model(CONFIG), joint_filter(CONFIG)
    belief = Gaussian(
        model.joint(np.array([0.0, 0.0, 0.0, 0.2, 0.1, 1.0]), model.first),
        np.diag(np.square([0.1, 0.1, 0.01, 0.1, 0.2, 0.2, 0.5, 0.1, 0.1, 0.1])),
    )
    found = kalman.predict(belief, model, NO_INPUT, process_noise(CONFIG), 0.02)
    single = replace(kalman, together=False)
    other = single.predict(belief, model, NO_INPUT, process_noise(CONFIG), 0.02)
    np.testing.assert_allclose(found.mean, other.mean, atol=1e-14)  # rounding
    np.testing.assert_allclose(found.cov, other.cov, atol=1e-14)  # rounding


@pytest.mark.parametrize('kind', ['ekf', 'ukf'])
def test_the_stiffness_of_a_towel_is_found_on_the_way(kind):
    model, flat, u = towel()
    truth, guess, dt, noise = 40.0, 60.0, 0.02, 3e-4
    rng, method = np.random.default_rng(5), Parametrised(INTEGRATORS['implicit_euler'])
    x = model.joint(np.append(flat[model.model.free].ravel(), np.zeros(18)), np.array([truth]))
    kalman = {
        'ekf': ExtendedKalmanFilter(method),
        'ukf': SigmaPointFilter(method, alpha=0.5, beta=2.0),
    }[kind]
    own = np.append(np.full(18, noise), np.full(18, 0.1))
    start = model.joint(x[model.own], np.array([guess]))
    belief = Gaussian(start, np.diag(np.square(model.joint(own, np.array([20.0])))))
    obs = VisiblePositions.of_nodes(np.arange(6), noise)
    q = model.joint(np.append(np.zeros(18), np.full(18, 1e-4)), np.array([0.0]))
    for _ in range(60):
        x = method.step(model, x, u, dt)
        belief = kalman.predict(belief, model, u, q, dt)
        z = x[obs.rows] + rng.normal(0, noise, 18)
        belief = model.kept(kalman.update(belief, obs, z)[0])
    sigma = np.sqrt(belief.cov[-1, -1])
    assert sigma < 0.02 * truth
    assert abs(belief.mean[-1] - truth) < 3 * sigma
