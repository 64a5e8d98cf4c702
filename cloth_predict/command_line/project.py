"""The command `project`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cloth_predict import commands
from cloth_predict.command_line.options import Add, counted, delay, progress_bar, rate
from cloth_predict.evaluation import projection_report


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'project', _project, 'light a recording and tell where the light lands on the surface'
    )
    parser.add('bag', type=Path, help='recording')
    parser.config().json()
    parser.add(
        '--delay',
        type=delay,
        default=0.05,
        metavar='S',
        help='from the capture of the markers to the start of the frame; default 0.05',
    )
    parser.add('--fps', type=rate, metavar='HZ', help='frames per second; default: projector.fps')
    parser.add('-o', '--output', type=Path, help='folder for table, figures and configuration')


def _project(options: argparse.Namespace) -> None:
    with progress_bar('project', 'frame')(0) as bar:
        found = commands.project(
            options.bag,
            options.config,
            options.delay,
            options.fps,
            options.output,
            counted(bar),
        )
    if options.json:
        print(json.dumps(projection_report.summary(found)))
    else:
        print(projection_report.text(found))
