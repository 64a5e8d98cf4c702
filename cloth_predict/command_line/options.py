"""Options, values and progress bars that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cloth_predict.config import Config, ProjectorConfig
from cloth_predict.projection.calibration import COUNTS
from cloth_predict.projection.pinhole import MIRRORS

Add = Callable[[str, Callable[[argparse.Namespace], None], str], 'Command']
"""Adds a command: its name, what it does, and the same in words."""


class Command:
    """Options that several commands share."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.add = parser.add_argument

    def config(self, default: Path | None = None) -> Command:
        """Add the parameter file."""
        self.add(
            '-c',
            '--config',
            type=Path,
            default=default,
            required=default is None,
            help='parameter file (YAML)',
        )
        return self

    def json(self) -> Command:
        """Add output for programs."""
        self.add('--json', action='store_true', help='print one JSON object and nothing else')
        return self

    def degradation(self) -> Command:
        """Add what makes the recording worse; what it is compared with stays."""
        self.add('--drop', type=share, default=0.0, metavar='SHARE', help='hide samples')
        self.add(
            '--burst', type=positive, default=0.0, metavar='S', help='length of each such gap'
        )
        self.add(
            '--gone',
            nargs=2,
            default=(0, 0.0),
            metavar=('MARKERS', 'S'),
            action=Gone,
            help='hide so many markers for so long, show all for as long, and again',
        )
        self.add(
            '--swap',
            type=share,
            default=0.0,
            metavar='SHARE',
            help='swap two labels in this share of the frames',
        )
        self.add(
            '--unlabelled',
            action='store_true',
            help='take the labels away, but for hold, kf_cv and kf_ca, which need them',
        )
        self.add('--seed', type=whole, default=0, help='of what is hidden, swapped or shuffled')
        return self

    def projector(self) -> Command:
        """Add what a calibration takes."""
        self.add('pairs', type=Path, help='CSV with x, y, z (m, mocap frame) and u, v (pixels)')
        for side in ('width', 'height'):
            text = f'{side} of the frame in pixels'
            self.add(f'--{side}', type=pixels, required=True, metavar='PX', help=text)
        self.add(
            '-o', '--output', type=Path, required=True, help='file to write, of OpenCV (YAML)'
        )
        self.add(
            '--distortion',
            type=int,
            default=0,
            choices=COUNTS,
            help='how many of k1, k2, p1, p2, k3 to fit; default: no lens',
        )
        self.add('--skew', action='store_true', help='fit the skew, too')
        self.add(
            '--throw',
            default='front',
            choices=MIRRORS,
            help='projector.throw with which the pairs were taken; default: front',
        )
        return self

    def output_bag(self) -> Command:
        """Add the bag that is written."""
        self.add('-o', '--output', type=Path, required=True, help='bag to write (a folder)')
        return self


class Gone(argparse.Action):
    """A number of markers and a time in seconds."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option: str | None = None,
    ) -> None:
        """Take both."""
        try:
            namespace.gone = whole(values[0]), positive(values[1])
        except (ValueError, argparse.ArgumentTypeError) as error:
            raise argparse.ArgumentError(self, str(error)) from None


def share(text: str) -> float:
    """Return a share from 0 to 1."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f'{text} is not a share from 0 to 1')
    return value


def positive(text: str) -> float:
    """Return a positive number."""
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a positive number')
    return value


def horizon(text: str) -> float:
    """Return a time that may be predicted ahead [s]."""
    value, most = positive(text), Config.__dataclass_fields__['horizon'].metadata['high']
    if value > most:
        raise argparse.ArgumentTypeError(f'{text} s is more than {most} s')
    return value


def delay(text: str) -> float:
    """Return a time that may be 0 [s]."""
    value = float(text)
    if not 0 <= value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} s is no delay: it is 0 or more')
    return value


def rate(text: str) -> float:
    """Return frames per second [Hz]."""
    value, most = positive(text), ProjectorConfig.__dataclass_fields__['fps'].metadata['high']
    if value > most:
        raise argparse.ArgumentTypeError(f'{text} Hz is more than {most:g} Hz')
    return value


def whole(text: str) -> int:
    """Return a whole number that is not negative."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'{text} is negative')
    return value


def count(text: str) -> int:
    """Return a number of something."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is less than 1')
    return value


def pixels(text: str) -> int:
    """Return a number of pixels."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{text} is not a number of pixels')
    return value


def progress_bar(text: str, unit: str) -> Callable[[float], tqdm]:
    """Progress bar; shows itself only on a terminal."""
    return lambda total: tqdm(total=total, desc=text, unit=unit, disable=None, leave=False)


def counted(bar: tqdm) -> Callable[[int, int], None]:
    """Return what tells a progress bar how much more was done, and of how much."""

    def show(done: int, total: int) -> None:
        bar.total = total
        bar.update(done)

    return show


def best_so_far(bar: tqdm, unit: str) -> Callable[[int, int, float], None]:
    """Return what tells a progress bar how much was done, of how much, and the best cost."""

    def show(done: int, total: int, best: float) -> None:
        bar.total = total
        bar.set_postfix_str(f'best {best:.4g} {unit}', refresh=False)
        bar.update(done - bar.n)

    return show
