"""The command `reproduce`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cloth_predict.command_line.options import Add, progress_bar
from cloth_predict.errors import ConfigError
from cloth_predict.experiments.rows import Scope
from cloth_predict.experiments.works import WORKS, reproduce, table
from cloth_predict.formats.files import make_folder


def add(command: Add) -> None:
    """Add the command."""
    names = '; '.join(
        f'{work}: ' + ', '.join(experiment.name for experiment in experiments)
        for work, experiments in WORKS.items()
    )
    parser = command('reproduce', _reproduce, 'repeat the experiments of a work, and compare')
    parser.add('work', choices=sorted(WORKS))
    parser.add(
        '--only',
        nargs='+',
        default=[],
        metavar='FIGURE',
        # argparse takes % for the start of a placeholder
        help=f'figures such as 6.6, or chapters; there are {names}'.replace('%', '%%'),
    )
    parser.add(
        '--quick', action='store_true', help='shorter runs and fewer iterations: some minutes'
    )
    parser.add(
        '--data',
        type=Path,
        metavar='DIR',
        help='folder of real recordings, with rope/rope_take4.csv; without it, no row of the rope',
    )
    parser.add('-o', '--output', type=Path, required=True, help='folder for the table and figures')
    parser.json()


def _reproduce(options: argparse.Namespace) -> None:
    if options.data is not None and not options.data.is_dir():
        raise ConfigError(f'--data {options.data}: no such folder')
    make_folder(options.output)
    scope = Scope(options.output, options.quick, options.data)
    with progress_bar('reproduce', 'row')(1.0) as bar:
        bar.bar_format = '{desc}: {percentage:3.0f}%|{bar}| {elapsed}<{remaining}'

        def show(name: str, share: float) -> None:
            bar.set_description_str(f'figures {name}', refresh=False)
            bar.update(share)

        rows = reproduce(options.work, scope, options.only, show)
    if options.json:
        print(json.dumps([row.summary() for row in rows]))
        return
    print(table(rows).split('\n![')[0].rstrip())
    print(
        f'{options.output}: table.md, table.json and {sum(len(r.pictures) for r in rows)} figures'
    )
