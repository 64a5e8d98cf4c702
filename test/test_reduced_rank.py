"""The filter in smooth modes: the EKF with all, the fixed gain with none, exact steps between.

What it shares with the other filters is in `test_filter_ladder.py`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from references import Linear, kalman_predict, kalman_update, random_surface, selection
from scipy.linalg import eigh
from scipy.stats import chi2

from cloth_predict.config import load
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.fixed_gain import FixedGain
from cloth_predict.filters.reduced_rank import ModalBelief, Modes, ReducedRank
from cloth_predict.formats.bag import read_recording
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed, ForceProcess
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import Springs
from cloth_predict.observations import VisiblePositions
from cloth_predict.tracker import Tracker
from cloth_predict.types import Gaussian

ROOT = Path(__file__).parents[1]
SIGMA, DT = 1e-3, 0.005
NO_INPUT = np.zeros(0)


@pytest.fixture
def surface():
    """A 4 x 3 mesh under smooth forces, all springs and masses different, noise, and a prior."""
    rng = np.random.default_rng(1)
    mesh, x, u = random_surface(rng, 4, 3, (0, 2))
    process = ForceProcess.matern(0.15, 0.23)
    model, n = Disturbed(mesh, process), 3 * len(mesh.free)
    q = np.repeat([0.0, 0.5, 0.0, process.density], n) * rng.uniform(0.5, 2, 4 * n)
    variance = np.repeat([1e-4, 0.25, 0.01, 0.4], n) * rng.uniform(0.5, 2, 4 * n)
    return model, u, q, Gaussian(np.append(x, np.zeros(2 * n)), np.diag(variance))


def frames(rng, mesh, x, u, count):
    """Markers of a true motion that starts at another state, about a third of them missing."""
    x = x + rng.normal(0, 0.01, len(x))
    for _ in range(count):
        x = ImplicitEuler().step(mesh, x, u, DT)
        obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(len(mesh.free)) < 0.7), SIGMA)
        yield obs, x[obs.rows] + rng.normal(0, SIGMA, len(obs.rows))


def whole(belief):
    """Covariance of all states, as a matrix."""
    return belief.marginals(np.arange(len(belief.mean))[None])[0]


def lifted(shapes, groups):
    """B as a matrix."""
    return np.kron(np.eye(groups), np.kron(shapes, np.eye(3)))


def random_modes(rng, nodes, rank):
    return Modes(np.linalg.qr(rng.normal(size=(nodes, rank)))[0])


# --- its two ends


def test_with_all_modes_it_is_the_ekf(surface):
    model, u, q, prior = surface
    reduced = ReducedRank(ImplicitEuler(), Modes.smoothest(model.model, 10))
    kalman, full = ExtendedKalmanFilter(ImplicitEuler()), prior
    belief = reduced.start(prior, model, u, q)
    x = prior.mean[: model.model.dim_x]
    for obs, z in frames(np.random.default_rng(2), model.model, x, u, 40):
        full = kalman.predict(full, model, u, q, DT)
        belief = reduced.predict(belief, model, u, q, DT)
        full, expected = kalman.update(full, obs, z)
        belief, learnt = reduced.update(belief, obs, z)
        # the house bound; positions of 0.5 m, rates of the forces of 10 N/s
        np.testing.assert_allclose(belief.mean, full.mean, atol=1e-9)
        np.testing.assert_allclose(whole(belief), full.cov, atol=1e-9)
        np.testing.assert_allclose(learnt.cov, expected.cov, atol=1e-9)
        assert learnt.nis == pytest.approx(expected.nis, rel=1e-6)  # 1e-9 over sigma of 1e-3
    rows = np.array([[0, 1, 2], [7, 29, 35], [115, 4, 63]])
    mean, cov = reduced.forecast(belief, model, [u] * 5, q, DT, rows)
    expected_mean, expected_cov = kalman.forecast(full, model, [u] * 5, q, DT, rows)
    np.testing.assert_allclose(mean, expected_mean, atol=1e-9)  # the house bound
    np.testing.assert_allclose(cov, expected_cov, atol=1e-9)  # the same


def test_more_modes_than_nodes_are_all(surface):
    mesh = surface[0].model
    np.testing.assert_array_equal(
        Modes.smoothest(mesh, 99).shapes, Modes.smoothest(mesh, 10).shapes
    )


def test_with_modes_that_hold_nothing_it_is_the_fixed_gain(surface):
    model, u, q, prior = surface
    reduced = ReducedRank(ImplicitEuler(), Modes(np.zeros((10, 1))))
    observer = FixedGain(ImplicitEuler(), 10)
    belief, other = reduced.start(prior, model, u, q), observer.start(prior, model, u, q)
    x = prior.mean[: model.model.dim_x]
    for obs, z in frames(np.random.default_rng(3), model.model, x, u, 40):
        belief = reduced.predict(belief, model, u, q, DT)
        other = observer.predict(other, model, u, q, DT)
        belief, learnt = reduced.update(belief, obs, z)
        other, expected = observer.update(other, obs, z)
        np.testing.assert_allclose(belief.mean, other.mean, atol=1e-11)  # rounding of rates of 10
        np.testing.assert_allclose(belief.local, other.cov, rtol=1e-9)  # rounding of P - W'W
        np.testing.assert_allclose(learnt.cov, expected.cov, rtol=1e-9)  # the same
        assert learnt.nis == pytest.approx(expected.nis, rel=1e-9)  # the same


# --- between them


def test_an_update_is_that_of_the_sum_of_modes_and_nodes():
    """Given P = B C B' + D: mean, NIS and the covariances of modes and of nodes are exact."""
    rng, nodes, rank, order = np.random.default_rng(4), 6, 2, 3
    modes = random_modes(rng, nodes, rank)
    root = rng.normal(size=(18, 36))
    local = rng.normal(size=(nodes, order, 2 * order))
    local = 1e-2 * local @ local.transpose(0, 2, 1)
    belief = ModalBelief(rng.normal(size=54), root @ root.T, local, modes, None)
    obs = VisiblePositions.of_nodes(np.array([4, 0, 3]), 0.1)
    z = rng.normal(size=9)
    found, learnt = ReducedRank(ImplicitEuler(), modes).update(belief, obs, z)
    # the state as the sum x = [B I] [a; d], which the textbook conditions as one Gaussian
    D = np.zeros((order, nodes, 3, order, nodes, 3))
    for node in range(nodes):
        for axis in range(3):
            D[:, node, axis, :, node, axis] = local[node]
    D, both = D.reshape(54, 54), np.hstack([lifted(modes.shapes, order), np.eye(54)])
    P = np.block([[belief.cov, np.zeros((18, 54))], [np.zeros((54, 18)), D]])
    H, R = selection(obs.rows, 54) @ both, np.diag(obs.cov)
    residual, S = z - belief.mean[obs.rows], H @ P @ H.T + R
    change, after = kalman_update(np.zeros(72), P, H, R, residual)
    rounding = 1e-10  # condition of S below 1e4
    np.testing.assert_allclose(found.mean - belief.mean, both @ change, atol=rounding)
    np.testing.assert_allclose(learnt.cov, S, atol=rounding)
    assert learnt.nis == pytest.approx(residual @ np.linalg.solve(S, residual), rel=1e-9)
    np.testing.assert_allclose(found.cov, after[:18, :18], atol=rounding)
    each = after[18:, 18:].reshape(order, nodes, 3, order, nodes, 3)
    for node in range(nodes):
        axes = [each[:, node, axis, :, node, axis] for axis in range(3)]
        np.testing.assert_allclose(found.local[node], np.mean(axes, axis=0), atol=rounding)
    np.testing.assert_allclose(whole(belief), both @ P @ both.T, atol=rounding)


def test_motion_within_the_modes_is_followed_exactly():
    """Nodes coupled so that the modes decouple, all uncertainty in them: the textbook's filter."""
    rng, nodes = np.random.default_rng(5), 6
    vectors = np.linalg.qr(rng.normal(size=(nodes, nodes)))[0]
    stiffness = np.kron(vectors * np.linspace(1, 9, nodes) @ vectors.T, np.eye(3))
    zero, one = np.zeros((18, 18)), np.eye(18)
    model = Linear(np.block([[zero, one], [-stiffness, -0.3 * one]]))
    modes = Modes(vectors[:, [1, 4]])
    reduced = ReducedRank(ImplicitEuler(), modes)
    root, x, q = rng.normal(size=(12, 24)), rng.normal(size=36), np.zeros(36)
    begun = reduced.start(Gaussian(x, np.eye(36)), model, NO_INPUT, q)
    belief = replace(begun, cov=root @ root.T, local=np.zeros((nodes, 2, 2)))
    B = lifted(modes.shapes, 2)
    P = B @ belief.cov @ B.T
    F = ImplicitEuler().step_jac(model, x, NO_INPUT, 0.05)[1]
    for _ in range(40):
        obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(nodes) < 0.4), 0.1)
        z = rng.normal(size=len(obs.rows))
        x, P = kalman_predict(x, P, F, np.zeros_like(P))
        x, P = kalman_update(x, P, selection(obs.rows, 36), np.diag(obs.cov), z)
        belief = reduced.predict(belief, model, NO_INPUT, q, 0.05)
        belief, _ = reduced.update(belief, obs, z)
        np.testing.assert_allclose(belief.mean, x, atol=1e-9)  # the house bound
        np.testing.assert_allclose(whole(belief), P, atol=1e-9)  # the same


def test_nis_lies_in_its_chi_square_band_where_the_covariance_is_exact():
    """One update each of 400 states drawn from B C B' + D; 99.8 % band."""
    rng, nodes = np.random.default_rng(6), 6
    modes, spread = random_modes(rng, nodes, 2), 0.05
    belief = ModalBelief(
        np.zeros(36), 0.3 * np.eye(12), np.tile(spread * np.eye(2), (nodes, 1, 1)), modes, None
    )
    reduced, B = ReducedRank(ImplicitEuler(), modes), lifted(modes.shapes, 2)
    total, degrees = 0.0, 0
    for _ in range(400):
        truth = B @ rng.normal(0, 0.3**0.5, 12) + rng.normal(0, spread**0.5, 36)
        obs = VisiblePositions.of_nodes(np.flatnonzero(rng.random(nodes) < 0.7), 0.1)
        z = truth[obs.rows] + rng.normal(0, 0.1, len(obs.rows))
        total, degrees = total + reduced.update(belief, obs, z)[1].nis, degrees + len(z)
    low, high = chi2.ppf([0.001, 0.999], degrees)
    assert low < total < high


def test_the_start_shares_the_variance_out(surface):
    model, u, q, prior = surface
    modes = Modes.smoothest(model.model, 3)
    belief = ReducedRank(ImplicitEuler(), modes).start(prior, model, u, q)
    B = lifted(modes.shapes, 4)
    np.testing.assert_allclose(belief.cov, B.T @ prior.cov @ B, atol=1e-15)  # rounding
    # where all coordinates of a kind are known equally well, every one keeps its variance
    even = np.repeat([1e-4, 0.25, 0.01, 0.4], 30)
    belief = ReducedRank(ImplicitEuler(), modes).start(
        Gaussian(prior.mean, np.diag(even)), model, u, q
    )
    np.testing.assert_allclose(np.diag(whole(belief)), even, rtol=1e-13)  # rounding


# --- the modes


def test_the_modes_of_a_chain_between_two_hands_are_sines():
    nodes = 9
    pairs = np.column_stack([np.arange(nodes - 1), np.arange(1, nodes)])
    mesh = MassSpring(Springs(pairs, 30.0, 0.1, 0.2), np.full(nodes, 0.01), (0, nodes - 1))
    shapes = Modes.smoothest(mesh, 3).shapes
    place = np.arange(1, nodes - 1) / (nodes - 1)
    for k in range(3):
        sine = np.sin((k + 1) * np.pi * place)
        along = shapes[:, k] @ sine / np.linalg.norm(sine)
        assert abs(along) == pytest.approx(1.0, abs=1e-12)  # rounding; the sign is free


def test_the_modes_span_the_lowest_of_springs_and_masses():
    mesh, _, _ = random_surface(np.random.default_rng(7), 4, 3, (0, 2))
    laplacian = np.zeros((12, 12))
    for (i, j), k in zip(mesh.springs.pairs, mesh.springs.stiffness, strict=True):
        laplacian[[i, j], [i, j]] += k
        laplacian[[i, j], [j, i]] -= k
    cut = np.ix_(mesh.free, mesh.free)
    expected = eigh(laplacian[cut], np.diag(mesh.mass)[cut])[1][:, :4]
    shapes = Modes.smoothest(mesh, 4).shapes
    np.testing.assert_allclose(shapes.T @ shapes, np.eye(4), atol=1e-14)  # rounding
    rest = expected - shapes @ (shapes.T @ expected)
    np.testing.assert_allclose(rest / np.linalg.norm(expected), 0, atol=1e-12)  # rounding


def test_lifting_and_restricting_are_products_with_b():
    rng = np.random.default_rng(8)
    modes = random_modes(rng, 5, 2)
    B, a, x = lifted(modes.shapes, 3), rng.normal(size=(18, 4)), rng.normal(size=(45, 4))
    variance = rng.uniform(size=45)
    np.testing.assert_allclose(modes.lift(a), B @ a, atol=1e-15)  # rounding
    np.testing.assert_allclose(modes.lift(a[:, 0]), B @ a[:, 0], atol=1e-15)  # rounding
    np.testing.assert_allclose(modes.restrict(x), B.T @ x, atol=1e-14)  # rounding
    expected = B.T @ np.diag(variance) @ B
    np.testing.assert_allclose(modes.covariance(variance), expected, atol=1e-15)  # rounding
    np.testing.assert_allclose(modes.unresolved, 1 - np.diag(B @ B.T)[:15:3], atol=1e-15)


# --- on the recording


def test_markers_hidden_for_a_while_are_led_by_their_neighbours():
    """The towel with each marker hidden for 0.3 s time and again; errors 0.1 s ahead [m]."""
    config = load(ROOT / 'config' / 'towel_coarse.yaml')
    markers = read_recording(ROOT / 'bags' / 'towel_fan').markers
    rng = np.random.default_rng(9)
    errors = {}
    phase = rng.integers(0, 100, 20)
    for kind in ('fixed_gain', 'reduced_rank'):
        tracker = Tracker(replace(config, filter=replace(config.filter, kind=kind)))
        squared = []
        for k in range(400):
            hidden = ((k + phase) % 100 < 30) & (np.arange(20) > 3) & (k > 0)
            visible = markers.visible[k] & ~hidden
            tracker.step(int(markers.stamps[k]), markers.positions[k], visible)
            if k >= 100 and not k % 4:  # settled
                later = markers.positions[k + 10][markers.visible[k + 10]]
                off = tracker.predict(0.1).position[markers.visible[k + 10]] - later
                squared.extend((off**2).sum(axis=1))
        errors[kind] = np.sqrt(np.mean(squared))
    # a node's own covariance tells it nothing of the others; measured over 11 s: 0.76
    assert errors['reduced_rank'] < 0.9 * errors['fixed_gain']
