"""The command `identify`: what it is given, and what it writes."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
from interrupting import interrupted
from shaken import ANCHORS, GUESS, NAMES, TRUE, first_guess, recording

from cloth_predict import cli
from cloth_predict.config import build, dump, load
from cloth_predict.errors import ClothPredictError, FormatError
from cloth_predict.evaluation.cases import frames_of, labelled_case
from cloth_predict.evaluation.compare import compare
from cloth_predict.evaluation.predictors import methods
from cloth_predict.formats.bag import Recording, write_recording
from cloth_predict.formats.recording import read
from cloth_predict.identification.objectives.horizon import FARTHEST, Horizon
from cloth_predict.identification.objectives.parallel import Called, Parallel, Summed
from cloth_predict.identification.objectives.parameters import Space
from cloth_predict.identification.objectives.stretches import trajectories
from cloth_predict.identification.task import Task, usual
from cloth_predict.identification.workers import workers


def case_of(markers, config=None):
    return labelled_case(markers, config or first_guess(), 'towel')


# --- stretches of a recording -----------------------------------------------------------------


def test_a_stretch_begins_where_the_markers_are_and_as_fast_as_they_are():
    times = np.arange(80) / 100
    path = 0.3 * times[:, None] ** 2 * [1.0, -2.0, 0.5] + times[:, None] * [0.1, 0.2, 0.3]
    surface = np.random.default_rng(1).normal(0, 0.1, (20, 3)) + path[:, None]
    markers = replace(recording(1, 0.79, noise=0.0), positions=surface)
    space = Space.of(first_guess(), NAMES)
    found = trajectories(case_of(markers), space, 0.3).scenarios
    assert [round(100 * s.times[-1]) for s in found] == [30, 30, 14]
    for scenario, k in zip(found, (5, 35, 65), strict=True):
        np.testing.assert_allclose(scenario.position, surface[k], atol=1e-12)  # a parabola
        speed = 0.6 * times[k] * np.array([1.0, -2.0, 0.5]) + [0.1, 0.2, 0.3]
        np.testing.assert_allclose(scenario.velocity, np.tile(speed, (20, 1)), atol=1e-10)
        np.testing.assert_array_equal(scenario.driven, surface[k : k + len(scenario.times), :4])
        np.testing.assert_array_equal(
            scenario.target[1:], surface[k + 1 : k + len(scenario.times), 4:]
        )
        assert np.isnan(scenario.target[0]).all()  # given, and so no achievement


def test_long_intervals_are_split_and_gaps_stay_out_of_the_cost():
    markers = recording(1, 0.6, noise=0.0)
    keep = np.delete(np.arange(len(markers)), np.arange(30, 33))  # 40 ms
    gappy = frames_of(markers, keep)
    hidden = gappy.visible.copy()
    hidden[40:45, 7] = hidden[36:38, 2] = False
    positions = np.where(hidden[..., None], gappy.positions, np.nan)
    gappy = replace(gappy, visible=hidden, positions=positions)
    space = Space.of(first_guess(), NAMES)
    (scenario,) = trajectories(case_of(gappy), space, 9.0).scenarios
    np.testing.assert_allclose(np.diff(scenario.times), 0.01, atol=1e-12)  # rounding
    unknown = np.isnan(scenario.target).all(axis=-1)
    assert np.flatnonzero(unknown.all(axis=1)).tolist() == [0, 25, 26, 27]
    assert np.flatnonzero(unknown[:, 3] & ~unknown.all(axis=1)).tolist() == list(range(38, 43))
    assert np.isfinite(scenario.driven).all()
    between = np.interp(
        scenario.times[25:28], scenario.times[[24, 28]], markers.positions[[29, 33], 0, 1]
    )
    np.testing.assert_allclose(scenario.driven[25:28, 0, 1], between, atol=1e-12)  # rounding


def test_what_stands_still_stays_where_it_is_on_average():
    config = build({'model': TRUE, 'anchors': {'nodes': [0, 1, 2, 3]}}, 'x')
    markers = recording(1, 0.25)
    (scenario,) = trajectories(case_of(markers, config), Space.of(config, NAMES), 9.0).scenarios
    assert np.ptp(scenario.driven, axis=0).max() == 0
    np.testing.assert_allclose(scenario.driven[0], markers.positions[5:, :4].mean(axis=0))


@pytest.mark.parametrize('flaw', ['short', 'gappy', 'unstarted'])
def test_a_recording_that_has_no_stretch_is_refused_by_name(flaw):
    markers = recording(1, 0.08 if flaw == 'short' else 0.6)
    hidden = markers.visible.copy()
    if flaw == 'gappy':
        hidden[1::2, 9] = hidden[2::4, 9] = False
    if flaw == 'unstarted':
        hidden[:, 1] = False
    markers = replace(markers, visible=hidden)
    message = 'waiting for the driven' if flaw == 'unstarted' else 'too short, or too gappy'
    with pytest.raises(FormatError, match=f'^towel: .*{message}'):
        trajectories(case_of(markers), Space.of(first_guess(), NAMES), 9.0)


# --- the error of predictions -----------------------------------------------------------------


@pytest.fixture(scope='module')
def shaken_case():
    config = first_guess(force={'kind': 'ornstein_uhlenbeck'})
    return case_of(recording(3, 1.6), config), config


def test_the_horizon_error_is_that_of_evaluate(shaken_case):
    case, config = shaken_case
    (evaluation,) = compare(case, config, [0.1], methods(['ekf']))
    objective = Horizon(Space.of(config, NAMES), case, 0.1)
    found = 1e3 * np.sqrt(objective.part(0, objective.space.start) / objective.weight)
    assert found == pytest.approx(evaluation.scores['ekf'].rmse_free_mm, rel=1e-9)  # logs, exps
    assert len(objective.residuals(0, objective.space.start)) == len(objective.blocks)
    assert set(objective.blocks) == {2, 3}  # of 0.5 s, after the warm-up


def test_some_frames_have_the_predictions_that_all_of_them_have(shaken_case):
    case, config = shaken_case
    space = Space.of(config, NAMES)
    every, some = (Horizon(space, case, 0.1, n) for n in (1, 5))
    residuals = every.residuals(0, space.start).reshape(-1, 16, 3)
    np.testing.assert_array_equal(
        some.residuals(0, space.start).reshape(-1, 16, 3), residuals[::5]
    )


def test_what_is_not_predicted_counts_as_what_was_seen_last(shaken_case):
    case, config = shaken_case
    strict = replace(config, limits=replace(config.limits, sigma_error=1e-9))
    objective = Horizon(Space.of(strict, NAMES), case, 0.1)
    (evaluation,) = compare(case, config, [0.1], methods([]))
    found = 1e3 * np.sqrt(objective.part(0, objective.space.start) / objective.weight)
    assert found == pytest.approx(evaluation.scores['hold'].rmse_free_mm, rel=1e-12)  # rounding


def test_a_wild_prediction_counts_no_more_than_the_longest_error(shaken_case):
    case, config = shaken_case
    fast = replace(
        config, filter=replace(config.filter, integrator='euler', max_step=0.1, predict_step=0.1)
    )
    objective = Horizon(Space.of(fast, NAMES), case, 0.1)
    residuals = objective.residuals(0, objective.space.start).reshape(-1, 3)
    assert np.linalg.norm(residuals, axis=1).max() <= FARTHEST * (1 + 1e-12)  # rounding
    assert np.isfinite(residuals).all()


def test_what_was_found_on_three_takes_of_a_rope_serves_three_others(real):
    # a first guess from a tape measure and a kitchen scale, and what came out of it by
    # identify rope_take1..3.csv -c guess.yaml --horizon 0.2 --parameters (those below)
    # --budget 700 --seed 1
    guess = {
        'model': {'rows': 1, 'cols': 13, 'mass': 0.1}
        | {'rest_length': 'calibrated', 'calibration': 0.5},
        'anchors': {'nodes': [0, 12], 'motion': 'swing', 'process_noise': 10.0},
        'force': {'kind': 'ornstein_uhlenbeck'},
        'limits': {'sigma_warn': 0.05, 'sigma_error': 0.3},
    }
    values = {
        'model.stiffness_structural': 44.12,
        'model.stiffness_flexion': 7.282,
        'model.damping': 0.04927,
        'model.prestretch': 0.04405,
        'anchors.process_noise': 67.79,
        'anchors.decay': 4.349,
        'anchors.restoring': 20.9,
        'force.sigma': 0.3164,
        'force.tau': 3.38,
        'filter.process_noise': 0.04492,
        'filter.measurement_noise': 0.0004935,
    }
    space = Space.of(build(guess, 'guess'), values)
    takes = [
        labelled_case(read(real(f'rope/rope_take{k}.csv')).markers, space.config, f'take {k}')
        for k in (4, 5, 6)
    ]
    summed = Summed(tuple(Horizon(space, take, 0.2, 5) for take in takes))
    before, after = (
        sum(summed.part(k, vector) for k in range(3))
        for vector in (space.start, space.searched(list(values.values())))
    )
    assert np.sqrt(after / before) <= 0.75  # 0.705; at every frame 32.55 -> 22.96 mm


def test_a_filter_that_fails_has_no_cost(shaken_case):
    case, config = shaken_case
    heavy = replace(config, model=replace(config.model, gravity=(0.0, -1e300, 0.0)))
    objective = Horizon(Space.of(heavy, NAMES), case, 0.1)
    assert np.isnan(objective.part(0, objective.space.start))


def test_too_short_a_recording_is_refused_by_name():
    case = case_of(recording(1, 0.9))
    with pytest.raises(FormatError, match=r'towel: nothing to judge 0\.1 s ahead'):
        _ = Horizon(Space.of(first_guess(), NAMES), case, 0.1).weight


def test_a_horizon_error_has_no_gradient(shaken_case):
    case, config = shaken_case
    with pytest.raises(ClothPredictError, match='has no gradient'):
        Horizon(Space.of(config, NAMES), case, 0.1).part_gradient(0, np.zeros(4))


def test_processes_beside_each_other_give_the_same_numbers():
    config = first_guess()
    space = Space.of(config, NAMES)
    cases = [case_of(recording(seed, 0.4)) for seed in (1, 2, 3)]
    summed = Summed(tuple(trajectories(case, space, 9.0) for case in cases))
    vectors = [space.start, space.start + 0.1]
    alone = Parallel(summed, lambda work: map(Called(summed), work))
    with workers(Called(summed), 2) as do:
        beside = Parallel(summed, do)
        assert beside.values(vectors) == alone.values(vectors)
        one, other = beside.gradient(vectors[0]), alone.gradient(vectors[0])
    assert one[0] == other[0]
    np.testing.assert_array_equal(one[1], other[1])


# --- which parameters -------------------------------------------------------------------------


def test_what_is_switched_off_stays_off():
    config = first_guess(force={'kind': 'ornstein_uhlenbeck'})
    assert usual(Task(config, 'trajectory')) == NAMES
    assert usual(Task(config, 'trajectory', per_spring=True)) == ('model.springs', 'model.dampers')
    more = usual(Task(config, 'horizon'))[4:]
    assert more == (
        'filter.process_noise',
        'force.sigma',
        'force.tau',
        'anchors.process_noise',
        'anchors.decay',
        'anchors.restoring',
    )


# --- the command ------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Three bags and a parameter file."""
    path = tmp_path_factory.mktemp('towel')
    for seed in (1, 2, 3):
        write_recording(path / f'take{seed}', Recording(recording(seed, 1.1)))
    (path / 'guess.yaml').write_text(dump(first_guess()))
    return path


def run(capsys, *arguments):
    try:
        code = cli.main(['identify', *map(str, arguments)])
    except SystemExit as leave:
        code = leave.code
    return code, *capsys.readouterr()


def options(folder, *takes):
    bags = [folder / f'take{take}' for take in takes]
    return [*bags, '-c', folder / 'guess.yaml', '--objective', 'trajectory']


def test_a_parameter_file_with_its_provenance_and_a_picture(capsys, folder, tmp_path):
    arguments = [*options(folder, 1, 2), '--held-out', folder / 'take3', '-o', tmp_path / 'out']
    code, out, err = run(capsys, *arguments, '--json')
    assert (code, err) == (0, '')
    found = json.loads(out)
    for name in NAMES:
        value = found['parameters'][name]
        assert value['before'] == pytest.approx(GUESS[name[6:]], rel=1e-12)  # a log and an exp
        assert value['after'] == pytest.approx(TRUE[name[6:]], rel=0.05)  # 2.2 s in all
        assert value['determined'] is True
        assert 0 < value['sigma'] < 0.05 * value['after']
    assert found['optimiser'] == 'gradient'
    assert found['evaluations'] <= 1000
    for of in found['scores_mm'].values():
        assert of['after'] < 0.1 * of['before']
        assert of['after'] < 1.0  # sqrt(3) times 0.3 mm, and what starts add
    path = tmp_path / 'out' / 'identified.yaml'
    text, config = path.read_text(), load(path)
    for word in ('take1 (content ', 'take3 (content ', 'gradient, seed 0', 'score, held out'):
        assert word in text
    for name in NAMES:
        assert getattr(config.model, name[6:]) == found['parameters'][name]['after']
    assert replace(config, model=first_guess().model) == first_guess()
    assert path.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    # the same search again, from its study, tells the same, in words
    study = path.with_suffix('.study.jsonl')
    again = run(capsys, *arguments[:-1], tmp_path / 'again.yaml', '--resume', study)
    assert (again[0], again[2]) == (0, '')
    assert 'score, held out: ' in again[1]
    assert load(tmp_path / 'again.yaml') == config


def test_a_value_for_each_spring(capsys, folder, tmp_path):
    given = [*options(folder, 1), '--per-spring', '--budget', 30, '-o', tmp_path / 'new.yaml']
    with warnings.catch_warnings():
        warnings.simplefilter('default')  # as for a user
        code, out, err = run(capsys, *given, '--json')
    assert code == 0
    assert err.startswith('cloth-predict: warning: these recordings do not fix model.springs[0], ')
    assert err.count('\n') == 1
    found, model = json.loads(out), load(tmp_path / 'new.yaml').model
    assert len(model.springs) == len(model.dampers) == 31 + 24 + 22
    assert len(found['parameters']) == 2 * 77
    assert found['best_mm'] < 0.5 * found['trace'][0][1]
    assert not np.allclose(model.springs, 60.0)


def test_a_study_goes_on_with_a_larger_budget(capsys, folder, tmp_path):
    path = tmp_path / 'a.yaml'
    more = ['--optimiser', 'cma', '--json', '-o']
    assert run(capsys, *options(folder, 1), *more, path, '--budget', 20)[0] == 0
    study = tmp_path / 'a.study.jsonl'
    lines = study.read_text().splitlines()
    assert len(lines) == 1 + 17  # the start, and two generations of 8
    run(capsys, *options(folder, 1), *more, path, '--budget', 30, '--resume', study)
    assert study.read_text().splitlines()[:18] == lines
    assert len(study.read_text().splitlines()) == 1 + 25
    _, out, _ = run(capsys, *options(folder, 1), *more, tmp_path / 'b.yaml', '--budget', 30)
    assert load(path) == load(tmp_path / 'b.yaml')
    for change, name in (
        (['--alpha', '0.5'], 'objective'),
        (['--seed', '1'], 'seed'),
        (['--parameters', 'model.damping'], 'searched'),
    ):
        code, out, err = run(capsys, *options(folder, 1), *more, path, '--resume', study, *change)
        assert (code, out) == (1, '')
        assert f'a.study.jsonl: is a study of something else: {name} is ' in err
    code, _, err = run(capsys, *options(folder, 2), *more, path, '--resume', study)
    assert code == 1
    assert 'is a study of something else: recordings is ' in err
    other = tmp_path / 'other.yaml'
    other.write_text(dump(replace(first_guess(), model=replace(first_guess().model, mass=0.4))))
    given = [folder / 'take1', '-c', other, '--objective', 'trajectory']
    code, _, err = run(capsys, *given, *more, path, '--resume', study)
    assert code == 1
    assert 'model.mass is 0.34 there, and 0.4 here' in err


@pytest.mark.parametrize(
    ('more', 'code', 'message'),
    [
        (['--optimiser', 'gradient', '--objective', 'horizon'], 2, 'needs --objective trajectory'),
        (['--parameters', 'model.dampping'], 1, 'model.dampping: unknown parameter'),
        (['--parameters', 'force.sigma'], 1, 'force.sigma: has no gradient'),
        (['--objective', 'horizon', '--horizon', '0.2'], 1, 'nothing to judge 0.2 s ahead'),
        (['--budget', '0'], 2, 'less than 1'),
        (['--budget', '2'], 1, 'no valid result: none of 0 evaluations'),
        (['--parameters', 'replay.rate'], 1, 'replay.rate: has no say in how well'),
        (['--jobs', '0'], 2, '0 is less than 1'),
        (['--held-out', 'nowhere'], 1, 'nowhere: no such file or folder'),
    ],
)
def test_what_cannot_be_done_is_one_line(capsys, folder, tmp_path, more, code, message):
    found, out, err = run(capsys, *options(folder, 1), '-o', tmp_path / 'x.yaml', *more)
    assert (found, out) == (code, '')
    assert message in err
    assert code == 2 or err.count('\n') == 1
    assert not (tmp_path / 'x.yaml').exists()


def test_what_is_searched_on_cannot_be_held_out(capsys, folder, tmp_path):
    copy = shutil.copytree(folder / 'take1', tmp_path / 'copy')
    given = [*options(folder, 1, 2), '--held-out', copy, '-o', tmp_path / 'x.yaml']
    code, out, err = run(capsys, *given)
    assert (code, out) == (1, '')
    assert f'{copy}: is held out, but holds the same as {folder / "take1"}' in err
    assert err.count('\n') == 1


@pytest.mark.parametrize('objective', ['horizon', 'trajectory'])
def test_a_surface_that_never_starts_is_refused_by_name(capsys, folder, tmp_path, objective):
    markers = recording(1, 1.5)
    hidden = markers.visible.copy()
    hidden[:, 1] = False
    write_recording(tmp_path / 'take', Recording(replace(markers, visible=hidden)))
    given = [tmp_path / 'take', '-c', folder / 'guess.yaml', '--objective', objective]
    code, out, err = run(capsys, *given, '-o', tmp_path / 'x.yaml')
    assert (code, out) == (1, '')
    assert 'take: no surface yet: 19 of 5 x 4 = 20 nodes seen, waiting for the driven' in err
    assert err.count('\n') == 1


def test_what_cannot_be_written_is_said_before_the_search(capsys, folder, tmp_path):
    (tmp_path / 'x.yaml').mkdir()
    (tmp_path / 'file').touch()
    for output in (tmp_path / 'x.yaml', tmp_path / 'file' / 'x.yaml'):
        code, out, err = run(capsys, *options(folder, 1), '-o', output)
        assert (code, out) == (1, '')
        assert 'cannot be written' in err
        assert err.count('\n') == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ['file', 'x.yaml']  # no study


@pytest.mark.parametrize('jobs', [1, 2])
def test_ctrl_c_writes_the_best_so_far_and_the_search_goes_on(capsys, folder, tmp_path, jobs):
    path = tmp_path / 'best.yaml'
    usual = [*options(folder, 1), '--optimiser', 'annealing', '--json']
    study = path.with_suffix('.study.jsonl')
    code, out, err = interrupted(study, 10, 'identify', *usual, '--jobs', jobs, '-o', path)
    assert (code, err) == (130, '')
    found = json.loads(out)
    assert found['interrupted']
    assert found['parameters'][NAMES[0]]['sigma'] is None
    assert load(path).model.damping == found['parameters']['model.damping']['after']
    assert '--resume' in path.read_text()
    assert ANCHORS['motion'] == load(path).anchors.motion
    more = '--budget', found['evaluations'] + 5
    assert run(capsys, *usual, *more, '-o', path, '--resume', study)[0] == 0
    assert run(capsys, *usual, *more, '-o', tmp_path / 'at_once.yaml')[0] == 0
    assert load(path) == load(tmp_path / 'at_once.yaml')


def test_ctrl_c_while_processes_start_says_nothing(folder, tmp_path):
    path = tmp_path / 'none.yaml'
    study = path.with_suffix('.study.jsonl')
    assert interrupted(
        study, 1, 'identify', *options(folder, 1), '--jobs', 2, '-o', path
    ) == (130, '', '')  # fmt: skip
    assert not path.exists()
