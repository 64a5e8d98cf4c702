"""The command `decode`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cloth_predict.command_line.options import Add, counted, progress_bar, rate
from cloth_predict.encoding.recordings import decode
from cloth_predict.errors import FormatError


def add(command: Add) -> None:
    """Add the command."""
    parser = command('decode', _decode, 'rebuild the markers of an encoded recording')
    parser.add('file', type=Path, help='made by `encode`')
    parser.output_bag().json()
    parser.add(
        '--rate',
        type=rate,
        metavar='HZ',
        help='frames per second: the nodes of the surface at and between the frames recorded, by '
        'the model and from the frames before and after',
    )
    parser.add(
        '-c',
        '--config',
        type=Path,
        help='parameter file (YAML) for --rate; default: that of the recording',
    )
    parser.add(
        '--states',
        action='store_true',
        help='write what the filter made of each frame as well (/cloth/estimate)',
    )


def _decode(options: argparse.Namespace) -> None:
    if options.config is not None and options.rate is None:
        options.usage('--config needs --rate: the markers are rebuilt as they were encoded')
    with progress_bar('decode', 'frame')(0) as bar:
        found = decode(
            options.file,
            options.output,
            options.rate,
            options.config,
            options.states,
            counted(bar),
        )
    print(json.dumps(found.summary()) if options.json else f'{options.output}: {found.text()}')
    if found.fault:
        raise FormatError(f'{found.fault}; the {found.recorded} frames before are rebuilt')
