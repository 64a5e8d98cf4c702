"""The command `identify`."""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path

from cloth_predict.command_line.options import (
    Add,
    best_so_far,
    count,
    positive,
    progress_bar,
)
from cloth_predict.config import load
from cloth_predict.errors import ClothPredictWarning
from cloth_predict.identification.identified import Identified, Outputs
from cloth_predict.identification.identify import identify
from cloth_predict.identification.optimisers.family import BUDGETS, OPTIMISERS, Method
from cloth_predict.identification.optimisers.study import StudyFile
from cloth_predict.identification.task import ALPHA, USUAL, WINDOW, Task


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'identify', _identify, 'find springs, dampers, masses and forces from recordings'
    )
    parser.add('bag', type=Path, nargs='+', help='recording; of several the costs add up')
    parser.config().json()
    parser.add(
        '-o', '--output', type=Path, required=True, help='parameter file to write, or a folder'
    )
    parser.held_out()
    parser.add(
        '--objective',
        choices=sorted(USUAL),
        default='horizon',
        help='error of predictions (default), or of the model left to itself',
    )
    parser.add(
        '--parameters',
        nargs='+',
        default=[],
        metavar='NAME',
        help='parameters to find, such as model.damping; default: those that are switched on',
    )
    parser.add('--per-spring', action='store_true', help='find a value for each spring and damper')
    parser.add(
        '--optimiser',
        choices=sorted(OPTIMISERS),
        help='default: cma, or gradient for trajectories',
    )
    parser.add(
        '--budget',
        type=count,
        metavar='N',
        help='most evaluations of the cost; default: '
        + ', '.join(f'{name} {most}' for name, most in BUDGETS.items()),
    )
    parser.horizon()
    parser.add(
        '--alpha',
        type=float,
        default=ALPHA,
        metavar='A',
        help=f'trajectory: weight exp(A t) of the time since the start; default {ALPHA:g}',
    )
    parser.add(
        '--window',
        type=positive,
        default=WINDOW,
        metavar='S',
        help=f'trajectory: how long the model is left to itself; default {WINDOW:g}',
    )
    parser.searches().resume()


def _identify(options: argparse.Namespace) -> None:
    if options.objective == 'horizon' and options.optimiser == 'gradient':
        options.usage('--optimiser gradient needs --objective trajectory')
    config = load(options.config)
    task = Task(
        config,
        options.objective,
        tuple(options.parameters),
        options.per_spring,
        options.alpha,
        options.window,
        config.horizon if options.horizon is None else options.horizon,
    )
    optimiser = options.optimiser or USUAL[options.objective]
    budget = options.budget or BUDGETS[optimiser]
    file = StudyFile.beside(Outputs.at(options.output).configuration, options.resume)
    method = Method(optimiser, budget, options.seed, file)
    with progress_bar('identify', 'evaluation')(0) as bar:
        show = best_so_far(bar, 'mm')
        found = identify(
            options.bag, options.output, task, method, options.jobs, options.held_out, show
        )
    print(json.dumps(found.summary()) if options.json else _text(found, options.output))
    if found.caution:
        warnings.warn(found.caution, ClothPredictWarning, stacklevel=2)
    if found.result.interrupted:
        raise KeyboardInterrupt


def _text(found: Identified, output: Path) -> str:
    return f'{found.text()}\n{Outputs.at(output).configuration}: written'
