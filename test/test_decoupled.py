"""The filter without most correlations: equal to dense formulas and to the EKF, and positive."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import REFERENCE, body, whole_covariance
from references import central_differences, kalman_update, random_covariance, trapezoid
from scipy.linalg import expm

from cloth_predict.filters.blocks import Blocks
from cloth_predict.filters.decoupled import Decoupled, position_covariances
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.sigma_points import SigmaPointFilter
from cloth_predict.integrators.exponential import Exponential
from cloth_predict.models.accelerated import Accelerated
from cloth_predict.models.disturbed import ForceProcess
from cloth_predict.models.superquadric import GLOBAL, LOCAL, ROTATION
from cloth_predict.observations import NodePositions, VisiblePositions
from cloth_predict.types import Gaussian

STEP = Exponential()
ROUGH, SMOOTH = ForceProcess.ornstein_uhlenbeck(1.0, 0.4), ForceProcess.matern(1.0, 0.4)
SIGMA = 1e-3


def scales(model):
    """Standard deviations of the states that are alike in what they move, shape (dim_x,)."""
    sigma = np.full(model.dim_x, 0.01)
    sigma[GLOBAL] = sigma[model.dim_q :][GLOBAL] = 0.03
    return sigma


def dense_prior(rng, model, x):
    """A belief with all correlations."""
    sigma = scales(model)
    return Gaussian(x, random_covariance(rng, model.dim_x) * np.outer(sigma, sigma))


def some_markers(rng, model, x, count=None, sigma=SIGMA):
    """Markers at some nodes, one of which has three, and their noisy positions."""
    nodes = np.arange(model.nodes) if count is None else rng.permutation(model.nodes)[:count]
    nodes = np.append(nodes, [nodes[1], nodes[1]])
    obs = NodePositions(model, nodes, sigma)
    return obs, obs.h(x) + rng.normal(0, 1e-3, 3 * len(nodes))


def noise(model):
    q = np.zeros(model.dim_x)
    q[model.dim_q : 2 * model.dim_q] = np.linspace(0.01, 0.02, model.dim_q)
    return q


def block_mask(blocks):
    """Which entries of the covariance a belief keeps, shape (dim_x, dim_x)."""
    mask = np.zeros((blocks.dim_x, blocks.dim_x), bool)
    mask[np.ix_(blocks.shared, blocks.shared)] = blocks.coupled
    for rows in blocks.own:
        mask[np.ix_(rows, rows)] = True
    return mask


# --- what is seen of a body


def test_positions_of_nodes_and_their_derivative():
    model, x, _ = body(12)
    x = np.append(x, [1.0, 2.0])  # states after those of the body
    nodes = np.array([3, 7, 3, 0])
    obs = NodePositions(model, nodes, np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_array_equal(obs.h(x).reshape(-1, 3), model.position(x)[nodes])
    np.testing.assert_allclose(obs.cov, np.repeat([0.01, 0.04, 0.09, 0.16], 3), rtol=1e-15)
    expected = central_differences(obs.h, x, 1e-6)
    np.testing.assert_allclose(obs.jac(x), expected, atol=1e-9)  # 1e-16 over the step of 1e-6


def test_what_does_not_move_is_not_learnt():
    free = np.ones(11, bool)
    free[[0, 4]] = False
    model, x, _ = body(12, free=free, local=False)
    obs, z = some_markers(np.random.default_rng(2), model, x)
    held = np.flatnonzero(~model.moving)
    assert not obs.jac(x)[:, held].any()
    kalman = Decoupled(STEP, Blocks.of_body(model, 'pose'))
    belief = kalman.start(Gaussian(x, np.diag(scales(model) ** 2)), model, None, None)
    after = kalman.update(belief, obs, z)[0].mean
    np.testing.assert_array_equal(after[held], x[held])
    assert np.abs(after - x)[model.moving.nonzero()[0]].min() > 0


# --- exact for the belief it is given


@pytest.mark.parametrize('coupling', ['parts', 'pose'])
@pytest.mark.parametrize('count', [None, 6, 3])
def test_an_update_is_the_dense_formula_for_this_prior(coupling, count):
    # 3 nodes: fewer rows than shared states
    rng = np.random.default_rng(3)
    model, x, _ = body(12)
    blocks = Blocks.of_body(model, coupling)
    prior = blocks.of(x, dense_prior(rng, model, x).cov)
    obs, z = some_markers(rng, model, x, count)
    found, learnt = Decoupled(STEP, blocks).update(prior, obs, z)
    P, H, r = whole_covariance(prior), obs.jac(x), z - obs.h(x)
    mean, cov = kalman_update(np.zeros(len(x)), P, H, np.diag(obs.cov), r)
    np.testing.assert_allclose(found.mean - x, mean, atol=1e-10)  # rounding of gains of 1e2
    kept = np.where(block_mask(blocks), cov, 0.0)
    sigma = np.sqrt(np.diag(cov))
    apart = (whole_covariance(found) - kept) / np.outer(sigma, sigma)
    assert np.abs(apart).max() < 1e-8  # of a correlation; variances fall by up to 1e-4
    S = H @ P @ H.T + np.diag(obs.cov)
    np.testing.assert_allclose(learnt.cov, S, rtol=1e-9, atol=1e-15)  # rounding
    np.testing.assert_allclose(learnt.nis, r @ np.linalg.solve(S, r), rtol=1e-9)  # rounding
    np.testing.assert_allclose(learnt.residual, r, atol=1e-15)  # rounding


@pytest.mark.parametrize('coupling', ['parts', 'pose'])
@pytest.mark.parametrize('case', ['linear', 'inertial', 'rigid'])
def test_a_prediction_is_the_dense_formula_for_this_belief(coupling, case):
    rng = np.random.default_rng(4)
    settings = {'linear': {}, 'inertial': {'inertial': True}, 'rigid': {'local': False}}[case]
    model, x, u = body(12, **settings)
    u = u if case == 'inertial' else 0.0 * u
    blocks = Blocks.of_body(model, coupling)
    belief = blocks.of(x, dense_prior(rng, model, x).cov)
    q, dt = noise(model) * np.tile(model.moving, 2), 0.03
    found = Decoupled(STEP, blocks).predict(belief, model, u, q, dt)
    mean, F = STEP.step_jac(model, x, u, dt)
    P = F @ whole_covariance(belief) @ F.T + trapezoid(F, dt * q)
    np.testing.assert_array_equal(found.mean, mean)
    kept = np.where(block_mask(blocks), P, 0.0)
    np.testing.assert_allclose(whole_covariance(found), kept, atol=1e-13)  # of variances of 1e-2


def test_one_block_is_the_ekf():
    rng = np.random.default_rng(5)
    model, x, _ = body(9)
    u, q = np.zeros(model.dim_u), noise(model)
    exact = ExtendedKalmanFilter(STEP)
    kalman = Decoupled(STEP, Blocks.whole(model.dim_x))
    left = dense_prior(rng, model, x)
    right = kalman.start(left, model, u, q)
    for count in (None, 4, 7):
        obs, z = some_markers(rng, model, x, count)
        left, learnt = exact.update(left, obs, z)
        right, other = kalman.update(right, obs, z)
        np.testing.assert_allclose(other.nis, learnt.nis, rtol=1e-8)  # rounding of S, 1e5 to 1
        np.testing.assert_allclose(other.cov, learnt.cov, atol=1e-10)
        np.testing.assert_allclose(right.mean, left.mean, atol=1e-10)
        np.testing.assert_allclose(whole_covariance(right), left.cov, atol=1e-10)
        left = exact.predict(left, model, u, q, 0.02)
        right = kalman.predict(right, model, u, q, 0.02)
        np.testing.assert_allclose(right.mean, left.mean, atol=1e-10)
        np.testing.assert_allclose(whole_covariance(right), left.cov, atol=1e-10)
    rows = LOCAL + np.arange(27).reshape(9, 3)
    ahead = kalman.forecast(right, model, [u, u], q, 0.05, rows)
    expected = exact.forecast(left, model, [u, u], q, 0.05, rows)
    np.testing.assert_allclose(ahead[0], expected[0], atol=1e-10)
    np.testing.assert_allclose(ahead[1], expected[1], atol=1e-10)


def test_blocks_are_the_marginals_of_a_full_covariance():
    rng = np.random.default_rng(6)
    model, x, _ = body(9)
    prior = dense_prior(rng, model, x)
    pose = whole_covariance(Blocks.of_body(model, 'pose').of(x, prior.cov))
    parts = whole_covariance(Blocks.of_body(model, 'parts').of(x, prior.cov))
    states = np.arange(model.dim_x) % model.dim_q
    part = np.digitize(states, [ROTATION.start, GLOBAL.start, LOCAL])
    node = np.where(states >= LOCAL, (states - LOCAL) // 3, -1)
    np.testing.assert_array_equal(pose, np.where(node[:, None] == node, prior.cov, 0.0))
    np.testing.assert_array_equal(parts, np.where(part[:, None] == part, pose, 0.0))


def test_displacements_that_stay_have_no_covariance():
    model, x, _ = body(9, local=False)
    belief = Blocks.of_body(model, 'pose').of(x, np.eye(model.dim_x))
    found = np.diag(whole_covariance(belief)).reshape(2, -1)
    np.testing.assert_array_equal(found, np.tile(np.arange(model.dim_q) < LOCAL, (2, 1)))


# --- several markers, no markers, wrong ones


def test_markers_at_one_node_are_what_they_are_one_after_the_other():
    rng = np.random.default_rng(7)
    model, x, _ = body(9)
    x[model.dim_q :] = 0.0
    blocks = Blocks.whole(model.dim_x)
    prior = dense_prior(rng, model, x)
    kalman, first = Decoupled(STEP, blocks), blocks.of(x, prior.cov)
    sigma = np.array([1e-3, 2e-3, 3e-3])
    obs = NodePositions(model, np.array([4, 4, 4]), sigma)
    z = obs.h(x) + rng.normal(0, 1e-6, 9)  # so near that the second linearisation is the first
    together, learnt = kalman.update(first, obs, z)
    one_by_one, nis = first, 0.0
    for k in range(3):
        single = NodePositions(model, obs.nodes[k : k + 1], sigma[k])
        one_by_one, part = kalman.update(one_by_one, single, z[3 * k : 3 * k + 3])
        nis += part.nis
    np.testing.assert_allclose(together.mean, one_by_one.mean, atol=1e-10)  # 1e-6 squared
    np.testing.assert_allclose(together.shared, one_by_one.shared, atol=1e-9)  # 1e-6 of 1e-3
    np.testing.assert_allclose(learnt.nis, nis, rtol=1e-2)  # of noise of 1e-6, linearised anew


def test_without_markers_nothing_is_learnt():
    model, x, _ = body(9)
    kalman = Decoupled(STEP, Blocks.of_body(model, 'pose'))
    belief = kalman.start(Gaussian(x, np.eye(model.dim_x)), model, None, None)
    obs = NodePositions(model, np.zeros(0, np.int64), SIGMA)
    after, learnt = kalman.update(belief, obs, np.zeros(0))
    assert after is belief
    assert learnt.nis == 0.0
    assert learnt.residual.shape == (0,)


def test_what_cannot_be_taken_is_refused():
    model, x, _ = body(9)
    kalman = Decoupled(STEP, Blocks.of_body(model, 'pose'))
    belief = kalman.start(Gaussian(x, np.eye(model.dim_x)), model, None, None)
    with pytest.raises(ValueError, match='positions of nodes of a body'):
        kalman.update(belief, VisiblePositions.of_nodes(np.array([0]), SIGMA), np.zeros(3))
    broken = replace(belief, own=-belief.own)
    obs = NodePositions(model, np.array([2]), SIGMA)
    with pytest.raises(FloatingPointError, match='not positive definite'):
        kalman.update(broken, obs, obs.h(x))


# --- positive, iterated, alike


@pytest.mark.parametrize('coupling', ['parts', 'pose'])
def test_covariances_stay_positive_over_a_long_run(coupling):
    rng = np.random.default_rng(8)
    model, x, _ = body(15)
    u, q = np.zeros(model.dim_u), noise(model)
    kalman = Decoupled(STEP, Blocks.of_body(model, coupling))
    belief = kalman.start(Gaussian(x, np.diag(np.full(model.dim_x, 1.0))), model, u, q)
    for k in range(200):
        seen = rng.permutation(15)[: rng.integers(0, 15)]
        obs = NodePositions(model, seen, 1e-5)  # 1e5 times surer than the prior
        belief = kalman.update(belief, obs, model.position(x)[seen].ravel())[0]
        belief = belief.moved_to(model.admissible(belief.mean))
        if k % 50 == 0:  # the markers' noise, relative to what the prior said
            assert np.linalg.eigvalsh(belief.own).min() > 0
            assert np.linalg.eigvalsh(belief.shared).min() > -1e-12
        np.testing.assert_array_equal(belief.shared, belief.shared.T)
        belief = kalman.predict(belief, model, u, q, 0.01)
        x = model.admissible(STEP.step(model, x, u, 0.01))
    assert np.linalg.eigvalsh(belief.own).min() > 0


def test_iterations_find_the_most_probable_state():
    # turned by half a radian, which one linearisation does not see through
    rng = np.random.default_rng(9)
    model, x, _ = body(15)
    x[model.dim_q :] = 0.0
    x[8] = 0.9  # away from the ends of the ranges, as the aspect ratios are
    turned = x.copy()
    turned[ROTATION] += 0.25 * rng.normal(size=4)
    turned = model.admissible(turned)
    obs = NodePositions(model, np.arange(15), SIGMA)
    z = obs.h(turned)
    sigma = np.full(model.dim_x, 0.003)
    sigma[ROTATION] = 0.3
    blocks = Blocks.of_body(model, 'pose')
    prior = blocks.of(x, np.diag(sigma**2))

    def misfit(y):
        return np.append((z - obs.h(y)) / SIGMA, (y - x) / sigma)

    found = [
        Decoupled(STEP, blocks, iterations).update(prior, obs, z)[0].mean
        for iterations in (1, 8, 9)
    ]
    costs = [np.sum(misfit(y) ** 2) for y in found]
    assert costs[1] < 0.1 * costs[0]
    # at the minimum: the gradient of what is made small vanishes, relative to that at the start
    jac = np.vstack([-obs.jac(found[2]) / SIGMA, np.diag(1 / sigma)])
    start = np.vstack([-obs.jac(x) / SIGMA, np.diag(1 / sigma)])
    slope, steep = jac.T @ misfit(found[2]), start.T @ misfit(x)
    assert np.abs(slope * sigma).max() < 1e-6 * np.abs(steep * sigma).max()
    np.testing.assert_allclose(found[2], found[1], atol=1e-8)


@pytest.mark.parametrize('coupling', ['parts', 'pose', 'full'])
def test_covariances_of_positions(coupling):
    rng = np.random.default_rng(10)
    model, x, _ = body(12)
    prior = dense_prior(rng, model, x)
    belief = prior if coupling == 'full' else Blocks.of_body(model, coupling).of(x, prior.cov)
    obs = NodePositions(model, np.array([0, 3, 3, 11]), SIGMA)
    H = obs.jac(x)
    expected = H @ whole_covariance(belief) @ H.T
    found = position_covariances(belief, obs)
    for k in range(4):
        rows = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(found[k], expected[rows, rows], atol=1e-15)  # of 1e-4


def test_sigma_points_and_ekf_agree_where_the_noise_is_small():
    rng = np.random.default_rng(11)
    model, x, u = body(6, inertial=True)
    q = 1e-4 * noise(model)
    ekf, ukf = ExtendedKalmanFilter(STEP), SigmaPointFilter(STEP, 1.0, 2.0)
    small = 1e-3 * scales(model)
    left = right = Gaussian(x, random_covariance(rng, model.dim_x) * np.outer(small, small))
    obs = NodePositions(model, np.arange(6), 1e-5)
    for _ in range(3):
        z = obs.h(left.mean) + rng.normal(0, 1e-5, 18)
        left, right = (kalman.update(of, obs, z)[0] for kalman, of in ((ekf, left), (ukf, right)))
        left, right = (
            kalman.predict(of, model, u, q, 0.01) for kalman, of in ((ekf, left), (ukf, right))
        )
    sigma = np.sqrt(np.diag(left.cov))
    # what is nonlinear is of second order: sigmas of 1e-5 on lengths of 0.3
    assert np.abs((left.mean - right.mean) / sigma).max() < 0.01
    assert np.abs((left.cov - right.cov) / np.outer(sigma, sigma)).max() < 0.01


# --- honest: what dropping correlations costs


def simulated(kalman, model, seed, frames=25):
    """NEES per degree of positions and of shared states, and the mean squared error [m^2].

    The truth moves by the model and the noise of the filter.
    """
    rng, u = np.random.default_rng(seed), np.zeros(model.dim_u)
    q, sigma = np.zeros(model.dim_x), np.full(model.dim_x, 0.003)
    q[model.dim_q :], sigma[model.dim_q :] = 1e-3, 0.03
    shape = REFERENCE.copy()
    shape[1:4] = 0.8, 0.7, 0.9  # away from the ends of the ranges
    mean = model.state(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), shape)
    x = mean + sigma * rng.normal(size=len(mean))
    belief = kalman.start(Gaussian(mean, np.diag(sigma**2)), model, u, q)
    obs, half = NodePositions(model, np.arange(model.nodes), 3e-4), np.sqrt(0.005 * q)
    shared = np.append(np.arange(LOCAL), model.dim_q + np.arange(LOCAL))
    told = []
    for k in range(frames):
        z = obs.h(x) + rng.normal(0, 3e-4, 3 * model.nodes)
        belief = kalman.update(belief, obs, z)[0]
        if k >= 10:
            error = model.position(belief.mean) - model.position(x)
            white = np.linalg.solve(position_covariances(belief, obs), error[:, :, None])
            off, cov = (belief.mean - x)[shared], belief.marginals(shared[None])[0]
            of_shared = off @ np.linalg.solve(cov, off) / len(shared)
            told.append(
                [np.mean(white[:, :, 0] * error), of_shared, np.mean(np.sum(error**2, axis=1))]
            )
        belief = kalman.predict(belief, model, u, q, 0.01)
        x = STEP.step(model, x + half * rng.normal(size=len(x)), u, 0.01)
        x = x + half * rng.normal(size=len(x))
    return np.mean(told, axis=0)


def test_errors_are_as_large_as_said_where_positions_are_asked_for():
    model, _, _ = body(15, gravity=(0.0, 0.0, 0.0))
    kinds = {
        'full': ExtendedKalmanFilter(STEP),
        'pose': Decoupled(STEP, Blocks.of_body(model, 'pose')),
        'parts': Decoupled(STEP, Blocks.of_body(model, 'parts')),
    }
    found = {
        name: np.mean([simulated(kalman, model, seed) for seed in range(4)], axis=0)
        for name, kalman in kinds.items()
    }
    # 45 coordinates, some ten independent frames and 4 runs: a standard deviation of 0.04
    assert found['full'][0] == pytest.approx(1.0, abs=0.15)
    assert found['full'][1] == pytest.approx(1.0, abs=0.3)
    for name in ('pose', 'parts'):
        # never too sure of where the nodes are, and nearly as near
        assert 0.5 < found[name][0] < 1.1
        assert found[name][2] < 1.5 * found['full'][2]
        # but far too sure of what share of it is shape, and what displacement
        assert found[name][1] > 10.0


# --- accelerations as states


def test_a_pushed_body_moves_as_its_jacobian_says():
    model, x, u = body(9, inertial=True)
    pushed = Accelerated(model, np.array([0, 1, 2, 5]), ROUGH)
    y = np.append(x, [0.5, -0.3, 0.2, 0.1])
    assert pushed.dim_x == len(y)
    found = pushed.jac(y, u).toarray()
    expected = central_differences(lambda a: pushed.f(a, u), y, 1e-6)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())  # rounding
    expected = central_differences(lambda a: pushed.f(y, a), u, 1e-6)
    np.testing.assert_allclose(
        pushed.jac_input(y, u).toarray(), expected, atol=1e-8 * np.abs(expected).max()
    )  # the same
    np.testing.assert_array_equal(pushed.input_after(u, 1.0), u)
    rate = pushed.f(y, u)
    np.testing.assert_allclose(rate[-4:], -y[-4:] / 0.4, rtol=1e-15)
    only = rate[model.dim_q :][[0, 1, 2, 5]] - model.f(x, u)[model.dim_q :][[0, 1, 2, 5]]
    np.testing.assert_allclose(only, y[-4:], atol=1e-13)  # of accelerations of 1e2


def test_a_smooth_push_has_a_rate():
    model, x, u = body(9)
    pushed = Accelerated(model, np.array([0, 5]), SMOOTH)
    y = np.append(x, [0.5, -0.3, 2.0, 1.0])  # pushes, and their rates
    rate = pushed.f(y, u)
    own = rate[model.dim_q :][[0, 5]] - model.f(x, u)[model.dim_q :][[0, 5]]
    np.testing.assert_allclose(own, y[-4:-2], atol=1e-13)  # of accelerations of 1e2
    np.testing.assert_array_equal(rate[-4:-2], y[-2:])
    np.testing.assert_allclose(rate[-2:], -y[-4:-2] / 0.4**2 - 2 * y[-2:] / 0.4, rtol=1e-14)
    found = pushed.jac(y, u).toarray()
    expected = central_differences(lambda a: pushed.f(a, u), y, 1e-6)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())  # rounding
    rest = np.zeros(model.dim_u)
    exact = expm(0.1 * pushed.jac(y, rest).toarray())
    step_jac = STEP.step_jac(pushed, y, rest, 0.1)[1]
    np.testing.assert_allclose(step_jac, exact, atol=1e-12)  # rounding of entries of 50


def test_a_pushed_body_is_stepped_exactly():
    model, x, _ = body(9, gravity=(0.0, 0.0, 0.0))
    pushed, rest = Accelerated(model, np.array([0, 1, 2]), ROUGH), np.zeros(model.dim_u)
    y = np.append(x, [0.5, -0.3, 0.2])
    after, step_jac = STEP.step_jac(pushed, y, rest, 0.1)
    exact = expm(0.1 * pushed.jac(y, rest).toarray())
    np.testing.assert_allclose(step_jac, exact, atol=1e-12)  # rounding of entries of 50
    np.testing.assert_allclose(after, exact @ y, atol=1e-12)  # the same
    assert pushed.admissible(2.0 * y)[ROTATION] @ pushed.admissible(2.0 * y)[ROTATION] == (
        pytest.approx(1.0)
    )


@pytest.mark.parametrize('process', [ROUGH, SMOOTH])
def test_a_pushed_body_is_followed_in_blocks(process):
    rng = np.random.default_rng(12)
    model, x, _ = body(9)
    pushed, rest = Accelerated(model, np.array([0, 1, 2]), process), np.zeros(model.dim_u)
    pushes = np.array([0.5, -0.3, 0.2, 2.0, 1.0, -3.0])[: 3 * pushed.order]
    y = np.append(x, pushes)
    blocks = Blocks.of_body(model, 'parts', pushed.pushed)
    prior = blocks.of(y, random_covariance(rng, len(y)) * 1e-4)
    translation = [0, 1, 2, *(model.dim_q + np.arange(3)), *range(model.dim_x, len(y))]
    assert np.abs(whole_covariance(prior)[np.ix_(translation, translation)]).min() > 0
    found = Decoupled(STEP, blocks).predict(prior, pushed, rest, np.zeros(len(y)), 0.05)
    F = STEP.step_jac(pushed, y, rest, 0.05)[1]
    expected = np.where(block_mask(blocks), F @ whole_covariance(prior) @ F.T, 0.0)
    np.testing.assert_allclose(whole_covariance(found), expected, atol=1e-15)  # of 1e-4


@pytest.mark.parametrize('coordinate', [7, 18])
def test_a_push_that_cannot_be_is_refused(coordinate):
    model, _, _ = body(9, free=np.arange(11) > 0)
    with pytest.raises(ValueError, match='only coordinates'):
        Accelerated(model, np.array([coordinate]), ROUGH)
