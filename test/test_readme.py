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
from recordings import beginning, shipped

from cloth_predict import cli
from cloth_predict.formats.bag import write_recording

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / 'README.md').read_text()


def block(language):
    found = re.findall(rf'^ *```{language}\n(.*?)^ *```', TEXT, re.MULTILINE | re.DOTALL)
    return [line.split('  #')[0].strip() for text in found for line in text.splitlines()]


COMMANDS = [line for line in block('sh') if line.startswith('cloth-predict')]
ELSEWHERE = ('make demo', 'make test', 'pip install', 'colcon build', 'source', 'ros2 ')
"""Run by CI, or checked by test_package.py against what colcon installs."""
SHOWN = ('cloth-predict evaluate bags/', 'cloth-predict project ')
"""Commands whose numbers the README shows, which are those of the whole recording."""


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """A reader's folder with the shipped recording."""
    path = folder(tmp_path_factory.mktemp('whole'))
    shutil.copytree(ROOT / 'bags', path / 'bags')
    return path


@pytest.fixture(scope='module')
def brief(tmp_path_factory):
    """A reader's folder with the beginning of the shipped recording in its place."""
    path = folder(tmp_path_factory.mktemp('brief'))
    write_recording(path / 'bags' / 'towel_fan', beginning(201))
    return path


def folder(path):
    """Fill a folder with the package's files, a take and a configuration of the reader's own."""
    shutil.copytree(ROOT / 'config', path / 'config')
    shutil.copy(ROOT / 'config' / 'towel.yaml', path / 'my_surface.yaml')
    write_motive_csv(path / 'my_take.csv', shipped().markers.positions[:150])
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
def test_command(command, whole, brief):
    folder = whole if command.startswith(SHOWN) else brief
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
        timeout=300,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip()


@pytest.mark.parametrize('command', re.findall(r'`(cloth-predict [a-z]+ [^`]+)`', TEXT))
def test_command_that_takes_minutes_has_options_that_there_are(command):
    options = cli._parser().parse_args(shlex.split(command)[1:])
    assert options.call.__name__ == f'_{command.split()[1]}'


def test_table_of_errors_is_what_evaluate_finds(whole):
    found = {}
    for line in (whole / 'out' / 'evaluate' / 'table_100ms.txt').read_text().splitlines()[2:]:
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


def test_table_of_misregistration_is_what_project_finds(whole):
    file = whole / 'out' / 'project' / 'projection.json'
    found = json.loads(file.read_text())['methods']
    assert list(table(3)) == list(found)
    for name, (p50, p95, under) in table(3).items():
        told = found[name]
        assert [p50, p95] == pytest.approx([told['p50_mm'], told['p95_mm']], abs=0.06), name
        assert under == pytest.approx(100 * told['under_jnd'], abs=0.6), name  # without digits


def test_python_example(monkeypatch, brief):
    monkeypatch.chdir(brief)
    space = {}
    exec('\n'.join(re.findall(r'```python\n(.*?)```', TEXT, re.DOTALL)), space)
    assert space['ahead'].stamp == 2_000_000_000 + 100_000_000  # ns; 2 s are there
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
