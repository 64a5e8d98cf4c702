"""The recordings of a search: those on which is found, and those on which is judged only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cloth_predict.config import Config
from cloth_predict.errors import ConfigError, FormatError
from cloth_predict.evaluation.cases import Case, case_of
from cloth_predict.formats.recording import read
from cloth_predict.identification.provenance import content_hash
from cloth_predict.tracker import Tracker


@dataclass(frozen=True)
class Recordings:
    """Recordings as they are evaluated, and a line for a provenance that names each of them."""

    cases: tuple[Case, ...]
    lines: tuple[str, ...]

    @classmethod
    def read(cls, sources: Sequence[Path], config: Config) -> Recordings:
        """Read them. Raises FormatError for one in which the surface never starts."""
        cases, lines = [], []
        for source in sources:
            recording = read(source)
            cases.append(_started(case_of(recording, config, str(source)), config))
            lines.append(f'{source.name} (content {content_hash(recording.markers)})')
        return cls(tuple(cases), tuple(lines))


def read_apart(
    sources: Sequence[Path], held_out: Sequence[Path], config: Config
) -> tuple[Recordings, Recordings]:
    """Read what is searched on, and what is held out of it.

    Raises FormatError for a recording that is both, by what it holds: it would judge nothing; and
    ConfigError for a model that is no mesh of springs.
    """
    if config.model.kind != 'mass_spring':
        raise ConfigError(f'model.kind: nothing is searched of {config.model.kind}')
    trained, others = Recordings.read(sources, config), Recordings.read(held_out, config)
    known = {content_hash(case.markers): case.name for case in trained.cases}
    for case in others.cases:
        if (same := known.get(content_hash(case.markers))) is not None:
            raise FormatError(
                f'{case.name}: is held out, but holds the same as {same}, which is searched on'
            )
    return trained, others


def _started(case: Case, config: Config) -> Case:
    """Return a case in which the surface starts, and so has predictions to judge."""
    tracker = Tracker(config)
    for k, stamp in enumerate(case.markers.stamps.tolist()):
        tracker.step(stamp, *case.frame(k, associates=True))
        if tracker.started:
            return case
    raise FormatError(f'{case.name}: {tracker.health().text}')
