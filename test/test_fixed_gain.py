"""The observer with a covariance per node: its gain, its motion of a node, hidden nodes, a towel.

What it shares with the other filters is in `test_filter_ladder.py`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from references import (
    Linear,
    acceleration_jacobians,
    kalman_predict,
    kalman_update,
    random_surface,
    selection,
    trapezoid,
)
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2

from cloth_predict.config import load
from cloth_predict.filters.fixed_gain import FixedGain, NodeBelief, NodeMotion
from cloth_predict.formats.bag import read_recording
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed, ForceProcess
from cloth_predict.observations import VisiblePositions
from cloth_predict.tracker import Tracker
from cloth_predict.types import Gaussian

ROOT = Path(__file__).parents[1]
SIGMA, DT = 1e-3, 0.01
NO_INPUT = np.zeros(0)
PROCESSES = {
    'none': None,
    'rough': ForceProcess.ornstein_uhlenbeck(0.15, 0.3),
    'smooth': ForceProcess.matern(0.15, 0.23),
}


def loose_nodes(rng, nodes, process):
    """Nodes that nothing couples, each with its own mass and drag, under unknown forces.

    The model, its spectral densities, the same on the axes of a node, and a prior.
    """
    order = 2 if process is None else 2 + len(process.drift)
    A, q = np.zeros((order, nodes, order, nodes)), np.zeros((order, nodes))
    each = np.arange(nodes)
    A[0, each, 1, each] = 1.0
    A[1, each, 1, each] = -rng.uniform(1, 30, nodes)
    q[1] = rng.uniform(0.001, 0.1, nodes)
    if process is not None:
        A[1, each, 2, each] = 1 / rng.uniform(0.01, 0.03, nodes)
        A[2:, each, 2:, each] = process.drift
        q[-1] = process.density * rng.uniform(0.5, 2, nodes)
    A = np.kron(A.reshape(order * nodes, order * nodes), np.eye(3))
    variance = np.array([1e-4, 0.25, 0.02, 0.4])[:order, None] * rng.uniform(0.5, 2, nodes)
    mean = rng.normal(size=len(A))
    prior = Gaussian(mean, np.diag(np.repeat(variance, 3)))
    return Linear(A), np.repeat(q, 3), prior


def whole(belief):
    """Covariance of all states, as a matrix."""
    return belief.marginals(np.arange(len(belief.mean))[None])[0]


# --- against the textbooks


@pytest.mark.parametrize('process', PROCESSES.values(), ids=PROCESSES)
def test_the_gain_of_a_visible_node_becomes_that_of_the_riccati_equation(process):
    rng, nodes = np.random.default_rng(1), 3
    model, q, prior = loose_nodes(rng, nodes, process)
    observer = FixedGain(ImplicitEuler(), nodes)
    belief = observer.start(prior, model, NO_INPUT, q)
    obs = VisiblePositions.of_nodes(np.arange(nodes), SIGMA)
    for _ in range(1500):
        belief = observer.predict(belief, model, NO_INPUT, q, DT)
        moved, _ = observer.update(belief, obs, obs.h(belief.mean) + 1.0)
        steady, belief = belief, moved
    gain = (moved.mean - steady.mean).reshape(-1, nodes, 3)  # the response to a residual of 1 m
    order, A = len(gain), model.A.reshape(len(gain), nodes, 3, len(gain), nodes, 3)
    for node in range(nodes):
        F = np.linalg.inv(np.eye(order) - DT * A[:, node, 0, :, node, 0])
        noise = DT * q.reshape(order, nodes, 3)[:, node, 0]
        H = np.eye(1, order)
        P = solve_discrete_are(F.T, H.T, trapezoid(F, noise), np.array([[SIGMA**2]]))
        # scipy's own residual: P spans eight decades
        np.testing.assert_allclose(steady.cov[node], P, rtol=1e-7, atol=1e-12)
        K = P[:, 0] / (P[0, 0] + SIGMA**2)
        for axis in range(3):
            np.testing.assert_allclose(gain[:, node, axis], K, rtol=1e-7)  # the same


@pytest.mark.parametrize('process', PROCESSES.values(), ids=PROCESSES)
def test_where_nothing_couples_the_nodes_it_is_the_textbooks_filter(process):
    rng, nodes = np.random.default_rng(2), 4
    model, q, prior = loose_nodes(rng, nodes, process)
    F = ImplicitEuler().step_jac(model, prior.mean, NO_INPUT, DT)[1]
    observer = FixedGain(ImplicitEuler(), nodes)
    belief, x, P = observer.start(prior, model, NO_INPUT, q), prior.mean, prior.cov
    for _ in range(60):
        obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(nodes) < 0.6), SIGMA)
        z = rng.normal(size=len(obs.rows))
        x, P = kalman_predict(x, P, F, trapezoid(F, DT * q))
        H = selection(obs.rows, len(x))
        S, residual = H @ P @ H.T + np.diag(obs.cov), z - H @ x
        nis = residual @ np.linalg.solve(S, residual)
        x, P = kalman_update(x, P, H, np.diag(obs.cov), z)
        belief = observer.predict(belief, model, NO_INPUT, q, DT)
        belief, learnt = observer.update(belief, obs, z)
        scale = 1 + np.abs(x)  # residuals of 1 m against sigma of 1 mm: rates of up to 1e4
        np.testing.assert_allclose(belief.mean / scale, x / scale, atol=1e-9)  # the house bound
        np.testing.assert_allclose(whole(belief), P, atol=1e-9)  # the same
        np.testing.assert_allclose(learnt.cov, S, atol=1e-9)  # the same
        assert learnt.nis == pytest.approx(nis, rel=1e-6)  # 1e-9 over sigma of 1e-3
    ahead = observer.forecast(belief, model, [NO_INPUT] * 5, q, DT, np.arange(12).reshape(4, 3))
    for _ in range(5):
        x, P = kalman_predict(x, P, F, trapezoid(F, DT * q))
    for node, cov in enumerate(ahead[1]):
        own = slice(3 * node, 3 * node + 3)
        np.testing.assert_allclose(cov, P[own, own], atol=1e-9)  # the house bound


def test_nees_and_nis_lie_in_their_chi_square_bands():
    """Loose nodes under smooth forces drawn from their own noise, a third unseen; 40 runs."""
    rng, nodes, runs, steps = np.random.default_rng(3), 4, 40, 40
    model, q, prior = loose_nodes(rng, nodes, PROCESSES['smooth'])
    size = model.dim_x
    F = ImplicitEuler().step_jac(model, prior.mean, NO_INPUT, DT)[1]
    observer, half = FixedGain(ImplicitEuler(), nodes), np.sqrt(DT * q / 2)
    nees, nis, seen = 0.0, 0.0, 0
    for _ in range(runs):
        truth = prior.mean + np.sqrt(np.diag(prior.cov)) * rng.normal(size=size)
        belief = observer.start(prior, model, NO_INPUT, q)
        for _ in range(steps):
            truth = F @ (truth + half * rng.normal(size=size)) + half * rng.normal(size=size)
            obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(nodes) < 0.7), SIGMA)
            z = truth[obs.rows] + rng.normal(0, SIGMA, len(obs.rows))
            belief = observer.predict(belief, model, NO_INPUT, q, DT)
            belief, learnt = observer.update(belief, obs, z)
            nis, seen = nis + learnt.nis, seen + len(z)
        error = truth - belief.mean
        nees += error @ np.linalg.solve(whole(belief), error)
    # innovations are independent, errors of one run are not: one NEES per run; 99.8 % bands
    for found, degrees in ((nees, size * runs), (nis, seen)):
        low, high = chi2.ppf([0.001, 0.999], degrees)
        assert low < found < high


# --- the motion of a node


def test_a_node_has_its_mass_its_force_and_the_damping_that_its_neighbours_leave():
    mesh, x, u = random_surface(np.random.default_rng(4), 4, 3, (0, 2))
    process = ForceProcess.matern(0.15, 0.23)
    model = Disturbed(mesh, process)
    found = NodeMotion.of(model, np.append(x, np.ones(60)), u, 10).drift
    position = mesh.surface(x, u)[0]
    jav = acceleration_jacobians(mesh.springs, mesh.mass, position)[1]
    damping = -jav[::3, ::3][np.ix_(mesh.free, mesh.free)]
    expected = np.zeros((10, 4, 4))
    expected[:, 0, 1] = 1.0
    expected[:, 1, 1] = -1 / np.diag(np.linalg.inv(damping))
    expected[:, 1, 2] = 1 / mesh.mass[mesh.free]
    expected[:, 2:, 2:] = process.drift
    # up to 100 1/s, to which the code adds 1e-9 1/s so that it may be none
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


def test_a_push_on_one_node_alone_decides_its_damping():
    """Dampers alone, nodes without mass: a force on node i moves it at F / c."""
    mesh, x, u = random_surface(np.random.default_rng(5), 3, 3, (0, 1))
    motion = NodeMotion.of(mesh, x, u, 7)
    n = 21
    damping = -mesh.jac(x, u)[n:, n:].toarray()
    for node in range(7):
        push = np.zeros(n)
        push[3 * node + 1] = 1.0  # N / kg
        speed = np.linalg.solve(damping, push)[3 * node + 1]
        assert -1 / motion.drift[node, 1, 1] == pytest.approx(speed, rel=1e-8)  # 1e-9 of 10 1/s


def test_a_surface_without_dampers_has_free_nodes():
    model = Linear(np.block([[np.zeros((6, 6)), np.eye(6)], [-np.eye(6), np.zeros((6, 6))]]))
    drift = NodeMotion.of(model, np.zeros(12), NO_INPUT, 2).drift
    np.testing.assert_allclose(drift, [[[0, 1], [0, 0]]] * 2, atol=2e-9)  # 1e-9 1/s is added


# --- hidden nodes


@pytest.fixture
def surface():
    """A 4 x 3 mesh under smooth unknown forces, its noise, and a prior."""
    mesh, x, u = random_surface(np.random.default_rng(6), 4, 3, (0, 2))
    model, n = Disturbed(mesh, PROCESSES['smooth']), 3 * len(mesh.free)
    q = np.repeat([0.0, 0.5, 0.0, PROCESSES['smooth'].density], n)
    variance = np.repeat([1e-4, 0.25, 0.01, 0.4], n)
    return model, u, q, Gaussian(np.append(x, np.zeros(2 * n)), np.diag(variance))


def test_a_hidden_node_is_not_corrected_and_counts_more_on_its_return(surface):
    model, u, q, prior = surface
    observer = FixedGain(ImplicitEuler(), 10)
    belief = observer.start(prior, model, u, q)
    shown, hidden = np.arange(10), np.delete(np.arange(10), 4)
    gains = []
    for k in range(80):
        seen = VisiblePositions.of_nodes(hidden if 40 <= k < 70 else shown, SIGMA)
        belief = observer.predict(belief, model, u, q, DT)
        after, _ = observer.update(belief, seen, seen.h(belief.mean) + 1e-3)
        change = (after.mean - belief.mean).reshape(4, 10, 3)
        gains.append(1e3 * change[:, 4, 1])
        belief = after
    gains = np.array(gains)
    assert (gains[40:70] == 0).all()
    assert gains[39, 0] < 0.7 < 0.99 < gains[70, 0]  # all that the marker says is taken
    assert (np.diff(gains[70:75, 0]) < 0).all()  # and from there back
    np.testing.assert_allclose(gains[-1], gains[39], rtol=0.05)  # ten frames: some memory is left


def test_the_spread_of_a_hidden_node_is_that_of_its_own_motion(surface):
    model, u, q, prior = surface
    observer = FixedGain(ImplicitEuler(), 10)
    belief = observer.start(prior, model, u, q)
    A, P = belief.motion.drift[3], np.array(belief.cov[3])
    F = np.linalg.inv(np.eye(4) - DT * A)
    for _ in range(25):
        belief = observer.predict(belief, model, u, q, DT)
        P = F @ P @ F.T + trapezoid(F, DT * q.reshape(4, 10, 3)[:, 3, 0])
    np.testing.assert_allclose(belief.cov[3], P, rtol=1e-12)  # rounding


# --- the belief


def test_covariances_between_axes_and_nodes_are_zero(surface):
    model, u, q, prior = surface
    observer = FixedGain(ImplicitEuler(), 10)
    belief = observer.predict(observer.start(prior, model, u, q), model, u, q, DT)
    each = np.zeros((4, 10, 3, 4, 10, 3))
    for node in range(10):
        for axis in range(3):
            each[:, node, axis, :, node, axis] = belief.cov[node]
    np.testing.assert_array_equal(whole(belief), each.reshape(120, 120))
    rows = np.array([[0, 31, 33], [119, 59, 29]])
    for group, found in zip(rows, belief.marginals(rows), strict=True):
        np.testing.assert_array_equal(found, whole(belief)[np.ix_(group, group)])


def test_only_whole_nodes_with_independent_noise_can_be_seen(surface):
    model, u, q, prior = surface
    observer = FixedGain(ImplicitEuler(), 10)
    belief = observer.start(prior, model, u, q)
    for rows, cov in (
        (np.array([0, 1]), np.ones(2)),
        (np.array([0, 1, 5]), np.ones(3)),
        (np.array([3, 4, 5]), np.eye(3)),
    ):
        with pytest.raises(ValueError, match='whole nodes'):
            observer.update(belief, VisiblePositions(rows, cov), np.zeros(len(rows)))


def test_a_variance_that_is_not_positive_is_an_error():
    motion = NodeMotion(np.zeros((1, 2, 2)))
    belief = NodeBelief(np.zeros(6), np.diag([-1.0, 1.0])[None], motion)
    obs = VisiblePositions.of_nodes(np.array([0]), SIGMA)
    with pytest.raises(FloatingPointError, match='positive definite'):
        FixedGain(ImplicitEuler(), 1).update(belief, obs, np.zeros(3))


# --- on the recording


def towel(kind, frames, **settings):
    """3-D RMS error [m] 0.1 s ahead and share of coordinates within 2 sigma, of free nodes."""
    config = load(ROOT / 'config' / 'towel_coarse.yaml')
    config = replace(config, filter=replace(config.filter, kind=kind, **settings))
    markers = read_recording(ROOT / 'bags' / 'towel_fan').markers
    tracker, offsets, sigmas = Tracker(config), [], []
    for k in range(frames):
        tracker.step(int(markers.stamps[k]), markers.positions[k], markers.visible[k])
        if k >= 100 and not k % 4:  # settled
            ahead = tracker.predict(0.1)
            later = np.where(markers.visible[k + 10][:, None], markers.positions[k + 10], np.nan)
            offsets.append((ahead.position - later)[4:])
            sigmas.append(ahead.sigma[4:])
    off, sigma = np.array(offsets), np.array(sigmas)[..., None] * np.ones(3)
    known = np.isfinite(off)
    within = np.mean(np.abs(off[known]) <= 2 * sigma[known])
    return np.sqrt(np.nanmean((off**2).sum(axis=-1))), within


def test_the_towel_is_predicted_as_well_as_by_the_ekf_and_with_an_honest_sigma():
    error, within = towel('fixed_gain', 400)
    full, _ = towel('ekf', 400)
    assert error < 1.02 * full  # measured over the whole recording: 0.96
    assert 0.85 < within < 0.99  # a normal error has 0.954
