"""The command `calibrate-projector`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from cloth_predict import commands
from cloth_predict.command_line.options import Add
from cloth_predict.projection import calibration_report
from cloth_predict.projection.calibration import COUNTS
from cloth_predict.projection.pinhole import MIRRORS


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'calibrate-projector',
        _calibrate_projector,
        'fit a projector to pairs of points and pixels',
    )
    parser.add('pairs', type=Path, help='CSV with x, y, z (m, mocap frame) and u, v (pixels)')
    for side in ('width', 'height'):
        text = f'{side} of the frame in pixels'
        parser.add(f'--{side}', type=pixels, required=True, metavar='PX', help=text)
    parser.add('-o', '--output', type=Path, required=True, help='file to write, of OpenCV (YAML)')
    parser.add(
        '--distortion',
        type=int,
        default=0,
        choices=COUNTS,
        help='how many of k1, k2, p1, p2, k3 to fit; default: no lens',
    )
    parser.add('--skew', action='store_true', help='fit the skew, too')
    parser.add(
        '--throw',
        default='front',
        choices=MIRRORS,
        help='projector.throw with which the pairs were taken; default: front',
    )
    parser.json()


def pixels(text: str) -> int:
    """Return a number of pixels."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not a number of pixels')
    return value


def _calibrate_projector(options: argparse.Namespace) -> None:
    calibration, lines = commands.calibrate_projector(
        options.pairs,
        options.output,
        (options.width, options.height),
        options.throw,
        options.distortion,
        options.skew,
    )
    if options.json:
        print(json.dumps(calibration_report.summary(calibration, lines)))
        return
    print(calibration_report.text(calibration, lines))
    print(f'{options.output}: for projector.calibration, with projector.throw: {options.throw}')
