"""An evaluation as text, and the folder that `evaluate -o` writes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import isfinite, nan
from pathlib import Path
from textwrap import wrap
from typing import Any

from cloth_predict import config as configuration
from cloth_predict.config import Config
from cloth_predict.evaluation.bootstrap import Interval
from cloth_predict.evaluation.compare import POOLED, Evaluation
from cloth_predict.evaluation.judging import FEWEST

WIDTH = 99
"""Characters of a line, so that it fits into a terminal."""


def summaries(evaluations: Sequence[Evaluation]) -> dict[str, Any] | list[dict[str, Any]]:
    """Return what `evaluate --json` prints: an object, or a list of several.

    There is an object for each recording and horizon; where there are several recordings it names
    its `bag`, which is `all` for all of them together.
    """
    several = any(evaluation.bag == POOLED for evaluation in evaluations)
    found = [
        {'bag': evaluation.bag, **evaluation.summary()} if several else evaluation.summary()
        for evaluation in evaluations
    ]
    return found[0] if len(found) == 1 else found


def text(evaluations: Sequence[Evaluation]) -> str:
    """Return every comparison as text."""
    several = any(evaluation.bag == POOLED for evaluation in evaluations)
    return '\n\n'.join(
        (f'{evaluation.bag}: ' if several else '') + f'{table(evaluation)}\n{details(evaluation)}'
        for evaluation in evaluations
    )


def table(evaluation: Evaluation) -> str:
    """Return the errors as text."""
    wide = _width(evaluation)
    lines = [
        f'predicted {1e3 * evaluation.horizon:g} ms ahead, {len(evaluation.targets)} frames'
        ', errors in mm, 95 % intervals',
        f'{"method":{wide}} {"RMS":>7} {"free":>7} {"p95":>7} {"max":>7} {"interval":>13} '
        f'{"ratio":>5} {"interval":>9} {"us/frame":>8}',
    ]
    for name, s in evaluation.scores.items():
        errors = (s.rmse_mm, s.rmse_free_mm, s.p95_mm, s.max_mm)
        numbers = ' '.join(f'{number(value):>7}' for value in errors)
        ratio = evaluation.ratios[name]
        lines.append(
            f'{name:{wide}} {numbers} {_interval(s.rmse_95_mm):>13} {number(ratio.ratio):>5} '
            f'{_interval(ratio.ratio_95):>9} {evaluation.us_per_frame[name]:8.0f}'
        )
    return '\n'.join(lines)


def details(evaluation: Evaluation) -> str:
    """Return the coverage, the NIS, the NEES, the errors by speed and the counts as text."""
    wide = _width(evaluation)
    ends = [part.up_to_m_s for part in next(iter(evaluation.details.values())).by_speed]
    speeds = ' '.join(f'{number(end, "<= ", " m/s"):>11}' for end in ends)
    lines = [
        'free nodes: errors within 1, 2, 3 sigma; NIS, NEES per degree of freedom; RMS by speed',
        f'{"method":{wide}} {"1 sigma":>7} {"2 sigma":>7} {"3 sigma":>7} {"NIS":>7} {"NEES":>7} '
        f'{speeds}',
    ]
    for name, found in evaluation.details.items():
        shares = [100 * share for share in found.coverage or (nan, nan, nan)]
        numbers = ' '.join(f'{number(share, unit=" %", digits=1):>7}' for share in shares)
        errors = ' '.join(f'{number(part.rmse_mm):>11}' for part in found.by_speed)
        lines.append(
            f'{name:{wide}} {numbers} {number(found.nis):>7} {number(found.nees):>7} {errors}'
        )
    notes = [line for note in _notes(evaluation) for line in wrap(note, WIDTH)]
    return '\n'.join([*lines, *notes])


def _width(evaluation: Evaluation) -> int:
    return max(10, *(len(name) for name in evaluation.scores))


def _notes(evaluation: Evaluation) -> list[str]:
    """Return what else is to be known of each method: how much it predicted, and its choices."""
    notes = []
    if evaluation.best:
        notes.append(f'ratio: RMS of the free nodes by that of {evaluation.best}')
    for name, noise in evaluation.noise.items():
        notes.append(f'{name}: best noise on this recording {noise:.3g}')
    for name, answers in evaluation.judged.answers.items():
        share = evaluation.judged.share(name)
        words = [f'predicted {100 * share:.1f} %'] if share < 1 else []
        if not answers.complete:
            words.append(f'less than {100 * FEWEST:g} % of the others: judged on its own frames')
        words += [f'{count} {what}' for what, count in sorted(answers.counts.items())]
        if words:
            notes.append(f'{name}: ' + ', '.join(words))
    return notes


def number(value: float, before: str = '', unit: str = '', digits: int = 2) -> str:
    """Return a number as it stands in a table, - where there is none."""
    if not isfinite(value):
        return '-'
    return f'{before}{value:.{digits}f}{unit}' if value < 1e5 else f'{before}{value:.0e}{unit}'


def _interval(interval: Interval) -> str:
    low, high = interval
    return f'{number(low)}-{number(high)}' if isfinite(low) else '-'


def report(found: Sequence[Sequence[Evaluation]], config: Config, output: Path) -> None:
    """Write tables, numbers, figures and the configuration used into a folder.

    found: of each recording the comparisons at all horizons. Each of several recordings has a
    folder of its own in this one, named after it; what is of all together is here.
    """
    from cloth_predict.evaluation import figures  # matplotlib takes half a second to import

    every = summaries([evaluation for of_bag in found for evaluation in of_bag])
    (output / 'evaluation.json').write_text(json.dumps(every, indent=1) + '\n', encoding='utf-8')
    for of_bag, folder in zip(found, _folders([one[0].bag for one in found], output), strict=True):
        folder.mkdir(exist_ok=True)
        for evaluation in of_bag:
            report_one(evaluation, config, folder, f'_{1e3 * evaluation.horizon:g}ms')
        figures.ladder(of_bag, folder / 'ladder.png')


def _folders(bags: Sequence[str], output: Path) -> list[Path]:
    """Return a folder for each recording; those of the same name are numbered."""
    if len(bags) == 1:
        return [output]
    stems = [Path(bag).stem for bag in bags]
    return [
        output
        if bag == POOLED
        else output / (stem if stems.count(stem) == 1 else f'{k + 1}_{stem}')
        for k, (bag, stem) in enumerate(zip(bags, stems, strict=True))
    ]


def report_one(evaluation: Evaluation, config: Config, output: Path, suffix: str = '') -> None:
    """Write the tables and the figures of one comparison, and the configuration, into a folder."""
    from cloth_predict.evaluation import figures  # matplotlib takes half a second to import

    (output / 'config.yaml').write_text(configuration.dump(config), encoding='utf-8')
    (output / f'table{suffix}.txt').write_text(table(evaluation) + '\n', encoding='utf-8')
    (output / f'details{suffix}.txt').write_text(details(evaluation) + '\n', encoding='utf-8')
    figures.coverage(evaluation, output / f'coverage{suffix}.png')
    figures.errors_by_speed(evaluation, output / f'speed{suffix}.png')
    if len(evaluation.judged.lengths) == 1:
        figures.error_over_time(evaluation, output / f'error{suffix}.png')
        edges = figures.edges_of(config.model, evaluation.judged.actual)
        figures.snapshots(evaluation, edges, output / f'snapshots{suffix}.png')
