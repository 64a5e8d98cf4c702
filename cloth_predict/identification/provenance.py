"""Where a configuration comes from: what was searched, on what, and how well it did."""

from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping
from dataclasses import asdict
from errno import EISDIR
from os import strerror
from pathlib import Path
from textwrap import TextWrapper

from cloth_predict import __version__
from cloth_predict.config import Config, dump, flatten
from cloth_predict.formats.files import writing
from cloth_predict.types import MarkerSequence

TRAINED, HELD_OUT = 'recordings', 'held out'
"""On what a configuration is judged."""
APART = ('replay', 'projector', 'live_check', 'baseline', 'horizon', 'horizons', 'horizon_mode')
"""What of a configuration has no say in how well the filter does."""
WIDTH = 96
"""Characters of a comment's line."""


def content_hash(markers: MarkerSequence) -> str:
    """Return 16 hexadecimal digits that tell recordings apart by what they hold, not by name."""
    found = hashlib.sha256(repr((markers.labels, len(markers))).encode())
    for values in (markers.stamps, markers.visible, markers.positions):
        found.update(values.tobytes())
    return found.hexdigest()[:16]


def kept(config: Config, searched: Container[str]) -> dict[str, str]:
    """Parameters that a search leaves alone, but on which its results depend."""
    return {
        name: str(value)
        for name, value in flatten(asdict(config)).items()
        if name.split('.')[0] not in APART and name not in searched
    }


def with_provenance(config: Config, title: str, notes: Mapping[str, str]) -> str:
    """Return a parameter file that begins with comments: a title, and one note under each name."""
    whole = TextWrapper(
        WIDTH, subsequent_indent='    ', break_long_words=False, break_on_hyphens=False
    )  # so that a path or an option can be searched for
    lines = whole.wrap(f'{title} (cloth_predict {__version__}).')
    for name, note in notes.items():
        lines += whole.wrap(f'{name}: {note}')
    return ''.join(f'# {line}\n' for line in lines) + dump(config)


def write_configuration(path: Path, text: str) -> None:
    """Write a parameter file in one piece. Raises FormatError naming it where that fails."""
    check_output(path)
    new = _new(path)
    with writing(path):
        new.write_text(text, encoding='utf-8')
        new.replace(path)


def check_output(path: Path) -> None:
    """Raise FormatError where a parameter file could not be written, as before a long search."""
    new = _new(path)
    with writing(path):
        if path.is_dir():
            raise IsADirectoryError(EISDIR, strerror(EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        new.touch()
        new.unlink()


def _new(path: Path) -> Path:
    """Where a file is made before it takes its place."""
    return path.with_name(f'.{path.name}.new')
