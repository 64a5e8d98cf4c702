"""The works whose experiments are repeated, and the table that is made of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from cloth_predict.errors import ConfigError
from cloth_predict.experiments import goeller2015, gomes2016, metaxas1993
from cloth_predict.experiments.rows import Experiment, Row, Scope
from cloth_predict.formats.files import writing

WORKS: dict[str, tuple[Experiment, ...]] = {
    'gomes2016': gomes2016.EXPERIMENTS,
    'goeller2015': goeller2015.EXPERIMENTS,
    'metaxas1993': metaxas1993.EXPERIMENTS,
}
"""A new work is one entry."""

Progress = Callable[[str, float], None]
"""Called with the name of an experiment, and the share of all done since the last call."""


def chosen(work: str, only: Sequence[str]) -> list[Experiment]:
    """Experiments by figure, chapter or name, all of none. Raises ConfigError for another one."""
    for name in only:
        if not any(experiment.is_asked_for(name) for experiment in WORKS[work]):
            known = ', '.join(experiment.name for experiment in WORKS[work])
            raise ConfigError(f'--only {name}: no such figure in {work}; there are {known}')
    return [e for e in WORKS[work] if not only or any(e.is_asked_for(name) for name in only)]


def reproduce(
    work: str,
    scope: Scope,
    only: Sequence[str] = (),
    progress: Progress = lambda name, share: None,
) -> list[Row]:
    """Run experiments and write the table after each one, so that Ctrl-C keeps what is done."""
    experiments, rows = chosen(work, only), []
    for experiment in experiments:

        def done(share: float, name: str = experiment.name) -> None:
            progress(name, share / len(experiments))

        done(0.0)
        rows.append(experiment.run(replace(scope, progress=done)))
        write(rows, scope.output)
    return rows


def write(rows: Sequence[Row], output: Path) -> None:
    """Write the table as Markdown and as JSON."""
    numbers = json.dumps([row.summary() for row in rows], indent=1)
    with writing(output):
        (output / 'table.md').write_text(table(rows), encoding='utf-8')
        (output / 'table.json').write_text(numbers, encoding='utf-8')


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a table in Markdown, with their pictures below."""
    lines = [
        "| figure | paper says | the paper's own recipe here | ours on the same data | why |",
        '|---|---|---|---|---|',
    ]
    for row in rows:
        cells = (row.figure, row.paper, row.recipe, row.ours, row.why)
        lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    pictures = [f'![Figures {row.figure}]({name})' for row in rows for name in row.pictures]
    return '\n'.join([*lines, '', *pictures]).rstrip() + '\n'
