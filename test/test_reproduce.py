"""The experiments of the thesis: each piece against a closed form, and the table that is made."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from references import even_surface

from cloth_predict.cli import main
from cloth_predict.config import load
from cloth_predict.errors import ConfigError
from cloth_predict.experiments import gomes2016, works
from cloth_predict.experiments.gomes2016 import (
    between,
    compressed,
    dropped,
    grids,
    integration,
    shaken,
    stiff,
    towel,
)
from cloth_predict.experiments.gomes2016.frames import Frames, Track, held
from cloth_predict.experiments.gomes2016.recursion import (
    EulerStep,
    by_the_letter,
    followed,
    tracked,
)
from cloth_predict.experiments.gomes2016.simulated import config, for_noise
from cloth_predict.experiments.rows import Experiment, Row, Scope, short
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.integrators.runge_kutta import EULER, RungeKutta
from cloth_predict.share import find

REQUIRED = (
    [f'3.{n}' for n in range(5, 9)]
    + [f'5.{n}' for n in range(3, 12)]
    + [f'6.{n}' for n in (1, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 14, 15, 16, 17, 19, 20, 21)]
)


# --- the table --------------------------------------------------------------------------------


def test_every_figure_with_a_number_has_an_experiment():
    covered = {figure for experiment in gomes2016.EXPERIMENTS for figure in experiment.figures}
    assert covered == set(REQUIRED)


@pytest.mark.parametrize(
    ('only', 'names'),
    [
        (['6.6'], ['6.5-6.7']),
        (['6.15'], ['6.14-6.15', '6.14-6.15 rope']),
        (['6.14-6.15 rope'], ['6.14-6.15 rope']),
        (['3', '5.11'], ['3.5-3.8', '5.11']),
        ([], [experiment.name for experiment in gomes2016.EXPERIMENTS]),
    ],
)
def test_only_takes_figures_chapters_and_names(only, names):
    assert [experiment.name for experiment in works.chosen('gomes2016', only)] == names


def test_a_figure_that_is_not_there_is_named():
    with pytest.raises(
        ConfigError, match=r'--only 6\.13: no such figure in gomes2016; there are 3\.5-3\.8'
    ):
        works.chosen('gomes2016', ['6.6', '6.13'])


def test_ctrl_c_keeps_the_rows_that_are_done(tmp_path, monkeypatch, capsys):
    def stop(scope):
        raise KeyboardInterrupt

    def row(scope):
        scope.progress(1.0)
        return Row('1.1', 'a | b', 'c', 'd', 'e', {'lost': math.inf, 'kept': 1.5}, ('x.png',))

    found = Experiment(('1.1',), 'a', row), Experiment(('1.2',), 'b', stop)
    monkeypatch.setitem(works.WORKS, 'gomes2016', found)
    assert main(['reproduce', 'gomes2016', '-o', str(tmp_path / 'out')]) == 130
    assert capsys.readouterr() == ('', '')
    (kept,) = json.loads((tmp_path / 'out/table.json').read_text())
    assert kept['numbers'] == {'lost': None, 'kept': 1.5}
    lines = (tmp_path / 'out/table.md').read_text().splitlines()
    assert lines[2] == r'| 1.1 | a \| b | c | d | e |'
    assert lines[4] == '![Figures 1.1](x.png)'


def test_progress_adds_up_to_one(tmp_path, monkeypatch):
    def row(scope):
        for _ in range(4):
            scope.progress(0.25)
        return Row('1', 'a', 'b', 'c', 'd')

    both = Experiment(('1',), 'a', row), Experiment(('2',), 'b', row)
    monkeypatch.setitem(works.WORKS, 'gomes2016', both)
    shares = []
    works.reproduce('gomes2016', Scope(tmp_path), (), lambda name, share: shares.append(share))
    assert sum(shares) == pytest.approx(1.0, abs=1e-12)  # rounding


def test_without_the_real_recording_its_row_says_so(tmp_path, capsys):
    name = ['--only', '6.14-6.15 rope', '--quick', '--json']
    assert (
        main(['reproduce', 'gomes2016', *name, '-o', str(tmp_path), '--data', str(tmp_path)]) == 0
    )
    (row,) = json.loads(capsys.readouterr().out)
    assert row['skipped']
    assert row['why'] == 'skipped: needs --data, a folder with rope/rope_take4.csv'


def test_a_folder_of_data_that_is_not_there_is_named(tmp_path, capsys):
    gone = tmp_path / 'gone'
    arguments = ['reproduce', 'gomes2016', '-o', str(tmp_path / 'out'), '--data', str(gone)]
    assert main(arguments) == 1
    assert capsys.readouterr().err == f'cloth-predict: --data {gone}: no such folder\n'


def test_figures_6_1_to_6_3_from_end_to_end(tmp_path, capsys):
    arguments = ['reproduce', 'gomes2016', '--only', '6.2', '--quick', '-o', str(tmp_path)]
    assert main(arguments) == 0
    (row,) = json.loads((tmp_path / 'table.json').read_text())
    numbers = row['numbers']
    # orders of magnitude: what is lost depends on rounding, and on the library that rounds
    assert numbers['recipe: peak MSE [m^2]'] > 1e6
    assert 1e-3 < numbers['recipe, 0.01 s: peak MSE [m^2]'] < 10
    # golden, to the digits that are printed: exact data, and no filter that is lost
    assert numbers['I + Ts J, 0.01 s: peak MSE [m^2]'] == pytest.approx(7.8e-4, rel=0.01)
    # 0.1 s ahead of a sheet shaken by 0.032 m/s at each 1 ms: sqrt(0.1 / 0.001) 3.2e-5 m = 0.3 mm
    assert numbers['ours: peak MSE [m^2]'] == pytest.approx(1.1e-7, rel=0.5)
    assert {'figure_6.1.png', 'figure_6.2.png'} == {p.name for p in tmp_path.glob('*.png')}
    assert capsys.readouterr().out.startswith('| figure | paper says |')


@pytest.mark.parametrize(
    ('value', 'said'),
    [(0.0456, '0.046 m'), (5.46e13, '5.5e+13 m'), (0.0, '0 m'), (math.nan, 'nothing finite')],
)
def test_numbers_in_words(value, said):
    assert short(value, 'm') == said


# --- chapter 3 --------------------------------------------------------------------------------


def test_the_printed_step_is_that_of_the_project_where_all_springs_are_taut():
    mesh, flat = even_surface(3, 3, (0, 1, 2), stiffness=300.0)
    wide = 1.1 * flat
    rng = np.random.default_rng(1)
    x = np.concatenate([wide[mesh.free].ravel(), rng.normal(0, 0.3, 18)])
    u = mesh.input(wide[mesh.driven], np.zeros((3, 3)))
    found = integration.implicit_step(mesh, x, u, 0.01)
    expected = ImplicitEuler().step(mesh, x, u, 0.01)
    np.testing.assert_allclose(found, expected, atol=1e-12)  # rounding


def test_the_printed_step_solves_its_own_equation_where_springs_are_short():
    mesh, flat = even_surface(3, 3, (0, 1, 2), stiffness=30.0)
    x = np.concatenate([0.8 * flat[mesh.free].ravel(), np.full(18, 0.1)])
    u = mesh.input(flat[mesh.driven], np.zeros((3, 3)))
    moved = integration.implicit_step(mesh, x, u, 0.01) - x
    # (I - dt J) dx = dt f, of which (3.32) is the part of the velocities
    left = moved - 0.01 * (mesh.jac(x, u) @ moved)
    np.testing.assert_allclose(left, 0.01 * mesh.f(x, u), atol=1e-13)  # rounding


def test_the_mean_distance_counts_what_is_held():
    a, b = np.zeros((2, 6)), np.zeros((3, 6))
    b[1] = [3.0, 4.0, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(integration.apart(a, b, 3), [0.0, 2.0])


# --- what shakes the sheet --------------------------------------------------------------------


def test_the_viscous_force_on_a_level_sheet():
    cloth, nodes = shaken.small_sheet()
    x, u = shaken.at_rest(cloth, nodes)
    x[60:] = np.tile([0.3, -0.2, 0.1], 20)
    found = shaken.Blown(cloth, np.array([5.0, 2.0, 7.0])).f(x, u) - cloth.f(x, u)
    # (6.14) with n = (0, +-1, 0): k_vis (2 - -0.2) upwards on 0.441 kg
    np.testing.assert_allclose(found[:60], 0.0)
    expected = np.tile([0.0, 2.2 / 0.441, 0.0], 20)
    np.testing.assert_allclose(found[60:], expected, atol=1e-12)  # rounding


def test_the_edge_of_the_blown_sheet_falls_as_a_plate_in_a_viscous_medium():
    cloth, _ = shaken.small_sheet()
    time = 0.05
    velocity = shaken.viscous(1, time, 10.0)[-1][60:].reshape(20, 3)[-5:]
    terminal = 0.441 * 9.81
    expected = -terminal * (1.0 - math.exp(-time / 0.441))  # k_vis 1 N s/m
    # the row that is held has tilted only what is near to it; without the medium it is 5 % faster
    np.testing.assert_allclose(velocity[:, 1], expected, rtol=2e-3)
    assert cloth.mass[-1] == pytest.approx(0.441)


def test_noise_on_the_derivative_spreads_as_a_random_walk():
    _, nodes = shaken.small_sheet()
    still = shaken.noisy(0, 0.02)[1]  # a millisecond each: 10 steps, in which springs do little
    alone = integration.RungeKutta()
    cloth, _ = shaken.small_sheet()
    x, u = shaken.at_rest(cloth, nodes)
    for _ in range(10):
        x = alone.step(cloth, x, u, 1e-3)
    off = (still - x)[:60]
    # variance 10 (1 ms)^2 0.001 of each of 60: 3 sigma of chi^2 / 60 is 55 %
    assert np.mean(off**2) == pytest.approx(10 * 1e-6 * 1e-3, rel=0.55)


# --- the recursion ----------------------------------------------------------------------------


def second_recursion(cloth, nodes, positions, ts, alpha, beta):
    """Equations (6.1) to (6.11) once more, on all frames; errors of the free nodes."""
    n = 3 * len(cloth.free)
    u = cloth.input(nodes[cloth.driven])
    H = np.hstack([np.eye(n), np.zeros((n, n))])
    x, P, found = np.append(positions[0], np.zeros(n)), np.zeros((2 * n, 2 * n)), []
    for y in positions[1:]:
        J = cloth.jac(x, u).toarray()
        x, P = x + ts * cloth.f(x, u), J @ P @ J.T + alpha * np.eye(2 * n)
        found.append(x[:n] - y)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + beta * np.eye(n))
        x, P = x + K @ (y - H @ x), (np.eye(2 * n) - K @ H) @ P
    return np.array(found)


@pytest.fixture(scope='module')
def falling():
    """A sheet that falls for half a second: model, nodes, frames."""
    cloth, nodes = shaken.small_sheet()
    return cloth, nodes, Frames.of_states(cloth, nodes, shaken.noisy(0, 0.5), 0.01)


def test_by_the_letter_is_equations_6_1_to_6_11(falling):
    cloth, nodes, frames = falling
    found = by_the_letter(cloth, frames, 0.7, 0.3, 0.1)
    seen = frames.positions[::10, cloth.free].reshape(6, -1)
    expected = second_recursion(cloth, nodes, seen, 0.1, 0.7, 0.3)
    np.testing.assert_allclose(found.times, [0.1, 0.2, 0.3, 0.4, 0.5])
    # rounding, which P magnifies some hundred times in each step
    for step, within in enumerate((1e-14, 1e-13, 1e-11, 1e-9, 1e-6)):
        error = found.error[step, cloth.free].ravel()
        np.testing.assert_allclose(error, expected[step], atol=within)
    np.testing.assert_array_equal(found.error[:, cloth.driven], 0.0)


def test_only_the_ratio_of_q_and_r_matters(falling):
    cloth, _, frames = falling
    one, other = (by_the_letter(cloth, frames, 100 * s, s, 0.01).error for s in (1.0, 10.0))
    np.testing.assert_allclose(one, other, atol=1e-9)  # rounding


def test_an_euler_step_is_differentiated(falling):
    cloth, nodes, _ = falling
    x, u = shaken.noisy(0, 0.5)[-1], cloth.input(nodes[cloth.driven])
    found = EulerStep(cloth, 0.02).jac(x, u) @ np.eye(cloth.dim_x)
    _, expected = RungeKutta(EULER).step_jac(cloth, x, u, 0.02)
    np.testing.assert_allclose(found, expected, atol=1e-11)  # rounding of entries up to 100


def test_the_last_row_at_10_fps_is_the_prediction_of_the_recursion(falling):
    cloth, _, frames = falling
    dt = between.row_times(10.0, 5)[-1]
    assert dt == pytest.approx(0.1, rel=1e-15)  # rounding
    position, velocity = followed(cloth, frames, 0.7, 0.3, 0.1)[2]
    ahead = by_the_letter(cloth, frames, 0.7, 0.3, 0.1).error[2] + frames.actual[30]
    np.testing.assert_allclose((position + dt * velocity), ahead, atol=1e-12)  # rounding


def test_a_row_of_270_lines_is_drawn_later_by_what_the_thesis_says():
    # below (6.22): 270 / 25900 s
    assert between.row_times(24.0, 5)[1] == pytest.approx(0.0104, abs=5e-5)  # digits printed


def test_what_is_lost_is_nan_from_then_on():
    mesh, flat = even_surface(3, 3, (0, 1, 2), stiffness=1e6)
    positions = np.tile(flat, (400, 1, 1))
    positions[:, 8] += [0.3, 0.0, 0.2]
    track = by_the_letter(mesh, Frames.exact(positions, 0.01), 1.0, 1e3, 0.01, conditions=True)
    gone = round(track.lost / 0.01)
    assert np.isnan(track.error[gone:]).all()
    assert np.isfinite(track.error[: gone - 1]).all()
    assert track.peak > 1e3
    assert track.condition[0] > 1.0


def test_our_filter_predicts_a_sheet_that_is_not_shaken():
    cloth, nodes = shaken.small_sheet()
    x, u = shaken.at_rest(cloth, nodes)
    states = [x]
    for _ in range(60):
        for _ in range(10):
            x = RungeKutta().step(cloth, x, u, 1e-3)
        states.append(x)
    frames = Frames.of_states(cloth, nodes, np.array(states), 0.01)
    # RK4 at 10 ms, a mode of 74 rad/s, 10 steps: 10 (0.74)^5 / 120 of its some cm
    assert tracked(for_noise(), frames).farthest < 5e-4
    # the implicit step is of first order
    assert 1e-3 < tracked(config(), frames).farthest < 0.1


# --- frames and errors ------------------------------------------------------------------------


def test_errors_are_means_of_coordinates_and_distances_of_nodes():
    error = np.zeros((2, 2, 3))
    error[1, 0] = [0.3, 0.0, 0.4]
    track = Track(np.array([0.5, 1.5]), error, np.full(2, np.nan))
    np.testing.assert_allclose(track.mse, [0.0, 0.25 / 6])
    np.testing.assert_allclose(track.distance, [[0.0, 0.0], [0.5, 0.0]])
    assert (track.peak, track.farthest) == pytest.approx((0.25 / 6, 0.5))
    assert track.rms == pytest.approx(0.25)
    assert track.after(1.0).rms == pytest.approx(0.5 / math.sqrt(2))
    assert track.around(1.5, width=1.0) == pytest.approx(0.25 / 6)


def test_gaps_are_closed_by_straight_lines():
    line = np.arange(5.0)[:, None, None] * np.array([1.0, -2.0, 0.5])
    visible = np.array([True, False, False, True, True])[:, None]
    frames = Frames(0.1, np.where(visible[..., None], line, np.nan), visible, line)
    np.testing.assert_allclose(frames.filled().positions, line, atol=1e-15)  # rounding
    # what moves by a vector per frame is off by it, held for a frame
    np.testing.assert_allclose(held(frames, 0.1).distance, math.sqrt(5.25))


# --- grids of settings, and compression --------------------------------------------------------


def test_the_best_settings_are_those_of_the_least_finite_value():
    tracks = {
        (1.0, beta): Track(np.ones(1), np.full((1, 1, 3), error), np.ones(1))
        for beta, error in ((1.0, math.nan), (2.0, 0.3), (3.0, 0.2), (4.0, 0.4))
    }
    assert grids.best(tracks, lambda track: track.peak) == (1.0, 3.0)
    assert grids.best(dict(list(tracks.items())[:1]), lambda track: track.peak) == (1.0, 1.0)


def test_a_second_scenario_makes_the_rows_of_compression(tmp_path, monkeypatch):
    monkeypatch.setattr(compressed, 'QUICK', compressed.Effort(0.3, 20, 12))
    compressed.searched.cache_clear()
    rows = [experiment.run(Scope(tmp_path, quick=True)) for experiment in compressed.EXPERIMENTS]
    compressed.searched.cache_clear()
    first, loaded, two = (row.numbers for row in rows)
    one = compressed.searched.__wrapped__(compressed.PLAIN, True)['ours']
    # the cost of the search is that of the motion, and it fell
    assert one.after['falling'].cost == pytest.approx(one.result.cost, rel=1e-9)
    left = first['ours, 5 x 5: falling, share of the cost left']
    assert left == pytest.approx(one.result.cost / one.result.trace[0][1], rel=1e-6)
    assert left < 0.8
    large = compressed.searched.__wrapped__(replace(compressed.PLAIN, target=(11, 11)), True)[
        'ours'
    ]
    assert first['ours: error of 5 x 5 by that of 11 x 11'] == pytest.approx(
        one.after['falling'].error.mean() / large.after['falling'].error.mean()
    )
    error = one.after['falling'].error
    assert first['ours, 5 x 5: falling, RMS distance [m]'] == pytest.approx(error.mean() ** 0.5)
    assert loaded['ours, 5 x 5, G_i: falling, share of the cost left'] < 0.8
    assert two['ours, two: raised, share of the cost left'] < 1.0
    pictures = {picture for row in rows for picture in row.pictures}
    assert pictures == {path.name for path in tmp_path.glob('*.png')}


def test_identified_springs_of_the_dropped_towel(monkeypatch):
    _, settings = towel.fan()
    markers = dropped.dropped(0.3)
    config, found = dropped.identify(
        settings, markers, dropped.descend, 60, lambda evaluations, best: None
    )
    assert found.cost < 0.2 * found.trace[0][1]
    model = config.model
    assert (len(model.springs), len(model.dampers), len(model.masses)) == (77, 77, 20)
    # (6.21) once more: of the open loop with these springs, weighed by exp(0.001 i dT)
    cost = dropped.objective(config, markers)
    off = replace(cost, alpha=0.0).residuals(0, cost.space.start).reshape(31, -1)
    weight = np.exp(1e-3 * 0.01 * np.arange(31))
    assert weight @ np.square(off).sum(axis=1) == pytest.approx(found.cost, rel=1e-7)


# --- stiffness and the dropped towel ----------------------------------------------------------


def test_springs_by_the_thesis_have_the_sum_over_their_triangles():
    settings = load(find('config/towel.yaml'))
    mesh = towel.recipe_model(settings, towel.frames_of(towel.fan()[0]))
    found = stiff.lloyd(settings, mesh, 7e9)
    each = 2 * math.sqrt(2) / 25 * 7e9  # of one triangle, by length
    by_pair = {tuple(pair): k for pair, k in zip(mesh.springs.pairs.tolist(), found, strict=True)}
    assert by_pair[0, 1] == pytest.approx(each * 0.17)  # at the border
    assert by_pair[5, 6] == pytest.approx(2 * each * 0.17)  # inside
    assert by_pair[5, 9] == pytest.approx(2 * each * 0.20)
    assert mesh.mass.sum() == pytest.approx(0.34)
    assert len(found) == 77  # Gomes 2016, section 6.4 by (5.5)


def test_the_towel_is_dropped_at_its_angle_with_springs_at_rest():
    markers = dropped.dropped(0.1)
    assert markers.shape == (11, 20, 3)
    first = markers[0].reshape(5, 4, 3)
    steps = first[1:] - first[:-1]
    length = np.linalg.norm(steps, axis=2)
    np.testing.assert_allclose(length, 0.2, atol=1e-12)  # rounding
    np.testing.assert_allclose(steps[..., 2] / length, math.sin(dropped.ANGLE), atol=1e-12)
    np.testing.assert_array_equal(markers[:, :4], markers[:1, :4].repeat(11, axis=0))
    # without bending stiffness the sheet falls across itself freely, but for what the bar pulls
    fallen = 9.81 * math.sin(dropped.ANGLE) * 0.1**2 / 2
    moved = np.linalg.norm(markers[-1, 16:] - markers[0, 16:], axis=1)
    np.testing.assert_allclose(moved, fallen, rtol=1e-3)  # RK4, and the turn
