"""The command `compress`."""

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
from cloth_predict.errors import ClothPredictError, ClothPredictWarning
from cloth_predict.formats.files import make_folder
from cloth_predict.identification.compression import report
from cloth_predict.identification.compression.falling import DURATION, RELEASES
from cloth_predict.identification.compression.modal import Rival, rivals
from cloth_predict.identification.compression.search import USUAL, Compression, judged, searched
from cloth_predict.identification.compression.task import THESIS, Grid, Task
from cloth_predict.identification.optimisers.family import OPTIMISERS, Method
from cloth_predict.identification.optimisers.study import StudyFile
from cloth_predict.identification.provenance import check_output, write_configuration
from cloth_predict.identification.task import ALPHA


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'compress', _compress, 'find a coarse sheet that falls and swings as a dense one does'
    )
    known = '; '.join(f'{name}: {release.text}' for name, release in RELEASES.items())
    grids = (('--from', 'source', 'dense sheet', '21x21'), ('--to', 'target', 'coarse one', '5x5'))
    for option, name, what, usual in grids:
        text = f'rows and columns of nodes of the {what}; default {usual}'
        parser.add(option, dest=name, type=grid, default=grid(usual), metavar='RxC', help=text)
    parser.add(
        '-c',
        '--config',
        type=Path,
        help='size, mass, springs and dampers of the dense sheet, settings of the filter; '
        'default: the sheet of Gomes 2016, section 3.3',
    )
    parser.json().add('-o', '--output', type=Path, required=True, help='parameter file to write')
    parser.add(
        '--scenarios',
        nargs='+',
        default=['falling', 'raised'],
        choices=RELEASES,
        metavar='NAME',
        help=f'how the sheet is let go, to train on; default falling raised. {known}',
    )
    parser.add(
        '--held-out',
        nargs='*',
        choices=RELEASES,
        metavar='NAME',
        help='on which the result is judged only; default: all others',
    )
    parser.add(
        '--optimiser',
        choices=sorted(OPTIMISERS),
        default=USUAL.optimiser,
        help=f'default: {USUAL.optimiser}',
    )
    parser.add(
        '--budget',
        type=count,
        default=USUAL.budget,
        metavar='N',
        help=f'most evaluations of the model; default {USUAL.budget}',
    )
    parser.add(
        '--alpha',
        type=float,
        default=ALPHA,
        metavar='A',
        help=f'weight exp(A t) of the time since the start; default {ALPHA:g}; -1 lets the first '
        'second count most, which serves predictions',
    )
    parser.add('--no-loads', action='store_true', help='no factor of gravity for each node')
    parser.add(
        '--duration',
        type=positive,
        default=DURATION,
        metavar='S',
        help=f'length of each scenario in seconds; default {DURATION:g}',
    )
    parser.searches().resume()
    parser.add(
        '--report',
        type=Path,
        metavar='FOLDER',
        help='tables and pictures, and a comparison with modal reduction, which takes minutes',
    )


def grid(text: str) -> Grid:
    """Return rows and columns, written as 21x21."""
    try:
        rows, cols = map(int, text.lower().split('x'))
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text} is no grid such as 21x21') from None
    return rows, cols


def _compress(options: argparse.Namespace) -> None:
    others = tuple(name for name in RELEASES if name not in options.scenarios)
    task = Task(
        options.source,
        options.target,
        tuple(options.scenarios),
        others if options.held_out is None else tuple(options.held_out),
        THESIS if options.config is None else load(options.config),
        options.duration,
        options.alpha,
        not options.no_loads,
    )
    check_output(options.output)
    if options.report is not None:
        make_folder(options.report)
    file = StudyFile.beside(options.output, options.resume)
    method = Method(options.optimiser, options.budget, options.seed, file)
    with progress_bar('compress', 'evaluation')(options.budget) as bar:
        show = best_so_far(bar, 'm^2')
        found = searched(
            task, method, options.jobs, lambda done, best: show(done, options.budget, best)
        )
    write_configuration(options.output, report.file(found))  # before what may be cut off
    beside: list[Rival] = []
    if not found.result.interrupted:
        found = judged(found)
        write_configuration(options.output, report.file(found))
        if options.report is not None:
            beside = _beside(found)
            report.write(found, beside, options.report)
    if options.json:
        print(json.dumps(report.summary(found, beside)))
    else:
        print(f'{report.text(found, beside)}\n{options.output}: written')
    if found.result.interrupted:
        raise KeyboardInterrupt


def _beside(found: Compression) -> list[Rival]:
    """Measure what else the sheet could be reduced to; a warning where that cannot be."""
    try:
        with progress_bar('compare', 'model')(0) as bar:
            return rivals(found, lambda _: bar.update())
    except ClothPredictError as error:
        warnings.warn(str(error), ClothPredictWarning, stacklevel=2)
        return []
