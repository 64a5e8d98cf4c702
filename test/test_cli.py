"""The commands, as a user meets them: files, what is printed, and one line for what is wrong."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from cloth_predict import __version__, cli, commands
from cloth_predict.config import load
from cloth_predict.evaluation.predictors import BASELINES
from cloth_predict.filters.family import FILTERS
from cloth_predict.formats.bag import (
    Recording,
    Truth,
    create_bag,
    read_clouds,
    read_recording,
    write_recording,
)
from cloth_predict.formats.pointcloud import MARKERS, SURFACE
from cloth_predict.types import FloatArray, MarkerSequence

ROOT = Path(__file__).parents[1]
LABELS = ('a', 'b', 'c', 'd', 'e', 'f')
FRAMES = 66  # 1.3 s at 50 Hz
STAMPS = np.arange(FRAMES) * 20_000_000
NUMBERS = [
    'rmse_mm', 'rmse_free_mm', 'p95_mm', 'max_mm', 'rmse_95_mm', 'us_per_frame', 'coverage', 'nis',
    'nees', 'by_speed', 'ratio', 'ratio_95', 'predicted', 'counts',
]  # fmt: skip
MODEL = {'rows': 2, 'cols': 3, 'width': 0.2, 'height': 0.1}
ANCHORS = {'nodes': [0, 1, 2]}
ONE_STEP = {'max_step': 0.02}  # s, from frame to frame

Parameters = Callable[..., Path]


class Result(NamedTuple):
    code: int
    out: str
    err: str


class Run:
    """Runs the command in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: object) -> Result:
        try:
            code: Any = cli.main([str(argument) for argument in arguments])
        except SystemExit as leave:  # how argparse ends
            code = leave.code
        return Result(code, *self._capsys.readouterr())

    def well(self, *arguments: object) -> str:
        """Run what has to succeed without a word on standard error, and return its output."""
        code, out, err = self(*arguments)
        assert (code, err) == (0, '')
        return out

    def badly(self, *arguments: object) -> str:
        """Run what has to fail with one line, and return that line."""
        code, out, err = self(*arguments)
        assert (code, out) == (1, '')
        assert err.startswith('cloth-predict: ')
        assert err.endswith('\n')
        assert err.count('\n') == 1
        return err.removeprefix('cloth-predict: ').rstrip('\n')


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(capsys)


def swaying(frames: int = FRAMES) -> FloatArray:
    """Positions [m], shape (frames, 6, 3), of a small cloth whose lower row swings."""
    positions = np.zeros((frames, 2, 3, 3))
    positions[..., 0] = [0.0, 0.1, 0.2]
    angle = 0.3 * np.sin(2 * np.pi * STAMPS[:frames] / 1e9)[:, None]
    positions[:, 1, :, 1], positions[:, 1, :, 2] = -0.1 * np.cos(angle), 0.1 * np.sin(angle)
    return positions.reshape(frames, 6, 3)


def sequence(positions: FloatArray, labels: tuple[str, ...] = LABELS) -> MarkerSequence:
    visible = np.isfinite(positions).all(axis=2)
    return MarkerSequence(STAMPS[: len(positions)], labels, positions, visible)


def small(parameters: Parameters, **values: Any) -> Path:
    return parameters(**{'model': MODEL, 'anchors': ANCHORS, **values})


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    write_recording(tmp_path / 'bag', Recording(sequence(swaying())))
    return tmp_path / 'bag'


MOTIVE = """\
Format Version,1.23,Export Frame Rate,50.000000,Length Units,Millimeters

,Type,Marker,Marker,Marker,Marker,Marker,Marker
,Name,A,A,A,B,B,B
,,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,X,Y,Z
0,0.000000,1.0,2.0,3.0,4.0,5.0,6.0
1,0.020000,1.5,2.5,3.5,,,
"""


@pytest.fixture
def take(tmp_path: Path) -> Path:
    path = tmp_path / 'take.csv'
    path.write_text(MOTIVE)
    return path


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- simulate --------------------------------------------------------------------------------


def test_simulate(run: Run, tmp_path: Path) -> None:
    path = tmp_path / 'new' / 'towel'
    out = run.well('simulate', 'towel_fan', '-o', path, '--duration', 0.5, '--seed', 3)
    assert out == f'{path}: towel_fan, 0.5 s, seed 3\n'
    found = read_recording(path)
    assert found.markers.stamps.tolist() == list(range(0, 510_000_000, 10_000_000))
    assert found.markers.labels == tuple(f'cloth:{i}' for i in range(20))
    assert found.truth is not None
    assert found.truth.surface.shape == (51, 17, 13, 3)
    error = found.markers.positions - found.truth.markers(found.markers).positions
    assert np.nanstd(error) == pytest.approx(3e-4, rel=0.05)  # 3000 draws are within 1.3 %
    assert 0.95 < found.markers.visible.mean() < 1


def test_simulate_repeats_itself(run: Run, tmp_path: Path) -> None:
    for name, seed in (('a', 1), ('b', 1), ('c', 2)):
        arguments = ['--duration', 0.05, '--seed', seed, '-o', tmp_path / name]
        run.well('simulate', 'falling_cloth', *arguments)
    a, b, c = (bytes_of(tmp_path / name) for name in 'abc')
    assert a == b
    assert a['bag.mcap'] != c['bag.mcap']


# --- convert ---------------------------------------------------------------------------------


def test_convert(run: Run, take: Path, tmp_path: Path) -> None:
    out = run.well('convert', take, '-o', tmp_path / 'x')
    assert out == (
        f'{tmp_path / "x"}: 2 frames, 0.02 s, 2 markers, 25.0% of the samples missing\n'
    )
    markers = read_recording(tmp_path / 'x').markers
    assert markers.labels == ('A', 'B')
    assert markers.stamps.tolist() == [0, 20_000_000]
    assert markers.visible.tolist() == [[True, True], [True, False]]
    expected = np.float32([[0.001, 0.002, 0.003], [0.0015, 0.0025, 0.0035]])
    np.testing.assert_array_equal(markers.positions[:, 0], expected)


def test_convert_a_bag_copies_it(run: Run, tmp_path: Path) -> None:
    positions = swaying(5)
    truth = Truth(STAMPS[:5], positions.reshape(5, 2, 3, 3), np.arange(6).reshape(2, 3))
    write_recording(tmp_path / 'x', Recording(sequence(positions), truth))
    before = bytes_of(tmp_path / 'x')
    run.well('convert', tmp_path / 'x', '-o', tmp_path / 'y')
    assert bytes_of(tmp_path / 'y') == before
    assert 'is the recording itself' in run.badly('convert', tmp_path / 'x', '-o', tmp_path / 'x')
    assert bytes_of(tmp_path / 'x') == before


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('rope/rope_take1.csv', '500 frames, 4.99 s, 13 markers, 0.0% of the samples missing'),
        ('motive/hmv_s16_v1.21.csv', '250 frames, 2.08 s, 12 markers, '),
        ('motive/ha5dzs_v1.23_markers.csv', '1353 frames, 3.76 s, 18 markers, 8.4% of the'),
    ],
)
def test_convert_real_exports(
    run: Run, real: Callable[[str], Path], tmp_path: Path, name: str, text: str
) -> None:
    out = run.well('convert', real(name), '-o', tmp_path / 'x')
    assert out.startswith(f'{tmp_path / "x"}: {text}')
    assert f'{len(read_recording(tmp_path / "x").markers)} frames' in out


def test_convert_a_real_export_without_markers(
    run: Run, real: Callable[[str], Path], tmp_path: Path
) -> None:
    path = real('motive/ha5dzs_v1.23_default.csv')
    line = run.badly('convert', path, '-o', tmp_path / 'x')
    assert line.startswith(f'{path}: no marker columns')
    assert list(tmp_path.iterdir()) == []


# --- predict ---------------------------------------------------------------------------------


def test_predict(run: Run, bag: Path, parameters: Parameters, tmp_path: Path) -> None:
    path = tmp_path / 'x'
    out = run.well('predict', bag, '-c', small(parameters, horizon=0.06), '-o', path)
    assert out == f'{path}: 1 frames started, 65 frames updated\n'
    source, copy = read_recording(bag).markers, read_recording(path).markers
    assert copy.labels == LABELS
    np.testing.assert_array_equal(copy.positions, source.positions)
    estimates, predictions = (read_clouds(path, f'cloth/{n}') for n in ('estimate', 'prediction'))
    assert [stamp for stamp, _ in estimates] == STAMPS.tolist()
    assert [stamp for stamp, _ in predictions] == (STAMPS + 60_000_000).tolist()
    for _, cloud in (*estimates, *predictions):
        assert (cloud.height, cloud.width) == (2, 3)
        assert tuple(field.name for field in cloud.fields) == SURFACE.names
        assert cloud.header.frame_id == 'mocap'
    last = np.frombuffer(estimates[-1][1].data, SURFACE)
    estimate = np.column_stack([last[axis] for axis in 'xyz'])
    # 1.2 m/s^2 over a frame of 20 ms is 0.2 mm that the filter could not expect
    np.testing.assert_allclose(estimate, source.positions[-1], atol=1e-3)


def test_predict_twice_gives_the_same_bytes(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path
) -> None:
    for name in ('one', 'two'):
        run.well('predict', bag, '-c', small(parameters), '-o', tmp_path / name)
    assert bytes_of(tmp_path / 'one') == bytes_of(tmp_path / 'two')


def test_predict_tells_what_became_of_the_frames(
    run: Run, parameters: Parameters, tmp_path: Path
) -> None:
    positions = swaying(12)
    stamps = STAMPS[:12].copy()
    stamps[5] = stamps[4]  # a duplicate
    stamps[8:] += 2_000_000_000  # restarted
    positions[0, 2:] = np.nan  # waiting: a driven node is hidden
    visible = np.isfinite(positions).all(axis=2)
    markers = MarkerSequence(stamps, LABELS, positions, visible)
    write_recording(tmp_path / 'bag', Recording(markers))
    out = run.well(
        'predict', tmp_path / 'bag', '-c', small(parameters), '-o', tmp_path / 'x'
    ).strip()
    counts = {
        word: int(n) for n, _, word in (part.split() for part in out.split(': ')[1].split(', '))
    }
    assert counts == {'waiting': 1, 'started': 1, 'duplicate': 1, 'restarted': 1, 'updated': 8}
    assert len(read_recording(tmp_path / 'x').markers) == 12
    assert len(read_clouds(tmp_path / 'x', 'cloth/prediction')) == 10


def test_predict_leaves_out_what_is_too_uncertain(
    run: Run, parameters: Parameters, tmp_path: Path
) -> None:
    positions = swaying()
    positions[20:45] = np.nan  # half a second of nothing
    write_recording(tmp_path / 'bag', Recording(sequence(positions)))
    every = run_predict(run, tmp_path, small(parameters, horizon=0.06))
    sigma = np.array([np.sqrt(np.mean(cloud['sigma'][3:] ** 2)) for cloud in every.values()])
    limit = float(2 * np.median(sigma))
    limits = {'sigma_warn': limit / 2, 'sigma_error': limit}
    kept = run_predict(run, tmp_path, small(parameters, horizon=0.06, limits=limits))
    assert 10 <= (sigma > limit).sum() <= 30  # what is hidden, but for the first moments
    assert list(kept) == [stamp for stamp, one in zip(every, sigma, strict=True) if one <= limit]


def run_predict(run: Run, folder: Path, config: Path) -> dict[int, Any]:
    """Predict a bag and return the clouds by their stamp."""
    out = run.well('predict', folder / 'bag', '-c', config, '-o', folder / 'x')
    clouds = read_clouds(folder / 'x', 'cloth/prediction')
    refused = re.findall(r'(\d+) frames unpredicted', out)
    assert len(clouds) == FRAMES - sum(map(int, refused))
    return {stamp: np.frombuffer(cloud.data, SURFACE) for stamp, cloud in clouds}


# --- evaluate --------------------------------------------------------------------------------


def test_evaluate_prints_a_table(run: Run, bag: Path, parameters: Parameters) -> None:
    lines = run.well('evaluate', bag, '-c', small(parameters)).splitlines()
    assert lines[0] == ('predicted 100 ms ahead, 11 frames, errors in mm, 95 % intervals')
    assert lines[1].split() == [
        'method', 'RMS', 'free', 'p95', 'max', 'interval', 'ratio', 'interval', 'us/frame',
    ]  # fmt: skip
    assert [line.split()[0] for line in lines[2:6]] == ['hold', 'kf_cv', 'kf_ca', 'ekf']
    assert lines[2].split()[5] == '-'  # 11 frames of 20 ms are less than a block of 0.5 s
    assert lines[6].startswith('free nodes: errors within 1, 2, 3 sigma; NIS')
    assert [line.split()[0] for line in lines[7:12]] == ['method', 'hold', 'kf_cv', 'kf_ca', 'ekf']
    assert len({len(line) for line in (*lines[1:6], *lines[7:12])}) == 2  # aligned
    assert max(map(len, lines)) < 100
    assert lines[12].startswith('ratio: RMS of the free nodes by that of kf_c')
    assert lines[13] == 'ekf: 1 started, 65 updated'
    angles = 0.3 * np.sin(2 * np.pi * STAMPS / 1e9)
    moved = 200 * np.abs(np.sin((angles[55:] - angles[50:61]) / 2))  # mm, a chord of 0.1 m
    hold = [float(word) for word in lines[2].split()[1:5]]
    expected = [np.sqrt(np.mean(moved**2) / 2), np.sqrt(np.mean(moved**2))]
    assert hold[:2] == pytest.approx(expected, abs=0.005)  # two digits are printed
    assert hold[3] == pytest.approx(moved.max(), abs=0.005)


def test_evaluate_json(run: Run, bag: Path, parameters: Parameters) -> None:
    out = run.well('evaluate', bag, '-c', small(parameters), '--json')
    found = json.loads(out)
    assert out.count('\n') == 1
    assert list(found) == ['horizon_s', 'frames', 'methods', 'best_kinematic']
    assert (found['horizon_s'], found['frames']) == (0.1, 11)
    assert list(found['methods']) == ['hold', 'kf_cv', 'kf_ca', 'ekf']
    for numbers in found['methods'].values():
        assert list(numbers) == NUMBERS
        assert 0 < numbers['rmse_mm'] < numbers['rmse_free_mm'] < numbers['max_mm']
        assert numbers['us_per_frame'] > 0
        assert numbers['rmse_95_mm'] == [None, None]
        assert [list(part) for part in numbers['by_speed']] == [['up_to_m_s', 'rmse_mm']] * 3
        assert all(part['rmse_mm'] > 0 for part in numbers['by_speed'])
    coverage = {name: numbers['coverage'] for name, numbers in found['methods'].items()}
    assert coverage.pop('hold') is None
    for shares in coverage.values():
        assert 0 <= shares[0] <= shares[1] <= shares[2] <= 1
    told = [name for name, numbers in found['methods'].items() if numbers['nis'] is not None]
    assert told == ['kf_cv', 'kf_ca', 'ekf']
    assert found['methods'][found['best_kinematic']]['ratio'] == 1.0
    assert found['methods']['ekf']['counts'] == {'started': 1, 'updated': 65}
    assert [numbers['predicted'] for numbers in found['methods'].values()] == [1.0] * 4


def test_evaluate_tells_an_interval_and_a_coverage(
    run: Run, parameters: Parameters, tmp_path: Path
) -> None:
    seconds = np.arange(250) / 50
    positions = np.repeat(swaying(1), 250, axis=0)
    positions[:, 3:, 2] += 0.05 * np.sin(2 * np.pi * seconds)[:, None]
    stamps = np.arange(250) * 20_000_000
    markers = MarkerSequence(stamps, LABELS, positions, np.ones((250, 6), bool))
    write_recording(tmp_path / 'x', Recording(markers))
    arguments = ['evaluate', tmp_path / 'x', '-c', small(parameters)]
    found = json.loads(run.well(*arguments, '--json'))
    lines = run.well(*arguments).splitlines()
    for (name, numbers), line, more in zip(
        found['methods'].items(), lines[2:6], lines[8:12], strict=True
    ):
        low, high = numbers['rmse_95_mm']
        assert low <= numbers['rmse_mm'] <= high
        assert line.split()[5] == f'{low:.2f}-{high:.2f}', name
        low, high = numbers['ratio_95']
        assert low <= numbers['ratio'] <= high
        assert line.split()[6:8] == [f'{numbers["ratio"]:.2f}', f'{low:.2f}-{high:.2f}'], name
        told = [f'{100 * share:.1f} %' for share in numbers['coverage'] or []]
        assert re.findall(r'[\d.]+ %', more) == told
        assert more.split()[-3:] == [f'{part["rmse_mm"]:.2f}' for part in numbers['by_speed']]
    again = json.loads(run.well(*arguments, '--json'))
    assert without_times(again) == without_times(found)


def test_evaluate_at_several_horizons(run: Run, bag: Path, parameters: Parameters) -> None:
    arguments = ['evaluate', bag, '-c', small(parameters), '--horizon', 0.04, 0.1]
    found = json.loads(run.well(*arguments, '--json'))
    assert [(f['horizon_s'], f['frames']) for f in found] == [(0.04, 14), (0.1, 11)]
    tables = run.well(*arguments).strip().split('\n\n')
    assert [table.split(',')[0] for table in tables] == [
        'predicted 40 ms ahead',
        'predicted 100 ms ahead',
    ]
    one = json.loads(run.well(*arguments[:-1], '--json'))
    assert without_times(one) == without_times(found[0])


def without_times(summary: dict[str, Any]) -> dict[str, Any]:
    methods = {
        name: {key: number for key, number in numbers.items() if key != 'us_per_frame'}
        for name, numbers in summary['methods'].items()
    }
    return {**summary, 'methods': methods}


def test_evaluate_writes_a_folder(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path
) -> None:
    config, folder = small(parameters, horizon=0.08), tmp_path / 'new' / 'report'
    out = run.well('evaluate', bag, '-c', config, '-o', folder)
    assert sorted(path.name for path in folder.iterdir()) == [
        'config.yaml', 'coverage_80ms.png', 'details_80ms.txt', 'error_80ms.png',
        'evaluation.json', 'ladder.png', 'snapshots_80ms.png', 'speed_80ms.png', 'table_80ms.txt',
    ]  # fmt: skip
    table, details = (folder / f'{name}_80ms.txt' for name in ('table', 'details'))
    assert table.read_text() + details.read_text() == out
    assert load(folder / 'config.yaml') == load(config)
    for picture in folder.glob('*.png'):
        content = picture.read_bytes()
        assert content.startswith(b'\x89PNG\r\n\x1a\n')
        assert len(content) > 10_000
    before = load(folder / 'config.yaml')
    run.well('evaluate', bag, '-c', folder / 'config.yaml', '-o', folder, '--json')
    assert load(folder / 'config.yaml') == before


@pytest.mark.filterwarnings('always')  # as on the command line
def test_evaluate_filters_that_the_configuration_allows(
    run: Run, bag: Path, parameters: Parameters
) -> None:
    config = small(parameters, wind={'kind': 'normal'}, horizon=0.02, filter=ONE_STEP)
    line = run.badly('evaluate', bag, '-c', config, '--filters', 'ekf', 'fixed_gain')
    assert line == 'filter.kind fixed_gain needs wind.kind none'
    code, out, err = run('evaluate', bag, '-c', config, '--filters', 'all', '--json')
    assert code == 0
    left_out = {'fixed_gain', 'reduced_rank'}
    assert set(json.loads(out)['methods']) == {*BASELINES, *FILTERS} - left_out
    assert [line.split()[3] for line in err.splitlines()] == sorted(left_out)
    assert all(line.endswith('needs wind.kind none') for line in err.splitlines())


def test_evaluate_several_recordings(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path
) -> None:
    config, other, folder = small(parameters), tmp_path / 'other', tmp_path / 'out'
    write_recording(other, Recording(sequence(swaying()[:, [0, 1, 2, 5, 4, 3]] * 1.5)))
    arguments = ['evaluate', bag, other, '-c', config, '--horizon', 0.04, 0.1]
    found = json.loads(run.well(*arguments, '--json'))
    assert [(f['bag'], f['horizon_s'], f['frames']) for f in found] == [
        (str(bag), 0.04, 14), (str(bag), 0.1, 11), (str(other), 0.04, 14), (str(other), 0.1, 11),
        ('all', 0.04, 28), ('all', 0.1, 22),
    ]  # fmt: skip
    for name in ('hold', 'kf_cv', 'ekf'):
        one, two, both = (found[k]['methods'][name]['rmse_mm'] for k in (1, 3, 5))
        assert both == pytest.approx(np.sqrt((one**2 + two**2) / 2), rel=1e-9)  # a sum
    alone = json.loads(run.well('evaluate', other, '-c', config, '--json'))
    assert without_times({'bag': str(other), **alone}) == without_times(found[3])
    lines = run.well('evaluate', bag, other, '-c', config, '-o', folder).splitlines()
    assert {path.name for path in folder.iterdir()} >= {'bag', 'other', 'ladder.png'}
    assert (folder / 'bag' / 'snapshots_100ms.png').exists()
    assert not list(folder.glob('snapshots*'))  # of which recording?
    written = json.loads((folder / 'evaluation.json').read_text())
    assert [without_times(f) for f in written] == [without_times(found[k]) for k in (1, 3, 5)]
    assert lines[0].startswith(f'{bag}: predicted 100 ms ahead')
    assert [line for line in lines if line.startswith('all: predicted 100 ms ahead, 22 frames')]


def test_evaluate_other_filters(run: Run, bag: Path, parameters: Parameters) -> None:
    config = small(parameters)
    arguments = ['evaluate', bag, '-c', config, '--json', '--filters', 'gomes2016', 'ekf']
    found = json.loads(run.well(*arguments))['methods']
    assert list(found) == ['hold', 'kf_cv', 'kf_ca', 'gomes2016', 'ekf']
    plain = json.loads(run.well('evaluate', bag, '-c', config, '--json'))['methods']
    for name in ('hold', 'kf_cv', 'kf_ca', 'ekf'):
        assert {**found[name], 'us_per_frame': 0} == {**plain[name], 'us_per_frame': 0}
    assert set(FILTERS) > {'ekf', 'ukf', 'gomes2016'}
    assert list(commands.Ladder(filters=('all',)).methods(load(config)))[3:] == list(FILTERS)


def test_evaluate_at_the_best_of_the_baselines(
    run: Run, bag: Path, parameters: Parameters
) -> None:
    arguments = ['evaluate', bag, '-c', small(parameters)]
    plain = json.loads(run.well(*arguments, '--json'))['methods']
    best = json.loads(run.well(*arguments, '--best-baselines', '--json'))['methods']
    lines = run.well(*arguments, '--best-baselines')
    for name in ('kf_cv', 'kf_ca'):
        assert best[name]['rmse_free_mm'] < plain[name]['rmse_free_mm']
        assert f'{name}: best noise on this recording {best[name]["noise"]:.3g}\n' in lines
    assert best['ekf']['rmse_mm'] == plain['ekf']['rmse_mm']


def test_evaluate_what_is_made_worse(run: Run, bag: Path, parameters: Parameters) -> None:
    config = small(parameters)
    plain, *worse = (
        json.loads(run.well('evaluate', bag, '-c', config, '--json', *more.split()))
        for more in (
            '',
            '--drop 0.4',
            '--drop 0.4 --burst 0.1',
            '--gone 3 0.1',
            '--swap 0.5',
            '--gone 3 0.1 --seed 2',
        )
    )
    hold = [found['methods']['hold']['rmse_free_mm'] for found in worse]
    assert min(hold) > plain['methods']['hold']['rmse_free_mm']
    assert len(set(hold)) == len(hold)
    assert all(found['frames'] == plain['frames'] for found in worse)


def test_markers_without_labels(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path
) -> None:
    config = small(parameters)
    bare = sequence(swaying(), tuple(f'Unlabeled {i}' for i in range(6)))
    write_recording(tmp_path / 'bare', Recording(bare))
    plain = json.loads(run.well('evaluate', bag, '-c', config, '--json'))
    hidden = json.loads(run.well('evaluate', bag, '-c', config, '--json', '--unlabelled'))
    found = json.loads(run.well('evaluate', tmp_path / 'bare', '-c', config, '--json'))
    for name in ('hold', 'kf_cv', 'kf_ca', 'ekf'):
        for numbers in (found, hidden):
            # every marker is found, or a mirror image of them all
            assert numbers['methods'][name]['predicted'] == 1.0
            rmse = numbers['methods'][name]['rmse_free_mm']
            assert rmse == pytest.approx(plain['methods'][name]['rmse_free_mm'], rel=1e-3)
    out = run.well('predict', tmp_path / 'bare', '-c', config, '-o', tmp_path / 'x')
    assert '65 frames updated' in out
    copy = read_recording(tmp_path / 'x').markers
    assert copy.labels[6:] == bare.labels
    np.testing.assert_array_equal(copy.positions[:, 6:], np.float32(bare.positions))
    assert not copy.visible[:, :6].any()


def test_evaluate_compares_with_the_truth(
    run: Run, parameters: Parameters, tmp_path: Path
) -> None:
    positions = np.repeat(swaying(1), FRAMES, axis=0)
    ids = np.array([[5, -1, 4, 3], [2, 1, 0, -1]])  # markers anywhere on a larger surface
    surface = np.zeros((FRAMES, 2, 4, 3))
    surface[:, ids >= 0] = positions[:, ids[ids >= 0]] + np.array([0.0, 0.003, 0.004])
    write_recording(tmp_path / 'x', Recording(sequence(positions), Truth(STAMPS, surface, ids)))
    config = small(parameters, labels=['b', 'a', 'c', 'd', 'e', 'f'])
    found = json.loads(run.well('evaluate', tmp_path / 'x', '-c', config, '--json'))
    for name in ('hold', 'kf_cv', 'kf_ca'):
        # the positions are float32, of 0.2 m at most: 1.5e-5 mm
        assert found['methods'][name]['rmse_mm'] == pytest.approx(5.0, abs=1e-4)


def test_labels_choose_and_reorder(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path
) -> None:
    plain = json.loads(run.well('evaluate', bag, '-c', small(parameters), '--json'))
    rng = np.random.default_rng(0)
    order = [4, 0, 5, 2, 1, 3]
    noise = rng.normal(size=(FRAMES, 2, 3))
    mixed = np.concatenate([noise[:, :1], swaying()[:, order], noise[:, 1:]], axis=1)
    labels = ('hand', *(LABELS[i] for i in order), 'Unlabeled 3')
    write_recording(tmp_path / 'mixed', Recording(sequence(mixed, labels)))
    config = small(parameters, labels=list(LABELS))
    found = json.loads(run.well('evaluate', tmp_path / 'mixed', '-c', config, '--json'))
    assert without_times(found) == without_times(plain)
    run.well('predict', tmp_path / 'mixed', '-c', config, '-o', tmp_path / 'x')
    markers = read_recording(tmp_path / 'x').markers
    assert markers.labels == (*LABELS, 'Unlabeled 3')  # which the tracker was given as points
    np.testing.assert_array_equal(markers.positions[:, 6], np.float32(noise[:, 1]))


def test_the_file_in_a_bag_is_a_recording_too(run: Run, bag: Path, parameters: Parameters) -> None:
    config = small(parameters)
    folder, file = (
        json.loads(run.well('evaluate', path, '-c', config, '--json'))
        for path in (bag, bag / 'bag.mcap')
    )
    assert without_times(folder) == without_times(file)


def test_a_rope_from_motive_to_numbers(
    run: Run, real: Callable[[str], Path], tmp_path: Path
) -> None:
    run.well('convert', real('rope/rope_take1.csv'), '-o', tmp_path / 'rope')
    config = ROOT / 'config' / 'rope.yaml'
    out = run.well('evaluate', tmp_path / 'rope', '-c', config, '--horizon', 0.1, '--json')
    found = json.loads(out)
    assert (found['horizon_s'], found['frames']) == (0.1, 390)  # 5 s less 1 s and 0.1 s
    errors = {name: numbers['rmse_free_mm'] for name, numbers in found['methods'].items()}
    assert all(0 < error < errors['hold'] for name, error in errors.items() if name != 'hold')
    assert 20 < errors['hold'] < 80  # mm; the hand moves the rope by some 0.5 m/s


# --- what is wrong is one line ---------------------------------------------------------------

BROKEN = {
    'missing.csv': None,
    'missing': None,
    'missing.mcap': None,
    'empty.csv': '',
    'empty.mcap': '',
    'text.mcap': 'Format Version,1.23\n',
    'text.csv': 'hello\n',
    'text.txt': 'hello\n',
    'cut.csv': MOTIVE[:-6],
    'cell.csv': MOTIVE.replace('2.5', '2;5'),
    'order.csv': MOTIVE.replace('1,0.02', '0,0.00'),
    'inches.csv': MOTIVE.replace('Millimeters', 'Inches'),
    'alone.csv': MOTIVE[: MOTIVE.index('0,0.0')],
}


@pytest.mark.parametrize('name', BROKEN)
@pytest.mark.parametrize('command', ['convert', 'predict', 'evaluate'])
def test_a_recording_that_cannot_be_read(
    run: Run, parameters: Parameters, tmp_path: Path, command: str, name: str
) -> None:
    folder = tmp_path / 'in'
    folder.mkdir()
    path, content = folder / name, BROKEN[name]
    if content is not None:
        path.write_text(content)
    config = [] if command == 'convert' else ['-c', small(parameters)]
    line = run.badly(command, path, '-o', tmp_path / 'x', *config)
    assert line.startswith(f'{path}:')
    assert not (tmp_path / 'x').exists()
    assert list(folder.iterdir()) == ([] if content is None else [path])


def test_folders_that_are_no_bags(run: Run, parameters: Parameters, tmp_path: Path) -> None:
    (tmp_path / 'empty').mkdir()
    config = small(parameters)
    line = run.badly('evaluate', tmp_path / 'empty', '-c', config)
    assert line == f'{tmp_path / "empty"}: no bag is there'
    with create_bag(tmp_path / 'other') as bag:
        bag.cloud('/points', 0, 'f', np.zeros(1, MARKERS))
    line = run.badly('evaluate', tmp_path / 'other', '-c', config)
    assert line == f'{tmp_path / "other"}: no topic markers (topics: /points)'


def test_a_bag_cut_short(run: Run, bag: Path, parameters: Parameters) -> None:
    content = (bag / 'bag.mcap').read_bytes()
    (bag / 'bag.mcap').write_bytes(content[: len(content) // 2])
    for path in (bag, bag / 'bag.mcap'):
        line = run.badly('evaluate', path, '-c', small(parameters))
        assert line.startswith(f'{path}: not a readable rosbag2 recording: ')


@pytest.mark.parametrize(
    ('values', 'expected'),
    [
        ({'horizonn': 1}, 'horizonn: unknown parameter (did you mean horizon?)'),
        ({'model': {'rows': 2.5}}, 'model.rows: expected int, got 2.5'),
        ({'filter': {'max_gap': -1}}, 'filter.max_gap: -1 is out of range, must be above 0'),
        ({'anchors': {'nodes': [99]}}, 'anchors.nodes: node 99 does not exist, model.rows x '
         'model.cols has 6 nodes'),
    ],
)  # fmt: skip
@pytest.mark.parametrize('command', ['predict', 'evaluate'])
def test_a_wrong_parameter(
    run: Run,
    bag: Path,
    parameters: Parameters,
    tmp_path: Path,
    command: str,
    values: dict[str, Any],
    expected: str,
) -> None:
    config = small(parameters, **values)
    line = run.badly(command, bag, '-c', config, '-o', tmp_path / 'x')
    assert line == f'{config}: {expected}'
    assert not (tmp_path / 'x').exists()


def test_a_parameter_file_that_cannot_be_read(run: Run, bag: Path, tmp_path: Path) -> None:
    missing, broken = tmp_path / 'none.yaml', tmp_path / 'broken.yaml'
    broken.write_text('{')
    assert run.badly('evaluate', bag, '-c', missing) == f'{missing}: No such file or directory'
    assert run.badly('evaluate', bag, '-c', broken).startswith(f'{broken}: not YAML: ')
    assert run.badly('evaluate', bag, '-c', tmp_path) == f'{tmp_path}: Is a directory'


@pytest.mark.parametrize('command', ['predict', 'evaluate'])
def test_sizes_that_do_not_fit(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path, command: str
) -> None:
    config = parameters(model={'rows': 5, 'cols': 4})
    line = run.badly(command, bag, '-c', config, '-o', tmp_path / 'x')
    assert line == (
        f'{bag}: 6 markers (a, b, c, d, ... f) do not fit model.rows x model.cols = 5 x 4 = 20 '
        'nodes; choose the markers with the parameter labels'
    )
    assert not (tmp_path / 'x').exists()


def test_labels_that_do_not_fit(run: Run, bag: Path, parameters: Parameters) -> None:
    config = small(parameters, labels=['a', 'b', 'c', 'd', 'e', 'g'])
    line = run.badly('evaluate', bag, '-c', config)
    assert line == f"{bag}: no marker 'g' (there are a, b, c, d, ... f)"
    config = small(parameters, labels=['b', 'a'])
    line = run.badly('evaluate', bag, '-c', config)
    assert line == f'{config}: labels: 2 labels, but model.rows x model.cols has 6 nodes'
    config = small(parameters, labels=['a', 'b', 'c', 'd', 'e', 'a'])
    assert 'labels' in run.badly('evaluate', bag, '-c', config)


def test_a_recording_too_short_to_be_judged(
    run: Run, parameters: Parameters, tmp_path: Path
) -> None:
    write_recording(tmp_path / 'x', Recording(sequence(swaying(30))))
    line = run.badly('evaluate', tmp_path / 'x', '-c', small(parameters))
    assert 'no frame can be judged: the recording lasts 0.58 s' in line
    assert line.startswith(f'{tmp_path / "x"}: ')


@pytest.mark.parametrize('command', ['simulate', 'convert', 'predict'])
def test_what_others_made_is_not_overwritten(
    run: Run, bag: Path, take: Path, parameters: Parameters, tmp_path: Path, command: str
) -> None:
    notes = tmp_path / 'folder' / 'notes.txt'
    notes.parent.mkdir()
    notes.write_text('precious')
    arguments = {
        'simulate': ['towel_fan', '--duration', 0.01],
        'convert': [take],
        'predict': [bag, '-c', small(parameters)],
    }
    for path in (notes, notes.parent):
        line = run.badly(command, *arguments[command], '-o', path)
        assert line == f'{path}: exists and was not made by cloth-predict; not overwritten'
    line = run.badly(command, *arguments[command], '-o', notes / 'x')
    assert line == f'{notes / "x"}: cannot be written: Not a directory'
    assert notes.read_text() == 'precious'
    assert list(notes.parent.iterdir()) == [notes]


def test_a_report_that_cannot_be_written(
    run: Run, bag: Path, parameters: Parameters, tmp_path: Path
) -> None:
    notes = tmp_path / 'notes.txt'
    notes.write_text('precious')
    for path in (notes, notes / 'x'):
        assert run.badly('evaluate', bag, '-c', small(parameters), '-o', path).startswith(
            f'{path}: '
        )
    assert notes.read_text() == 'precious'


@pytest.mark.parametrize(('frame', 'time'), [('-1', '-0.020000'), ('0', '3000000000.0')])
def test_a_time_that_ros_cannot_hold(run: Run, tmp_path: Path, frame: str, time: str) -> None:
    path = tmp_path / 'take.csv'
    rows = MOTIVE.replace('0,0.000000', f'{frame},{time}')
    path.write_text(rows if time.startswith('-') else rows[: rows.index('1,0.02')])
    assert run.badly('convert', path, '-o', tmp_path / 'x')
    assert list(tmp_path.iterdir()) == [path]


def test_a_name_too_long_for_any_file(run: Run, bag: Path, parameters: Parameters) -> None:
    path = bag.parent / ('x' * 300)
    assert run.badly('evaluate', path, '-c', small(parameters)).startswith(f'{path}: ')
    assert run.badly('convert', bag, '-o', path).startswith(f'{path}: ')


# --- usage -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'line',
    [
        '',
        'bogus',
        'simulate',
        'simulate towel_fan',
        'simulate curtain -o x',
        'simulate towel_fan -o x --seed -1',
        'simulate towel_fan -o x --seed 1.5',
        'simulate towel_fan -o x --duration 0',
        'simulate towel_fan -o x --duration nan',
        'simulate towel_fan -o x --duration inf',
        'convert x',
        'convert -o x',
        'predict x -o x',
        'predict x -c x',
        'evaluate x',
        'evaluate x -c x --horizon',
        'evaluate x -c x --horizon 0',
        'evaluate x -c x --horizon 0.1 -0.1',
        'evaluate x -c x --horizon soon',
        'evaluate x -c x --yaml',
        'evaluate -c x',
        'evaluate x -c x --filters kalman',
        'evaluate x -c x --drop 1.5',
        'evaluate x -c x --burst 0.1',
        'evaluate x -c x --gone 3',
        'evaluate x -c x --gone 3 0',
        'evaluate x -c x --gone -3 0.5',
        'evaluate x -c x --swap no',
    ],
)
def test_wrong_usage(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*line.split())
    assert (code, out) == (2, '')
    assert err.startswith('usage: cloth-predict')
    assert 'error: ' in err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_help_and_version(run: Run) -> None:
    assert run.well('--version') == f'{__version__}\n'
    text = run.well('--help')
    commands = re.findall(r'^    (\w\S+) ', text, re.MULTILINE)
    assert {'demo', 'evaluate', 'reproduce', 'overlay'} <= set(commands)
    for command in commands:
        assert run.well(command, '--help').startswith(f'usage: cloth-predict {command}')


def test_an_interrupt_is_no_traceback(
    run: Run, take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, 'write_recording', interrupted)
    assert run('convert', take, '-o', tmp_path / 'x') == (130, '', '')


# --- in a process of its own -----------------------------------------------------------------


def process(*arguments: object, timeout: float = 60) -> Result:
    command = [sys.executable, '-m', 'cloth_predict.cli', *map(str, arguments)]
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, env=environment, check=False
    )
    return Result(done.returncode, done.stdout, done.stderr)


def test_json_is_all_that_a_process_prints(bag: Path, parameters: Parameters) -> None:
    code, out, err = process('evaluate', bag, '-c', small(parameters), '--json')
    assert (code, err) == (0, '')
    assert list(json.loads(out)['methods']) == ['hold', 'kf_cv', 'kf_ca', 'ekf']


def test_a_process_fails_with_one_line(tmp_path: Path) -> None:
    path = tmp_path / 'none.csv'
    expected = f'cloth-predict: {path}: no such file or folder\n'
    assert process('convert', path, '-o', tmp_path / 'x') == (1, '', expected)


@pytest.mark.parametrize('horizon', ['1e6', '1e300'])
def test_a_horizon_beyond_any_recording(bag: Path, parameters: Parameters, horizon: str) -> None:
    # ten times what the start of a process takes: it must not run the model that far
    arguments = ['evaluate', bag, '-c', small(parameters), '--horizon', horizon]
    code, out, err = process(*arguments, timeout=15)
    assert code in (1, 2)
    assert out == ''
    assert 'Traceback' not in err
    assert 'horizon' in err or 'no frame can be judged' in err
