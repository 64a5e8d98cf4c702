"""What compensation buys as numbers, as text, and as the folder that `project -o` writes."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from cloth_predict import config as configuration
from cloth_predict.evaluation.bootstrap import Interval, quantile_interval
from cloth_predict.evaluation.projection import METHODS, Compensation
from cloth_predict.evaluation.report import number
from cloth_predict.metrics import mean
from cloth_predict.types import BoolArray, FloatArray

JUST_NOTICEABLE = 1.9
"""Misregistration [mm] that an eye can just notice, on a surface that moves at 0.5 m/s."""
SEED = 0
"""Of the bootstrap."""


@dataclass(frozen=True)
class Misregistration:
    """Where the light of a method lands, by its distance from where it is meant to."""

    p50_mm: float
    p95_mm: float
    max_mm: float
    p95_px: float
    under_jnd: float
    """Share of the vertices within `JUST_NOTICEABLE`."""
    p95_95_mm: Interval
    """95 % interval of `p95_mm`; NaN where a recording is too short for one."""
    missed: float
    """Share of the light that lands beside the surface: its distance is that of the ray."""
    count: int

    @classmethod
    def of(
        cls, found: Compensation, method: str, nodes: BoolArray | None = None, field: int = -1
    ) -> Misregistration:
        """Sum up a method: of all vertices or some, shape (nodes,), and fields or one."""
        place, counts = METHODS.index(method), found.judged
        if nodes is not None:
            counts = counts & nodes
        if field >= 0:
            counts = counts & (np.arange(found.scan.fields) == field)[:, None]
        mm, px = 1e3 * found.error[place][counts], found.error_px[place][counts]
        errors = np.where(counts, 1e3 * found.error[place], nan).reshape(len(counts), -1)
        rng = np.random.default_rng(SEED)
        return cls(
            _percentile(mm, 50),
            _percentile(mm, 95),
            _percentile(mm, 100),
            _percentile(px, 95),
            mean((mm < JUST_NOTICEABLE).astype(float)),
            quantile_interval([(errors, found.block)], 0.95, rng),
            mean(found.missed[place][counts].astype(float)),
            len(mm),
        )


def _percentile(values: FloatArray, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else nan


@dataclass(frozen=True)
class OnSurface:
    """How far off the picture of a method is at the nodes of a mesh finer than the vertices.

    Between the vertices a renderer stretches it over triangles, which the surface is not. NaN
    where the surface is not known there.
    """

    p50_mm: float
    p95_mm: float
    under_jnd: float
    dark: float
    """Share of the nodes to which no light comes."""

    @classmethod
    def of(cls, found: Compensation, method: str) -> OnSurface:
        """Sum up a method."""
        if found.between is None:
            return cls(nan, nan, nan, nan)
        errors = 1e3 * found.between[METHODS.index(method)]
        mm = errors[np.isfinite(errors)]
        under = mean((mm < JUST_NOTICEABLE).astype(float))
        return cls(_percentile(mm, 50), _percentile(mm, 95), under, 1 - mm.size / errors.size)


def summary(found: Compensation) -> dict[str, Any]:
    """Return what `project --json` prints."""
    return {
        'bag': found.bag,
        'fps': found.scan.fps,
        'scan': found.scan.mode,
        'direction': found.scan.direction,
        'motion': found.config.projector.motion,
        'delay_s': found.delay,
        'age_s': round(float(found.age.mean()), 6),
        'frames': len(found.judged_frames),
        'predicted': len(found.starts) / found.asked,
        'in_view': float(found.judged.mean()),
        'methods': {name: _method(found, name) for name in METHODS},
    }


def _method(found: Compensation, name: str) -> Any:
    told = asdict(Misregistration.of(found, name))
    told['surface'] = asdict(OnSurface.of(found, name))
    told['free'] = asdict(Misregistration.of(found, name, found.free))
    if found.scan.fields > 1:
        fields = range(found.scan.fields)
        told['fields'] = [asdict(Misregistration.of(found, name, field=k)) for k in fields]
    return _plain(told)


def _plain(value: Any) -> Any:
    """Return the same with null for what is not a number, as JSON has none."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def text(found: Compensation) -> str:
    """Return the errors as text."""
    judged = len(found.judged_frames)
    lines = [
        f'{judged} frames at {found.scan.fps:g} Hz, {found.scan.mode}, '
        f'{1e3 * found.delay:g} ms from the markers to the frame '
        f'({1e3 * found.age.mean():.1f} ms from the last ones)',
        'distance of the light from where it is meant to land, in mm; p95 with 95 % interval',
        'of the vertices; free: without the driven ones; mesh: p95 between the vertices as well',
        f'{"method":6} {"p50":>7} {"p95":>7} {"interval":>13} {"max":>7} {"p95 px":>7} '
        f'{"< 1.9 mm":>8} {"free p95":>8} {"beside":>7} {"mesh p95":>8}',
    ]
    for name in METHODS:
        row, mesh = _row(name, Misregistration.of(found, name), found), OnSurface.of(found, name)
        lines.append(f'{row} {number(mesh.p95_mm):>8}')
        if found.scan.fields > 1:
            lines += [
                _row(f' {field}', Misregistration.of(found, name, field=field), found)
                for field in range(found.scan.fields)
            ]
    return '\n'.join([*lines, *_notes(found)])


def _row(name: str, all_of_it: Misregistration, found: Compensation) -> str:
    low, high = all_of_it.p95_95_mm
    interval = f'{number(low)}-{number(high)}' if np.isfinite(low) else '-'
    free = number(Misregistration.of(found, name, found.free).p95_mm) if name in METHODS else ''
    errors = ' '.join(f'{number(e):>7}' for e in (all_of_it.p50_mm, all_of_it.p95_mm))
    return (
        f'{name:6} {errors} {interval:>13} {number(all_of_it.max_mm):>7} '
        f'{number(all_of_it.p95_px):>7} {100 * all_of_it.under_jnd:>6.1f} % {free:>8} '
        f'{100 * all_of_it.missed:>5.1f} %'
    ).rstrip()


def _notes(found: Compensation) -> list[str]:
    notes = []
    if len(found.starts) < found.asked:
        notes.append(f'{len(found.starts)} of {found.asked} frames had a prediction')
    if not found.judged.all():
        share = 100 * found.judged.mean()
        notes.append(f'{share:.1f} % of the vertices were in view at the time of their line')
    return notes


def report(found: Compensation, output: Path) -> None:
    """Write the table, the numbers, the figures and the configuration used into a folder."""
    from cloth_predict.evaluation import (
        projection_figures,
        viewer,
    )  # matplotlib takes half a second

    (output / 'config.yaml').write_text(configuration.dump(found.config), encoding='utf-8')
    (output / 'table.txt').write_text(text(found) + '\n', encoding='utf-8')
    numbers = json.dumps(summary(found), indent=1)
    (output / 'projection.json').write_text(numbers + '\n', encoding='utf-8')
    frame = projection_figures.fastest(found)
    projection_figures.rows_of_frame(found, frame, output / 'rows.png')
    projection_figures.errors(found, output / 'errors.png')
    if found.has_picture:
        viewer.picture(found, frame, output / 'viewer.png')
