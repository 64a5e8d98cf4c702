"""The command `overlay`."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from cloth_predict.command_line.options import Add, counted, progress_bar, rate
from cloth_predict.errors import ClothPredictWarning


def add(command: Add) -> None:
    """Add the command."""
    parser = command(
        'overlay', _overlay, 'make a video of a recording with its estimate, prediction and forces'
    )
    parser.add('bag', type=Path, help='recording')
    parser.config()
    parser.add('-o', '--output', type=Path, required=True, help='.mp4 file, or folder of PNGs')
    parser.add('--fps', type=rate, default=25.0, metavar='HZ', help='of the video; default 25')
    parser.add(
        '--view',
        type=angle,
        nargs=2,
        metavar=('AZIMUTH', 'ELEVATION'),
        help='direction from which it is seen, in degrees; default: at its broad side',
    )


def angle(text: str) -> float:
    """Return an angle [degrees]."""
    value = float(text)
    if not abs(value) <= 360.0:
        raise argparse.ArgumentTypeError(f'{text} is no angle from -360 to 360 degrees')
    return value


def _overlay(options: argparse.Namespace) -> None:
    from cloth_predict.video.commands import overlay  # OpenCV, an optional extra
    from cloth_predict.video.view import View

    view = None if options.view is None else View(*options.view)
    with progress_bar('overlay', 'frame')(0) as bar:
        count, lack = overlay(
            options.bag, options.config, options.output, options.fps, view, counted(bar)
        )
    if lack:
        warnings.warn(f'{options.bag}: {lack}', ClothPredictWarning, stacklevel=2)
    print(f'{options.output}: {count} frames')
