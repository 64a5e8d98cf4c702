"""A coarse sheet that is to move as a dense one: the set-up, the search, the file, the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from interrupting import interrupted
from references import number_of_springs

from cloth_predict.cli import main
from cloth_predict.config import load
from cloth_predict.errors import ConfigError
from cloth_predict.evaluation.cases import case_of
from cloth_predict.evaluation.predictors import Tracked
from cloth_predict.evaluation.runs import follow as predicted
from cloth_predict.formats.bag import Recording
from cloth_predict.identification.compression import modal
from cloth_predict.identification.compression.falling import (
    HANGING,
    RELEASES,
    motion,
    released,
    sheet,
)
from cloth_predict.identification.compression.report import file
from cloth_predict.identification.compression.search import (
    bounds,
    follow,
    judged,
    searched,
    weighed,
)
from cloth_predict.identification.compression.task import THESIS, Task
from cloth_predict.identification.optimisers.family import Method
from cloth_predict.identification.optimisers.result import DivergedError
from cloth_predict.types import MarkerSequence

SMALL = Task((9, 9), (3, 3), ('falling',), ('lowered', 'raised'), duration=2.0)


def compress(task, budget=240, optimiser='gradient', seed=0, **more):
    return judged(searched(task, Method(optimiser, budget, seed), **more))


@pytest.fixture(scope='module')
def found():
    """A small sheet, compressed with 60 gradients."""
    return compress(SMALL)


# --- the dense sheet


def test_the_sheet_is_that_of_the_thesis():
    model = sheet(Task().dense)
    assert model.nodes == 441
    assert len(model.springs.pairs) == number_of_springs(21, 21)
    np.testing.assert_allclose(model.mass, 0.025, rtol=1e-14)  # rounding of 11.025 / 441
    assert set(model.springs.stiffness) == {300.0}
    assert set(model.springs.damping) == {0.08}
    side = model.springs.rest_length[:420]  # the structural ones along the rows come first
    np.testing.assert_allclose(side, 1.5 / 20, rtol=1e-12)  # rounding of differences


def test_it_falls_as_its_own_energy_allows():
    """Of gravity, springs and motion together; the dampers and the implicit step only take."""
    one = motion(SMALL.dense, 'falling', 2.0)
    model, step = sheet(SMALL.dense), one.times[1]
    length = np.linalg.norm(one.position[:, model.first] - one.position[:, model.second], axis=-1)
    springs = 0.5 * (model.springs.stiffness * (length - model.springs.rest_length) ** 2).sum(-1)
    height = 9.81 * (model.mass * one.position[..., 1]).sum(axis=1)
    velocity = np.diff(one.position, axis=0) / step  # the velocity after an implicit step
    moving = 0.5 * (model.mass[:, None] * velocity**2).sum(axis=(1, 2))
    total = springs[1:] + height[1:] + moving
    assert total[0] <= springs[0] + height[0]
    # a linearised step gains a little where springs turn in it: it errs by its length squared
    assert np.diff(total).max() < 1e-3 * moving.max()
    assert height[-1] < height[0] - 5.0  # J: it fell


@pytest.mark.parametrize('gravity', [(0.0, -9.81, 0.0), (0.0, 0.0, -9.81), (-9.81, 0.0, 0.0)])
def test_releases_lie_where_gravity_says(gravity):
    config = replace(SMALL.dense, model=replace(THESIS.model, rows=3, cols=3, gravity=gravity))
    down = np.array(gravity) / 9.81
    depth = {
        name: (released(config, release)[0] @ down).reshape(3, 3)[-1]
        for name, release in RELEASES.items()
    }
    for name, expected in (
        ('falling', 0.0), ('raised', -1.5 / np.sqrt(2)), ('lowered', 1.5 / np.sqrt(2)),
        ('pushed', 1.5),
    ):  # fmt: skip
        np.testing.assert_allclose(depth[name], expected, atol=1e-12)  # rounding
    position, velocity = released(config, RELEASES['pushed'])
    assert np.linalg.norm(velocity[7]) == pytest.approx(3.0)  # m/s, the last row's middle
    np.testing.assert_allclose(velocity[:3], 0.0, atol=1e-15)  # of the first row
    np.testing.assert_allclose(np.einsum('ni,ni->n', position, velocity), 0.0, atol=1e-12)


# --- which nodes and which parameters


def test_the_nodes_that_are_compared_are_every_fifth():
    chosen = Task().chosen
    assert len(chosen) == 25
    dense, coarse = released(Task().dense, HANGING)[0], released(Task().equal, HANGING)[0]
    np.testing.assert_allclose(dense[chosen], coarse, atol=1e-12)  # rounding


def test_rows_and_columns_may_differ():
    task = Task((9, 5), (3, 5))
    dense, coarse = released(task.dense, HANGING)[0], released(task.equal, HANGING)[0]
    np.testing.assert_allclose(dense[task.chosen], coarse, atol=1e-12)  # rounding


def test_all_is_searched_that_acts_on_a_free_node():
    springs = number_of_springs(5, 5) - 4 - 3  # but those within the row that is held
    assert len(Task().space()) == 2 * springs + 2 * 20
    assert len(Task(loads=False).space()) == 2 * springs + 20
    gradient = SMALL.objective(('falling',), 0.001).part_gradient(0, SMALL.space().start)[1]
    assert (np.abs(gradient) > 0).all()


def test_values_stay_positive_and_factors_of_gravity_near_one():
    space = Task().space()
    for vector in bounds(space):
        values = space.values(vector)
        assert (values > 0).all()
        loads = values[[p.field == 'loads' for p in space.parameters]]
        assert (loads >= 0.1 * (1 - 1e-12)).all()  # rounding of the logarithm
        assert (loads <= 10.0 * (1 + 1e-12)).all()


# --- costs


def test_a_sheet_that_is_not_made_coarser_follows_itself():
    same = replace(SMALL, target=(9, 9), held_out=('pushed',))  # which starts with a velocity
    for of in follow(same, same.equal).values():
        assert of.cost == 0.0
        assert of.rms == 0.0


def test_cost_and_error_are_those_of_the_definition():
    """Eq. 5.13, summed in loops."""
    dense = motion(SMALL.dense, 'falling', SMALL.duration)
    coarse = motion(SMALL.equal, 'falling', SMALL.duration)
    cost, errors = 0.0, []
    for time, z, x in zip(dense.times, coarse.position, dense.position, strict=True):
        squares = [float(np.sum((z[k] - x[SMALL.chosen[k]]) ** 2)) for k in range(9)]
        cost += np.exp(0.001 * time) * sum(squares)
        errors.append(sum(squares) / 6)  # over the free nodes
    of = follow(SMALL, SMALL.equal)['falling']
    assert of.cost == pytest.approx(cost, rel=1e-10)  # rounding, along 200 steps
    np.testing.assert_allclose(of.error, errors, atol=1e-12)  # the same
    assert of.rms == pytest.approx(np.sqrt(np.mean(errors)), rel=1e-10)


def test_only_ratios_of_masses_springs_and_dampers_are_seen(found):
    model = found.config.model
    assert sum(model.masses) == pytest.approx(model.mass, rel=1e-12)  # rounding
    tripled = replace(
        model,
        masses=tuple(3 * np.array(model.masses)),
        springs=tuple(3 * np.array(model.springs)),
        dampers=tuple(3 * np.array(model.dampers)),
    )
    heavier = replace(found.config, model=tripled)
    there = follow(SMALL, heavier)['falling']
    # rounding, along 200 steps
    assert there.cost == pytest.approx(found.after['falling'].cost, rel=1e-8)
    np.testing.assert_allclose(weighed(heavier).model.springs, model.springs, rtol=1e-12)


def test_a_sheet_that_diverges_has_no_cost():
    hard = replace(SMALL, duration=0.1, held_out=())
    config = replace(hard.equal, model=replace(hard.equal.model, gravity=(0.0, -1e300, 0.0)))
    of = follow(hard, config)['falling']
    assert np.isnan(of.cost)


# --- the search


def test_compression_lowers_the_cost_where_it_trained_and_where_it_did_not(found):
    # to 3 x 3 nodes; to 5 x 5 of 21 x 21 in ten seconds it is 0.3 % and 0.3 to 1 %
    assert found.share_left('falling') < 0.1
    assert found.share_left('lowered') < 0.25
    assert found.result.cost == pytest.approx(found.after['falling'].cost, rel=1e-8)  # rounding
    assert found.result.evaluations <= 240
    assert min(found.config.model.masses) > 0


@pytest.mark.parametrize('optimiser', ['cma', 'annealing'])
def test_searches_without_a_gradient_lower_it_too(optimiser):
    task = replace(SMALL, target=(2, 2), duration=0.5, held_out=(), loads=False)
    one = compress(task, 150, optimiser, seed=3)
    assert one.result.cost < 0.9 * one.before['falling'].cost
    assert one.result.evaluations <= 150
    again = compress(task, 150, optimiser, seed=3)
    np.testing.assert_array_equal(one.result.best, again.result.best)


def test_two_motions_in_the_cost_lower_that_of_the_second(found):
    """Gomes 2016, eq. 5.16 and figure 5.11."""
    both = compress(replace(SMALL, trained=('falling', 'raised'), held_out=('lowered',)))
    assert both.after['raised'].cost < found.after['raised'].cost
    parts = both.after['falling'].cost + both.after['raised'].cost
    assert both.result.cost == pytest.approx(parts, rel=1e-8)  # rounding


def test_ctrl_c_keeps_the_best_so_far():
    def stop(evaluations, best):
        if evaluations >= 20:
            raise KeyboardInterrupt

    kept = compress(replace(SMALL, held_out=()), callback=stop)
    assert kept.result.interrupted
    assert kept.after['falling'].cost < kept.before['falling'].cost


def test_a_dense_sheet_that_diverges_is_refused():
    wild = replace(THESIS, model=replace(THESIS.model, stiffness_structural=1e308))
    with pytest.raises(ConfigError, match='the dense sheet diverges in scenario falling'):
        compress(replace(SMALL, surface=wild, duration=0.1))


def test_a_search_without_a_valid_cost_says_so():
    far = replace(THESIS, model=replace(THESIS.model, gravity=(0.0, -1e300, 0.0)))
    with pytest.raises(DivergedError, match='no valid result: none of'):
        compress(replace(SMALL, surface=far, duration=0.1))


# --- the file


def test_the_parameter_file_runs_in_the_filter_and_predicts_better(found, tmp_path):
    path = tmp_path / 'coarse.yaml'
    path.write_text(file(found), encoding='utf-8')
    config = load(path)
    assert config == found.config
    one = motion(SMALL.dense, 'lowered', SMALL.duration)
    rng = np.random.default_rng(0)
    stamps = np.round(one.times * 1e9).astype(np.int64)
    exact = one.position[:, SMALL.chosen]
    seen = exact + rng.normal(0, 3e-4, exact.shape)
    labels = tuple(f'cloth:{k}' for k in range(9))
    markers = MarkerSequence(stamps, labels, seen, np.ones(seen.shape[:2], bool))
    rms = {}
    for name, one_config in (('equal', SMALL.equal), ('compressed', config)):
        case = case_of(Recording(markers), one_config, 'lowered')
        (run,) = predicted(Tracked(one_config), case, [0.2])
        ahead = run.position[50:-20] - exact[70:]  # 20 frames of 10 ms later
        rms[name] = np.sqrt(np.nanmean(np.square(ahead).sum(axis=-1)))
        assert np.isfinite(ahead).all()
    assert rms['compressed'] < rms['equal']


# --- beside modal reduction


@pytest.fixture(scope='module')
def beside(found):
    return modal.rivals(found)


def test_the_coarse_sheets_are_measured_as_the_search_does(found, beside):
    for kind, of in ((modal.EQUAL, found.before), (modal.COMPRESSED, found.after)):
        (one,) = (rival for rival in beside if rival.kind == kind)
        assert one.states == 36
        for name in SMALL.names:
            assert one.rms[name] == pytest.approx(of[name].rms, rel=1e-8)  # rounding


def test_more_shapes_of_a_motion_follow_it_the_closer(beside):
    errors = [rival.rms['falling'] for rival in beside if rival.kind == modal.MOTIONS]
    assert len(errors) == len(modal.COUNTS)
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 1e-3  # m; the motions of 72 free nodes hardly have more than 60 shapes


def test_equal_cost_means_no_more_than_the_compressed_sheet():
    def rival(kind, shapes, step):
        return modal.Rival(kind, shapes, 10, step, 2 * step, {})

    given = [
        rival(modal.COMPRESSED, None, 5e-5),
        rival('a', 10, 3e-5), rival('a', 20, 4e-5), rival('a', 60, 6e-5), rival('b', 10, 7e-5),
    ]  # fmt: skip
    assert modal.at_equal_cost(given, 'step') == {'a': given[2]}
    assert modal.at_equal_cost(given, 'cycle') == {'a': given[2]}


# --- the command, and bad input


def test_the_command_writes_a_file_and_a_report(tmp_path, capsys):
    output, report = tmp_path / 'out.yaml', tmp_path / 'report'
    options = ['--from', '5x5', '--to', '3x3', '--duration', '0.3', '--budget', '40']
    options += ['--scenarios', 'falling', '--held-out', 'lowered', '-o', str(output), '--json']
    assert main(['compress', *options, '--report', str(report)]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers['scenarios']['falling']['trained']
    assert not numbers['scenarios']['lowered']['trained']
    assert numbers['evaluations'] <= 40
    assert numbers['trace'][-1][1] < numbers['trace'][0][1]
    assert load(output).model.rows == 3
    names = {path.name for path in report.iterdir()}
    pictures = {'errors.png', 'costs.png', 'parameters.png', 'rivals.png'}
    assert names == pictures | {'compression.txt', 'compression.json'}
    assert 'EKF cycle costs no more' in (report / 'compression.txt').read_text(encoding='utf-8')


def options(tmp_path, *more):
    usual = ['--from', '5x5', '--to', '3x3', '--duration', '0.3', '--scenarios', 'falling']
    return ['compress', *usual, '-o', str(tmp_path / 'out.yaml'), '--json', *map(str, more)]


def test_ctrl_c_writes_the_best_so_far_and_the_search_goes_on(tmp_path, capsys):
    output, study = tmp_path / 'out.yaml', tmp_path / 'out.study.jsonl'
    code, out, err = interrupted(study, 6, *options(tmp_path, '--budget', 100000))
    assert (code, err) == (130, '')
    numbers = json.loads(out)
    assert numbers['interrupted']
    assert numbers['scenarios'] == {}
    assert load(output).model.rows == 3
    assert {str(study) + ',', '--resume'} <= set(output.read_text().split())
    budget = numbers['evaluations'] + 6
    assert main(options(tmp_path, '--budget', budget, '--resume', study)) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert (numbers['interrupted'], numbers['study']) == (False, str(study))
    fresh = tmp_path / 'fresh'
    assert main(options(fresh, '--budget', budget)) == 0
    assert load(fresh / 'out.yaml') == load(output)
    known = study.read_text()
    assert (fresh / 'out.study.jsonl').read_text() == known
    assert main(options(tmp_path, '--budget', budget, '--resume', study)) == 0
    assert study.read_text() == known  # nothing was evaluated twice


@pytest.mark.parametrize(
    ('more', 'line'),
    [
        (['--no-loads'], 'sheet is 5 x 5 -> 3 x 3 nodes, with a factor of gravity'),
        (['--alpha', '0'], 'trained on is falling, 0.3 s each, weight exp(0.001 t) there'),
        (['--optimiser', 'cma'], 'optimiser is gradient there, and cma here'),
        (['-c', 'own.yaml'], 'model.mass is 11.025 there, and 0.2 here'),
    ],
)
def test_a_study_of_something_else_is_refused_by_name(
    more, line, tmp_path, parameters, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    parameters(model={'width': 1.5, 'height': 1.5, 'mass': 0.2}).rename('own.yaml')
    assert main(options(tmp_path, '--budget', 4)) == 0
    study = tmp_path / 'out.study.jsonl'
    assert main(options(tmp_path, '--budget', 4, '--resume', study, *more)) == 1
    said = capsys.readouterr().err
    assert f'{study}: is a study of something else: {line}' in said
    assert said.count('\n') == 1


def test_what_cannot_be_written_is_said_before_the_search(tmp_path, capsys):
    (tmp_path / 'file').touch()
    for more in (['-o', tmp_path], ['--report', tmp_path / 'file']):
        assert main(options(tmp_path, *more)) == 1
        assert 'cannot be written' in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['file']  # no study


def test_a_surface_of_ones_own_keeps_its_filter(parameters, tmp_path):
    config = parameters(model={'width': 0.4, 'height': 0.6, 'mass': 0.2}, horizon=0.07)
    options = ['--from', '5x5', '--to', '3x3', '--duration', '0.2', '--budget', '8']
    output = tmp_path / 'out.yaml'
    assert main(['compress', *options, '-c', str(config), '-o', str(output)]) == 0
    written = load(output)
    assert written.horizon == 0.07
    assert (written.model.width, written.model.height) == (0.4, 0.6)
    assert sum(written.model.masses) == pytest.approx(0.2, rel=1e-12)  # rounding


@pytest.mark.parametrize(
    ('options', 'line'),
    [
        (
            ['--to', '7x5'],
            '7 x 5 is no sub-grid of 21 x 21: 20 steps between 21 rows cannot be shared out to 6',
        ),
        (['--from', '5x5', '--to', '9x9'], '9 x 9 has more nodes than 5 x 5'),
        (['--to', '1x5'], '21 x 21 to 1 x 5: a sheet has at least 2 rows and columns'),
    ],
)
def test_what_cannot_be_compressed_is_one_line(options, line, tmp_path, capsys):
    assert main(['compress', *options, '-o', str(tmp_path / 'out.yaml')]) == 1
    assert line in capsys.readouterr().err
    assert not (tmp_path / 'out.yaml').exists()


@pytest.mark.parametrize(
    ('changes', 'line'),
    [
        ({'rest_length': 'measured'}, 'model.rest_length: a sheet is compressed with dimensions'),
        ({'refine': 2}, 'model.refine: a sheet is compressed with 1 only'),
        ({'masses': (0.1,) * 20}, 'model.masses: belongs to another mesh'),
        ({'damping': 0.0}, 'model.dampers'),
    ],
)
def test_a_surface_that_is_no_even_sheet_is_refused(changes, line):
    surface = replace(THESIS, model=replace(THESIS.model, **changes))
    with pytest.raises(ConfigError, match=line):
        Task(surface=surface).space()


def test_a_scenario_that_is_none_or_judges_nothing_is_named():
    with pytest.raises(ConfigError, match='scenarios: raised is held out, and trained on'):
        Task(trained=('falling', 'raised'), held_out=('raised',))
    with pytest.raises(ConfigError, match='scenarios: flying is none of falling, raised'):
        Task(trained=('flying',))
