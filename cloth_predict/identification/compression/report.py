"""A compression as text, as numbers, as a parameter file with its provenance, and as a folder."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from cloth_predict.formats.files import writing
from cloth_predict.identification.compression import figures
from cloth_predict.identification.compression.falling import RELEASES
from cloth_predict.identification.compression.modal import COMPRESSED, Rival, at_equal_cost
from cloth_predict.identification.compression.search import Compression
from cloth_predict.identification.provenance import with_provenance


def summary(found: Compression, rivals: Sequence[Rival] = ()) -> dict[str, Any]:
    """Return the numbers as `compress --json` prints them; what is not finite becomes None."""
    task, result = found.task, found.result
    return {
        'from': list(task.source),
        'to': list(task.target),
        'parameters': found.found,
        'optimiser': found.method.optimiser,
        'seed': found.method.seed,
        'alpha': task.alpha,
        'evaluations': result.evaluations,
        'refused': result.refused,
        'stopped': result.stopped,
        'interrupted': result.interrupted,
        'study': found.method.study,
        'trace': [list(point) for point in result.trace],
        'scenarios': {
            name: {
                'trained': name in task.trained,
                'cost_equal': _plain(found.before[name].cost),
                'cost': _plain(found.after[name].cost),
                'lower_by': _plain(1.0 - found.share_left(name)),
                'rms_equal_m': _plain(found.before[name].rms),
                'rms_m': _plain(found.after[name].rms),
            }
            for name in found.after
        },
        'rivals': [
            {
                'kind': rival.kind,
                'shapes': rival.shapes,
                'states': rival.states,
                'step_us': 1e6 * rival.step,
                'cycle_us': 1e6 * rival.cycle,
                'rms_m': {name: _plain(value) for name, value in rival.rms.items()},
            }
            for rival in rivals
        ],
    }


def text(found: Compression, rivals: Sequence[Rival] = ()) -> str:
    """Return the result as `compress` prints it."""
    lines = [f'{name}: {note}' for name, note in _notes(found).items()]
    if found.after:
        lines += ['', *_scenarios(found)]
    if rivals:
        lines += ['', *_rivals(found, rivals)]
    return '\n'.join(lines)


def file(found: Compression) -> str:
    """Return the parameter file, with its provenance as comments."""
    notes = _notes(found)
    for name, after in found.after.items():
        before = found.before[name]
        notes[name] = (
            f'{RELEASES[name].text}; cost {before.cost:.4g} -> {after.cost:.4g} m^2, RMS distance '
            f'{1e3 * before.rms:.4g} -> {1e3 * after.rms:.4g} mm'
        )
    return with_provenance(found.config, 'A sheet made by cloth-predict compress', notes)


def write(found: Compression, rivals: Sequence[Rival], folder: Path) -> None:
    """Write tables, numbers and pictures. Raises FormatError where that cannot be."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'compression.txt').write_text(text(found, rivals) + '\n', encoding='utf-8')
        numbers = json.dumps(summary(found, rivals), indent=1)
        (folder / 'compression.json').write_text(numbers + '\n', encoding='utf-8')
        figures.errors(found, folder / 'errors.png')
        figures.costs(found, folder / 'costs.png')
        figures.parameters(found, folder / 'parameters.png')
        if rivals:
            figures.at_cost(found, rivals, folder / 'rivals.png')


def _notes(found: Compression) -> dict[str, str]:
    task, method, result = found.task, found.method, found.result
    notes = task.notes | {
        'held out': ', '.join(task.held_out) or 'nothing',
        'search': f'{found.found} parameters by {method.optimiser}, seed {method.seed}: '
        f'{result.evaluations} evaluations ({result.refused} refused), {result.stopped}; cost '
        f'{result.trace[0][1]:.4g} -> {result.cost:.4g} m^2',
    }
    return notes | ({'study': method.resumable} if result.interrupted else {})


def _scenarios(found: Compression) -> list[str]:
    lines = [
        f'{"":12} {"":8} {"cost, m^2":>19} {"":>7} {"RMS distance, mm":>17}',
        f'{"scenario":12} {"":8} {"equal":>9} {"found":>9} {"lower":>7} {"equal":>8} {"found":>8}',
    ]
    for name in found.task.names:
        before, after = found.before[name], found.after[name]
        role = 'trained' if name in found.task.trained else 'held out'
        lines.append(
            f'{name:12} {role:8} {before.cost:9.4g} {after.cost:9.4g} '
            f'{100 * (1 - found.share_left(name)):5.1f} % {1e3 * before.rms:8.1f} '
            f'{1e3 * after.rms:8.1f}'
        )
    return lines


def _rivals(found: Compression, rivals: Sequence[Rival]) -> list[str]:
    names = found.task.names
    wide = max(len(rival.kind) for rival in rivals)
    lines = [
        f'{"":{wide}} {"":6} {"":6} {"us":>6} {"us, EKF":>8}   RMS distance, mm',
        f'{"model":{wide}} {"shapes":>6} {"states":>6} {"step":>6} {"cycle":>8} '
        + ' '.join(f'{name:>8}' for name in names),
    ]
    for rival in rivals:
        shapes = '-' if rival.shapes is None else str(rival.shapes)
        lines.append(
            f'{rival.kind:{wide}} {shapes:>6} {rival.states:6d} {1e6 * rival.step:6.0f} '
            f'{1e6 * rival.cycle:8.0f} '
            + ' '.join(f'{1e3 * rival.rms[name]:8.1f}' for name in names)
        )
    for by, what in (('step', 'step'), ('cycle', 'EKF cycle')):
        cheap = at_equal_cost(rivals, by).values()
        kinds = ', '.join(f'{one.kind} {one.shapes}' for one in cheap) or 'none'
        lines.append(f'reductions whose {what} costs no more than that of {COMPRESSED}: {kinds}')
    return lines


def _plain(number: float) -> float | None:
    return float(number) if isfinite(number) else None
