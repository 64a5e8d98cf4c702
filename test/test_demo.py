"""The demo: three processes, a recorder, a report."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cloth_predict.formats.bag import Recording, read_clouds, read_recording, write_recording
from cloth_predict.types import MarkerSequence

ROOT = Path(__file__).parents[1]


def demo(*arguments):
    return subprocess.run(
        [sys.executable, '-m', 'cloth_predict.cli', 'demo', *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope='module')
def short(tmp_path_factory):
    """The first 2 s of the shipped recording."""
    markers = read_recording(ROOT / 'bags' / 'towel_fan').markers
    path = tmp_path_factory.mktemp('demo') / 'short'
    part = slice(0, 201)
    cut = MarkerSequence(
        markers.stamps[part], markers.labels, markers.positions[part], markers.visible[part]
    )
    write_recording(path, Recording(cut))
    return path


@pytest.fixture(scope='module')
def result(short):
    output = short.parent / 'out'
    ended = demo('--json', '--bag', str(short), '-o', str(output))
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout), output


def test_numbers(result):
    numbers, _ = result
    assert numbers['horizon_s'] == 0.1
    assert set(numbers['methods']) == {'hold', 'kf_cv', 'kf_ca', 'ekf', 'ekf_live'}
    assert numbers['frames_published'] == 201
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
def test_bad_input_is_one_line(arguments, words, tmp_path):
    ended = demo(*arguments, '-o', str(tmp_path / 'out'))
    assert (ended.returncode, ended.stdout) == (1, '')
    assert len(ended.stderr.strip().splitlines()) == 1
    assert words in ended.stderr
