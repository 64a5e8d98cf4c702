"""The demo: three processes, a recorder, a report."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from recordings import beginning

from cloth_predict import cli
from cloth_predict.config import dump, load
from cloth_predict.formats.bag import read_clouds, write_recording

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope='module')
def result(tmp_path_factory):
    """What the demo tells of 1.5 s, at half the speed: a busy machine too has the time."""
    folder, config = tmp_path_factory.mktemp('demo'), load(ROOT / 'config' / 'towel.yaml')
    bag, slow, output = folder / 'bag', folder / 'slow.yaml', folder / 'out'
    write_recording(bag, beginning(151))
    slow.write_text(dump(replace(config, replay=replace(config.replay, rate=0.5))))
    command = [sys.executable, '-m', 'cloth_predict.cli', 'demo', '--json']
    ended = subprocess.run(
        [*command, '--bag', str(bag), '-c', str(slow), '-o', str(output)],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout), output


def test_numbers(result):
    numbers, _ = result
    assert numbers['horizon_s'] == 0.1
    assert set(numbers['methods']) == {'hold', 'kf_cv', 'kf_ca', 'ekf', 'ekf_live'}
    assert numbers['frames_published'] == 151
    assert set(numbers['latency_ms']) == {'p50', 'p99'}
    assert 0 < numbers['latency_ms']['p50'] <= numbers['latency_ms']['p99']


def test_live_graph_predicts_as_the_filter_does_offline(result):
    numbers, _ = result
    if numbers['frames_predicted'] < numbers['frames_published']:
        pytest.skip('this machine was too busy for every frame, so the filters differ')
    live, offline = numbers['methods']['ekf_live'], numbers['methods']['ekf']
    for name in ('rmse_mm', 'rmse_free_mm', 'p95_mm', 'max_mm'):
        assert live[name] == pytest.approx(offline[name], abs=1e-3)  # float32 on the wire


def test_recording_and_pictures(result):
    numbers, output = result
    for topic, count in (
        ('markers', numbers['frames_published']),
        ('cloth/prediction', numbers['frames_predicted']),
        ('projector/scanlines', numbers['scanline_messages']),
    ):
        assert len(read_clouds(output, topic)) == count
    for picture in ('error.png', 'snapshots.png'):
        assert (output / picture).read_bytes()[:8] == b'\x89PNG\r\n\x1a\n'
    assert (output / 'table.txt').read_text().count('\n') >= 6


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--bag', 'nowhere'], 'nowhere: no such file or folder'),
        (['-c', 'config/rope.yaml'], '20 markers'),
        (['-c', 'nowhere.yaml'], 'nowhere.yaml'),
    ],
)
def test_bad_input_is_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    assert cli.main(['demo', *arguments, '-o', str(tmp_path / 'out')]) == 1
    out, err = capsys.readouterr()
    assert out == ''
    assert len(err.strip().splitlines()) == 1
    assert words in err
