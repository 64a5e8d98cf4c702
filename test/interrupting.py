"""Ctrl-C in the middle of a command that keeps a study."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from cloth_predict import cli


def interrupted(study, lines, *arguments):
    """Press Ctrl-C when a study has so many lines; exit code, output and errors of the command."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'cloth_predict.cli', *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, 'PYTHONPATH': str(Path(cli.__file__).parents[1])},
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not (study.exists() and study.read_text().count('\n') >= lines):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)  # no event tells of a line in a file
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to all processes of the command
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err
