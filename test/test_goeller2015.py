"""The experiments on a sliding bar: what can be known, each piece, and rows from end to end."""

import json

import numpy as np
import pytest
from references import Linear, central_differences

from cloth_predict.cli import main
from cloth_predict.experiments.goeller2015 import EXPERIMENTS, friction, robustness, stiffness
from cloth_predict.experiments.goeller2015.recipe import by_the_paper
from cloth_predict.experiments.goeller2015.runs import (
    CONFIG,
    KNOWN,
    Bound,
    Filmed,
    Run,
    followed,
)
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.identification.observability import bounds, sensitivities
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.models.ruler import Ruler
from cloth_predict.observations import LinearObservation
from cloth_predict.simulation.ruler import ANNEX_A
from cloth_predict.tracking.ruler_assembly import first_belief, joint_model
from cloth_predict.tracking.stopping import Stop
from cloth_predict.types import Gaussian

NO_INPUT = np.zeros(0)


# --- what can be known


def test_sensitivities_are_the_derivatives_of_what_is_simulated():
    at, times = np.array([0.5, 2.0]), np.linspace(0, 1, 4)

    def simulate(unknowns):
        phase = unknowns[:, 1, None] * times
        return unknowns[:, :1, None] * np.stack([np.sin(phase), np.cos(phase)], axis=-1)

    found = sensitivities(simulate, at)
    phase = 2.0 * times
    by_first = np.stack([np.sin(phase), np.cos(phase)], axis=-1)
    by_second = 0.5 * times[:, None] * np.stack([np.cos(phase), -np.sin(phase)], axis=-1)
    np.testing.assert_allclose(found, np.stack([by_first, by_second], -1), atol=1e-9)


def test_bounds_are_the_covariance_of_a_kalman_filter_on_a_linear_motion():
    rng = np.random.default_rng(1)
    model, dt = Linear(rng.normal(size=(3, 3))), 0.1
    H, sigma, prior = rng.normal(size=(2, 3)), np.array([0.1, 0.2]), np.array([1.0, 2.0, 3.0])
    kalman = ExtendedKalmanFilter(INTEGRATORS['rk4'])
    obs = LinearObservation(H, np.zeros(2), sigma**2)
    belief, F, slopes = Gaussian(np.zeros(3), np.diag(prior**2)), np.eye(3), []
    step = INTEGRATORS['rk4'].step_jac(model, np.zeros(3), NO_INPUT, dt)[1]
    expected = []
    for frame in range(6):
        if frame:
            belief = kalman.predict(belief, model, NO_INPUT, np.zeros(3), dt)
            F = step @ F
        belief, _ = kalman.update(belief, obs, np.zeros(2))
        slopes.append(H @ F)
        back = np.linalg.inv(F)
        expected.append(back @ belief.cov @ back.T)
    np.testing.assert_allclose(bounds(np.array(slopes), sigma, prior), expected, rtol=1e-9)


def test_a_bar_that_hardly_spins_tells_of_its_contacts_by_their_product():
    spin, speed, mu, g = 1e-4, 2.0, 0.3, 9.81
    for behind, before in ((0.4, 0.4), (0.32, 0.5), (0.2, 0.35)):
        x = np.array([0.0, 0.0, 0.3, speed, 0.0, spin])
        slowing = Ruler(1.0, behind, before, mu, g).f(x, NO_INPUT)[5]
        expected = -12 * mu * g * behind * before * spin * np.cos(0.3) ** 2 / speed
        assert slowing == pytest.approx(expected, rel=1e-3)  # of the next order in the spin


def test_scenario_5_does_not_tell_which_contact_is_farther():
    bound = Bound.of(Filmed.of(ANNEX_A[5], 2.0))
    end = bound.sigma[-1, KNOWN[:2]]
    assert (end > 0.2 * 0.4).all()
    assert bound.middle[-1] < 0.15 * end.min()
    assert bound.sigma[-1, KNOWN[2]] < 0.001 * 0.3


def test_the_bound_of_a_stop_is_what_the_spread_of_estimates_comes_to():
    film = Filmed.of(ANNEX_A[4])
    frame = 100
    runs = [followed(film, seed, stops=[frame]) for seed in range(8)]
    place, angle = np.array([run.stop_errors(frame) for run in runs]).T
    bound = Bound.of(film)
    # chi-square of 8 runs: a factor 2 is beyond 4 sigma; the filter itself is not the best one
    assert 0.4 < np.sqrt(np.mean(place**2)) / bound.place[frame] < 2.0
    assert 0.4 < np.sqrt(np.mean(angle**2)) / bound.angle[frame] < 2.0


# --- runs


def test_a_start_is_off_by_no_more_than_its_share_and_the_sigmas_do_not_tell():
    film = Filmed.of(ANNEX_A[3], 0.1)
    model = joint_model(CONFIG)
    starts = [film.start(np.random.default_rng(k), 0.2, CONFIG) for k in range(100)]
    off = np.array([start.mean for start in starts]) - film.joint
    most = np.array([0.2, 0.2, 0.2, 0.2, 0.6, 0.2, 2.0])
    assert (np.abs(off[:, :7]) <= most).all()
    assert (np.abs(off[:, :7]).max(axis=0) > 0.9 * most).all()
    np.testing.assert_allclose(
        off[:, 7:] + film.joint[7:], np.tile([0.25, 0.25, 0.05], (100, 1)), atol=1e-15
    )
    for start in starts:
        np.testing.assert_array_equal(start.cov, first_belief(CONFIG, model, np.zeros(4)).cov)


def test_errors_of_a_run_are_those_of_its_means_and_stops():
    film = Filmed.of(ANNEX_A[4], 0.1)
    mean = np.tile(film.joint, (len(film.times), 1))
    mean[:, list(KNOWN)] += [0.01, -0.02, 0.03]
    stop = Stop(1.0, 0.1, film.rest + np.array([0.03, 0.04, -0.5]), np.eye(3))
    run = Run(film, mean, np.ones_like(mean), {0: stop, 1: None})
    np.testing.assert_allclose(run.parameter_errors[0], [0.01, -0.02, 0.1], rtol=1e-12)  # rounding
    assert run.stop_errors(0) == pytest.approx((0.05, 0.5))
    assert run.stop_errors(1) == (np.inf, np.inf)


def test_a_run_has_converged_where_it_is_right_and_knows_it():
    film = Filmed.of(ANNEX_A[4], 0.1)
    mean = np.tile(film.joint, (len(film.times), 1))
    sigma = np.full_like(mean, 0.01)
    assert robustness.converged(Run(film, mean, sigma, {}))
    for entry, off in ((KNOWN[0], 0.05), (KNOWN[1], -0.05), (KNOWN[2], 0.02 * 0.31)):
        wrong = mean.copy()
        wrong[-1, entry] += off
        assert not robustness.converged(Run(film, wrong, sigma, {}))


def test_the_recipe_goes_on_where_ours_has_converged():
    film = Filmed.of(ANNEX_A[4], 2.0)
    ours, recipe = followed(film, 0), by_the_paper(film, 0)
    assert abs(ours.parameter_errors[-1, 2]) < 0.02 < abs(recipe.parameter_errors[-1, 2])


def test_friction_that_is_rounded_off_is_that_of_the_bar_where_it_is_fast():
    bar, rng = Ruler(1.0, 0.2, 0.3, 0.4), np.random.default_rng(2)
    x = rng.normal(0, [1, 1, 1, 2, 2, 2], (20, 6))
    for eps in (1e-3, 1e-4):
        rounded = friction.Rounded.like(bar, eps)
        ratio = np.abs(rounded.friction(x)) / np.abs(bar.friction(x))
        slip = bar.slip(x)
        np.testing.assert_allclose(ratio, slip / np.hypot(slip, eps), rtol=1e-12)  # rounding
    # and as little as RK4 is stable with: the fastest motion at rest decays within its 2.78 / dt
    stable = friction.Rounded.stable(bar, 0.01)
    slopes = central_differences(lambda x: stable.f(x, NO_INPUT), np.zeros(6), 1e-7)
    fastest = np.abs(np.linalg.eigvals(slopes)).max()
    assert 0.4 * 278 < fastest < 278


def test_the_towel_of_the_experiment_has_the_stiffness_that_it_is_given():
    mesh, level = stiffness.towel()
    model = stiffness.unknown(mesh)
    rng = np.random.default_rng(3)
    own = np.append(level[mesh.free].ravel(), rng.normal(size=mesh.dim_x // 2))
    u = mesh.input(level[mesh.driven])
    true = np.array(list(stiffness.TRUE.values()))
    slope = model.f(model.joint(own, true), u)
    np.testing.assert_array_equal(slope[model.own], mesh.f(own, u))
    np.testing.assert_array_equal(model.first, 0.5 * true)


# --- rows


def test_the_sections_with_a_number_are_there():
    names = [experiment.name for experiment in EXPERIMENTS]
    assert names == ['B', 'C', 'D', 'E', '2.1', '4.5', '3.3', '4.6 50 % off', '4.6 random']


def test_rows_from_end_to_end(tmp_path, capsys):
    only = ['--only', 'B', '2.1', '4.6 random']
    assert main(['reproduce', 'goeller2015', '--quick', *only, '-o', str(tmp_path)]) == 0
    annex, step, random = (r['numbers'] for r in json.loads((tmp_path / 'table.json').read_text()))
    assert annex['ours: worst error of mu at the end'] < 0.02
    assert annex['ours: worst error of mu at the end'] < 5 * annex['bound: sigma of mu at the end']
    assert 0.3 < annex['share of the video in which L1 is observed'] < 0.7
    assert annex['ours: RMS error of L1 at the end [m]'] < 0.01
    assert step['closed form: speed that is left [m/s]'] == 0.0
    assert step['closed form: worst place of rest [m]'] < 1e-3
    assert step['as printed: speed that is left [m/s]'] > 1e-3
    assert random['share that converges'] >= 0.95
    assert (tmp_path / 'scenario_3.png').stat().st_size > 10_000
    assert capsys.readouterr().out.startswith('| figure | paper says |')
