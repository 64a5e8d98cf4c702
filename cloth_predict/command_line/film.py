"""The command `film`."""

from __future__ import annotations

import argparse
from pathlib import Path

from cloth_predict.command_line.options import Add, count, delay, positive, share, whole
from cloth_predict.simulation.ruler import ANNEX_A


def add(command: Add) -> None:
    """Add the command."""
    parser = command('film', _film, 'make a video of a sliding bar with known truth')
    parser.add('-o', '--output', type=Path, required=True, help='.mp4 file, or folder of PNGs')
    parser.add(
        '--shot',
        default='3',
        choices=['random', *map(str, ANNEX_A)],
        help='a scenario of Goeller et al. 2015, annex A, or one at random; default 3',
    )
    parser.add('--seed', type=whole, default=0, help='of the noise, and of a random shot')
    parser.add('--fps', type=positive, default=50.0, metavar='HZ')
    parser.add('--size', type=count, nargs=2, default=(960, 540), metavar='PX', help='of a frame')
    parser.add(
        '--noise', type=delay, default=2.0, metavar='LEVELS', help='sigma, of 255 grey levels'
    )
    parser.add(
        '--blur',
        type=share,
        default=0.0,
        metavar='SHARE',
        help='part of the time between frames for which the shutter is open',
    )


def _film(options: argparse.Namespace) -> None:
    from cloth_predict.video.commands import film  # OpenCV, an optional extra
    from cloth_predict.video.generator import Filming

    how = Filming(tuple(options.size), options.fps, options.noise, options.blur)
    frames, config = film(options.output, options.shot, how, options.seed)
    print(f'{options.output}: {frames} frames; {config}: its camera, and the truth')
