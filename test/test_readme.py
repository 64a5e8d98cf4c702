"""What the README tells its readers to type, typed."""

import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cloth_predict import cli
from cloth_predict.formats.bag import read_recording

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / 'README.md').read_text()


def block(language):
    found = re.findall(rf'^ *```{language}\n(.*?)^ *```', TEXT, re.MULTILINE | re.DOTALL)
    return [line.split('  #')[0].strip() for text in found for line in text.splitlines()]


COMMANDS = [line for line in block('sh') if line.startswith('cloth-predict')]
ELSEWHERE = ('make demo', 'make test', 'pip install', 'colcon build', 'source', 'ros2 ')
"""Run by CI, or checked by test_package.py against what colcon installs."""


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A reader's folder: the package's files, a take and a configuration of their own."""
    path = tmp_path_factory.mktemp('reader')
    for name in ('config', 'bags'):
        shutil.copytree(ROOT / name, path / name)
    shutil.copy(ROOT / 'config' / 'towel.yaml', path / 'my_surface.yaml')
    markers = read_recording(ROOT / 'bags' / 'towel_fan').markers
    write_motive_csv(path / 'my_take.csv', markers.positions[:250])
    command = path / 'bin' / 'cloth-predict'
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m cloth_predict.cli "$@"\n')
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    return path


def write_motive_csv(path, positions):
    count = positions.shape[1]
    names = [f'Towel:Marker{i + 1}' for i in range(count) for _ in 'XYZ']
    lines = [
        'Format Version,1.23,Export Frame Rate,100.0,Length Units,Meters',
        '',
        ',Type,' + ','.join(['Marker'] * len(names)),
        ',Name,' + ','.join(names),
        ',ID,' + ','.join(names),
        ',,' + ','.join(['Position'] * len(names)),
        'Frame,Time (Seconds),' + ','.join('XYZ' * count),
    ]
    for k, row in enumerate(positions.reshape(len(positions), -1)):
        cells = ['' if np.isnan(v) else f'{v:.6f}' for v in row]
        lines.append(f'{k},{k / 100:.6f},' + ','.join(cells))
    path.write_text('\n'.join(lines) + '\n')


def test_every_command_is_tested():
    others = [line for line in block('sh') if line and line not in COMMANDS]
    assert len(COMMANDS) >= 6
    assert all(line.startswith(ELSEWHERE) for line in others), others


@pytest.mark.parametrize('command', COMMANDS)
def test_command(command, folder):
    environment = os.environ | {
        'PATH': f'{folder / "bin"}:{os.environ["PATH"]}',
        'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}',
    }
    ended = subprocess.run(
        shlex.split(command),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip()


@pytest.mark.parametrize('command', re.findall(r'`(cloth-predict [a-z]+ [^`]+)`', TEXT))
def test_command_that_takes_minutes_has_options_that_there_are(command):
    options = cli._parser().parse_args(shlex.split(command)[1:])
    assert options.call.__name__ == f'_{command.split()[1]}'


def test_table_of_errors_is_what_evaluate_finds(folder):
    found = {}
    for line in (folder / 'out' / 'evaluate' / 'table_100ms.txt').read_text().splitlines()[2:]:
        name, *numbers = line.split()
        found[name] = [float(number) for number in numbers[:4]]
    assert list(table(4)) == list(found)
    for name, numbers in table(4).items():
        assert numbers == pytest.approx(found[name], abs=0.06), name  # one digit is printed


def table(columns):
    """Numbers of each method in the table with so many columns of them."""
    told = re.findall(r'^\| `(\w+)`: [^|]*\|([^\n]*)\|$', TEXT, re.MULTILINE)
    rows = {name: cells.replace('%', '').split('|') for name, cells in told}
    return {n: [float(cell) for cell in row] for n, row in rows.items() if len(row) == columns}


def test_table_of_misregistration_is_what_project_finds(folder):
    file = folder / 'out' / 'project' / 'projection.json'
    found = json.loads(file.read_text())['methods']
    assert list(table(3)) == list(found)
    for name, (p50, p95, under) in table(3).items():
        told = found[name]
        assert [p50, p95] == pytest.approx([told['p50_mm'], told['p95_mm']], abs=0.06), name
        assert under == pytest.approx(100 * told['under_jnd'], abs=0.6), name  # without digits


def test_python_example(monkeypatch):
    monkeypatch.chdir(ROOT)
    space = {}
    exec('\n'.join(re.findall(r'```python\n(.*?)```', TEXT, re.DOTALL)), space)
    truth = read_recording(ROOT / 'bags' / 'towel_fan').truth
    assert space['ahead'].stamp == int(truth.stamps[-1]) + 100_000_000
    moved = space['ahead'].position - space['positions']
    assert np.nanmax(np.abs(moved)) < 0.3  # m; the towel is not far away 0.1 s later


def test_linked_files_exist():
    links = re.findall(r'\]\(((?!http)[^)]+)\)', TEXT)
    assert len(links) >= 5
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_parameters_page_is_that_of_the_dataclasses():
    made = subprocess.run(
        [sys.executable, 'docs/make_parameters.py'],
        cwd=ROOT,
        env=os.environ | {'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (ROOT / 'docs' / 'parameters.md').read_text() == made.stdout
