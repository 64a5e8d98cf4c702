"""The command `encode`."""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path

from cloth_predict.command_line.options import Add, counted, positive, progress_bar
from cloth_predict.encoding.recordings import encode
from cloth_predict.errors import ClothPredictWarning


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'encode', _encode, 'keep a recording as its model and what the model did not expect'
    )
    parser.add('bag', type=Path, help='recording, or video of a sliding bar')
    parser.config().json()
    parser.add('-o', '--output', type=Path, required=True, help='file to write (.mcap)')
    parser.add(
        '--max-error-mm',
        type=positive,
        metavar='MM',
        help='how far a rebuilt marker may be from the recorded one; default: three times '
        'filter.measurement_noise, of a video ruler.position_noise',
    )


def _encode(options: argparse.Namespace) -> None:
    bound = None if options.max_error_mm is None else 1e-3 * options.max_error_mm
    with progress_bar('encode', 'frame')(0) as bar:
        found = encode(options.bag, options.config, bound, options.output, counted(bar))
    for fault in found.faults:
        warnings.warn(fault, ClothPredictWarning, stacklevel=2)
    print(json.dumps(found.summary()) if options.json else f'{options.output}: {found.text()}')
