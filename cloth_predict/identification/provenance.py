"""Where a configuration comes from: what was searched, on what, and how well it did."""

from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from textwrap import wrap

from cloth_predict import __version__
from cloth_predict.config import Config, dump, flatten
from cloth_predict.evaluation.cases import Case, case_of
from cloth_predict.formats.files import writing
from cloth_predict.formats.recording import read
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


def recording_line(source: str, markers: MarkerSequence) -> str:
    """Name a recording as a provenance has it."""
    return f'{Path(source).name} (content {content_hash(markers)})'


def read_cases(sources: Sequence[Path], config: Config) -> tuple[list[Case], tuple[str, ...]]:
    """Read recordings as they are evaluated, and name each of them."""
    recordings = [(str(source), read(source)) for source in sources]
    cases = [case_of(recording, config, source) for source, recording in recordings]
    return cases, tuple(recording_line(s, recording.markers) for s, recording in recordings)


def kept(config: Config, searched: Container[str]) -> dict[str, str]:
    """Parameters that a search leaves alone, but on which its results depend."""
    return {
        name: str(value)
        for name, value in flatten(asdict(config)).items()
        if name.split('.')[0] not in APART and name not in searched
    }


def with_provenance(config: Config, title: str, notes: Mapping[str, str]) -> str:
    """Return a parameter file that begins with comments: a title, and one note under each name."""
    lines = [*wrap(f'{title} (cloth_predict {__version__}).', WIDTH)]
    for name, note in notes.items():
        lines += wrap(f'{name}: {note}', WIDTH, subsequent_indent='    ')
    return ''.join(f'# {line}\n' for line in lines) + dump(config)


def write_configuration(path: Path, text: str) -> None:
    """Write a parameter file in one piece. Raises FormatError naming it where that fails."""
    new = path.with_name(f'.{path.name}.new')
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        new.write_text(text, encoding='utf-8')
        new.replace(path)
