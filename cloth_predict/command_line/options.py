"""Options, values and progress bars that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cloth_predict.config import Config, ProjectorConfig

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

    def searches(self) -> Command:
        """Add how a search runs."""
        self.add('--jobs', type=count, default=1, metavar='N', help='processes; default 1')
        self.add('--seed', type=whole, default=0, help='of the search; default 0')
        return self

    def resume(self) -> Command:
        """Add a search to go on with."""
        text = 'study to go on with (NAME.study.jsonl)'
        self.add('--resume', type=Path, metavar='FILE', help=text)
        return self

    def held_out(self) -> Command:
        """Add recordings to judge a result on."""
        self.add(
            '--held-out',
            type=Path,
            nargs='+',
            default=[],
            metavar='BAG',
            help='recordings on which the result is judged, and nothing is found',
        )
        return self

    def horizon(self, **several: Any) -> Command:
        """Add how far ahead to predict; several: of `add`, where there may be more than one."""
        self.add(
            '--horizon',
            type=horizon,
            metavar='S',
            help='how far ahead to predict, in seconds; default: the configured one',
            **several,
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
    return _allowed(text, 's', Config, 'horizon')


def delay(text: str) -> float:
    """Return a time that may be 0 [s]."""
    value = float(text)
    if not 0 <= value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} s is no delay: it is 0 or more')
    return value


def rate(text: str) -> float:
    """Return frames per second [Hz]."""
    return _allowed(text, 'Hz', ProjectorConfig, 'fps')


def _allowed(text: str, unit: str, group: type, parameter: str) -> float:
    """Return a positive number up to the most that a parameter of the configuration may be."""
    value = positive(text)
    most = next(field.metadata['high'] for field in fields(group) if field.name == parameter)
    if value > most:
        raise argparse.ArgumentTypeError(f'{text} {unit} is more than {most:g} {unit}')
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
