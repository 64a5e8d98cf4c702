"""Where a configuration comes from: what was searched, on what, and how well it did."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from textwrap import wrap

from cloth_predict import __version__
from cloth_predict.config import Config, dump
from cloth_predict.errors import FormatError
from cloth_predict.types import MarkerSequence

WIDTH = 96
"""Characters of a comment's line."""


def content_hash(markers: MarkerSequence) -> str:
    """Return 16 hexadecimal digits that tell recordings apart by what they hold, not by name."""
    found = hashlib.sha256(repr((markers.labels, len(markers))).encode())
    for values in (markers.stamps, markers.visible, markers.positions):
        found.update(values.tobytes())
    return found.hexdigest()[:16]


def recording_line(source: str, markers: MarkerSequence) -> str:
    """Name a recording as a provenance has it."""
    return f'{Path(source).name} (content {content_hash(markers)})'


def with_provenance(config: Config, title: str, notes: Mapping[str, str]) -> str:
    """Return a parameter file that begins with comments: a title, and one note under each name."""
    lines = [*wrap(f'{title} (cloth_predict {__version__}).', WIDTH)]
    for name, note in notes.items():
        lines += wrap(f'{name}: {note}', WIDTH, subsequent_indent='    ')
    return ''.join(f'# {line}\n' for line in lines) + dump(config)


def write_configuration(path: Path, text: str) -> None:
    """Write a parameter file in one piece. Raises FormatError naming it where that fails."""
    new = path.with_name(f'.{path.name}.new')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.write_text(text, encoding='utf-8')
        new.replace(path)
    except OSError as error:
        raise FormatError(f'{path}: cannot be written: {error.strerror}') from None
