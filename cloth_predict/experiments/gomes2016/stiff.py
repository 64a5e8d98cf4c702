"""Figure 6.16: the covariance with springs from Young's modulus (Gomes 2016, eq. 6.19, 6.20)."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import numpy as np

from cloth_predict.config import Config, load
from cloth_predict.evaluation.conditioning import condition_numbers
from cloth_predict.evaluation.judging import WARM_UP
from cloth_predict.experiments.gomes2016.frames import Frames, Track
from cloth_predict.experiments.gomes2016.pictures import over_time
from cloth_predict.experiments.gomes2016.recursion import by_the_letter, tracked
from cloth_predict.experiments.gomes2016.towel import (
    ALPHA,
    BETA,
    arbitrary,
    fan,
    frames_of,
    recipe_model,
    words,
)
from cloth_predict.experiments.plots import panels
from cloth_predict.experiments.rows import Experiment, Row, Scope, figures, short
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import Springs
from cloth_predict.models.stiffness import carried, lloyd_2007
from cloth_predict.share import find
from cloth_predict.surface.topology import grid_triangles
from cloth_predict.types import FloatArray

PAPER = 'stiffness by (6.19) with E 7 to 30 GPa: condition number of P above 1e20, no success'
YOUNG = (7e9, 30e9)
"""Young's moduli [Pa] that the thesis takes for cotton."""


def analytic(scope: Scope) -> Row:
    """Figure 6.16."""
    case, config = fan()
    frames = frames_of(case)
    soft, coarse = recipe_model(config, frames), load(find('config/towel_coarse.yaml'))
    tracks = {'k 300 N/m': _conditioned(soft, frames)}
    for young in YOUNG:
        stiff = with_stiffness(soft, lloyd(config, soft, young))
        tracks[f'E {1e-9 * young:g} GPa'] = _conditioned(stiff, frames)
        scope.progress(0.1)
    springs = tuple(lloyd(config, soft, YOUNG[0]).tolist())
    mine = replace(coarse, model=replace(arbitrary(config).model, springs=springs))
    ours, condition = tracked(mine, frames), condition_numbers(case, mine)
    scope.progress(0.6)
    usual = condition_numbers(case, coarse)
    scope.progress(0.2)
    stiff = with_stiffness(soft, lloyd(config, soft, YOUNG[0]))
    mode = carried(stiff, frames.actual[0], frames.interval)
    numbers = {f'recipe, {n}: median condition number': _median(t) for n, t in tracks.items()}
    numbers |= {
        f'recipe, {name}: updates before it is lost': _updates(t) for name, t in tracks.items()
    }
    numbers |= {
        'ours, E 7 GPa: median condition number': float(np.nanmedian(condition)),
        'ours, config/towel_coarse.yaml: median condition number': float(np.nanmedian(usual)),
        'ours, E 7 GPa: RMS distance [m]': ours.after(WARM_UP).rms,
        'fastest mode of E 7 GPa [rad/s]': mode.omega,
    }
    fates = '; '.join(
        f'{name}: condition number {short(_median(track))} (median of the {_updates(track)} '
        f'updates before {"it is lost" if np.isfinite(track.lost) else "the end"})'
        for name, track in tracks.items()
    )
    return Row(
        '6.16',
        PAPER,
        fates,
        f'E 7 GPa: condition number {short(float(np.nanmedian(condition)))}, {words(ours)}; '
        f'config/towel_coarse.yaml: condition number {short(float(np.nanmedian(usual)))}',
        f'(6.19) makes springs of {short(springs[0], "N/m")}, whose fastest mode turns by '
        f'{short(mode.omega * frames.interval)} rad in 0.01 s: no success here either, as the '
        'thesis says. Above 1e16 the smallest eigenvalue is rounding, so that only the order '
        'counts. The exact filter on an implicit step is not lost, but such springs hold the '
        'towel as a plate: it errs by more than the last measurement held.',
        numbers,
        (_conditions(scope, tracks, frames, condition, usual),),
    )


def _conditioned(mesh: MassSpring, frames: Frames) -> Track:
    return by_the_letter(mesh, frames.filled(), ALPHA, BETA, conditions=True)


def _conditions(
    scope: Scope,
    tracks: dict[str, Track],
    frames: Frames,
    condition: FloatArray,
    usual: FloatArray,
) -> str:
    times = frames.interval * np.arange(len(condition), dtype=float)
    figure, (axes,) = panels(1, 7.0)
    lines = {f'recipe, {name}': (t.times, t.condition) for name, t in tracks.items()}
    lines |= {
        'ours, E 7 GPa': (times, condition),
        'ours, config/towel_coarse.yaml': (times, usual),
    }
    over_time(axes, lines, 'condition number of P', {'thesis, at least': 1e20})
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    return scope.save(figure, 'figure_6.16.png')


def lloyd(config: Config, mesh: MassSpring, young: float) -> FloatArray:
    """Stiffness [N/m] of each spring by (6.19), the sum taken over the triangles beside it.

    Springs to the nodes two away have no triangle; they are given the least of the others.
    """
    triangles = grid_triangles(config.model.rows, config.model.cols)
    beside = np.array(
        [(np.isin(triangles, pair).sum(axis=1) == 2).sum() for pair in mesh.springs.pairs]
    )
    return lloyd_2007(young, np.asarray(mesh.springs.rest_length), np.maximum(beside, 1))


def with_stiffness(mesh: MassSpring, stiffness: FloatArray) -> MassSpring:
    """Return a mesh with other springs, k [N/m] of each."""
    s = mesh.springs
    springs = Springs(s.pairs, stiffness, s.damping, s.rest_length, s.compression)
    return MassSpring(springs, mesh.mass, mesh.driven, mesh.gravity)


def _median(track: Track) -> float:
    known = track.condition[~np.isnan(track.condition)]
    return float(np.median(known)) if len(known) else nan


def _updates(track: Track) -> int:
    return int((~np.isnan(track.condition)).sum())


EXPERIMENTS = (Experiment(figures(6, 16, 16), PAPER, analytic),)
