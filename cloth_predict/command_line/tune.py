"""The command `tune`."""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path

from cloth_predict.command_line.options import (
    Add,
    best_so_far,
    count,
    progress_bar,
)
from cloth_predict.errors import ClothPredictWarning
from cloth_predict.identification.tuning.search import METHODS, TRIALS
from cloth_predict.identification.tuning.tuned import Settings, tune


def add(command: Add) -> None:
    """Add the command."""
    parser = command('tune', _tune, 'find the noise of the filter from recordings')
    parser.add('bag', type=Path, nargs='+', help='recording; of several the scores are pooled')
    parser.config().json()
    parser.add('-o', '--output', type=Path, required=True, help='parameter file to write')
    parser.add(
        '--method',
        choices=METHODS,
        default='horizon',
        help='make errors ahead small (default) or the measurements most likely, by Optuna; or '
        'the former by a sweep over decades, one parameter after the other (grid)',
    )
    parser.held_out()
    parser.horizon()
    parser.add(
        '--trials',
        type=count,
        metavar='N',
        help=f'most trials; default {TRIALS}, of the grid all',
    )
    parser.add(
        '--storage',
        metavar='URL',
        help='of Optuna, or a file: keeps the study, to go on with or to share between machines',
    )
    parser.add('--study', default='tune', metavar='NAME', help='name of the study in the storage')
    parser.searches()


def _tune(options: argparse.Namespace) -> None:
    if options.storage and options.method == 'grid':
        options.usage('--storage needs --method likelihood or horizon, which are of Optuna')
    settings = Settings(
        options.method,
        options.horizon,
        options.trials,
        options.jobs,
        options.seed,
        options.storage,
        options.study,
    )
    unit = 'nats' if options.method == 'likelihood' else 'mm'
    with progress_bar('tune', 'trial')(0) as bar:
        found = tune(
            options.bag,
            options.config,
            options.output,
            options.held_out,
            settings,
            best_so_far(bar, unit),
        )
    print(json.dumps(found.summary()) if options.json else f'{found.text()}\n{options.output}')
    for caution in found.cautions:
        warnings.warn(caution, ClothPredictWarning, stacklevel=2)
    if found.search.interrupted:
        raise KeyboardInterrupt
