"""Annexes B, C and D: friction and contacts along the three scenarios, and what can be known."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from cloth_predict.experiments.goeller2015.recipe import by_the_paper
from cloth_predict.experiments.goeller2015.runs import (
    KNOWN,
    Bound,
    Filmed,
    Run,
    followed,
    seeds,
    since,
)
from cloth_predict.experiments.plots import panels
from cloth_predict.experiments.rows import Experiment, Row, Scope, short
from cloth_predict.simulation.ruler import ANNEX_A
from cloth_predict.types import FloatArray

VIDEO = 2.0
"""Length of the video [s] (Goeller et al. 2015, 4.5)."""
CLOSE = 0.02
"""Relative error of mu that is asked for."""
OBSERVED = 0.1
"""Bound of the sigma of a contact's place, by its value, under which it counts as observed."""
NOISES = 20
PAPER = 'mu found quickly, off by about 10 % for good; L1 and L2 found, but very noisy'


def _row(version: int, scope: Scope) -> Row:
    film, noises = Filmed.of(ANNEX_A[version], VIDEO), seeds(scope, NOISES)
    bound = Bound.of(film)
    ours, recipe = [], []
    for seed in noises:
        ours.append(followed(film, seed))
        recipe.append(by_the_paper(film, seed))
        scope.progress(1.0 / len(noises))
    found, printed = _errors(ours), _errors(recipe)
    values = film.joint[list(KNOWN)]
    seen = bound.sigma[:, KNOWN[:2]] <= OBSERVED * values[:2]
    close = np.asarray(~(np.abs(found[..., 2]) > CLOSE).any(axis=0))
    numbers = {
        'ours: worst error of mu at the end': float(np.abs(found[:, -1, 2]).max()),
        'ours: mu within 2 % in every run from [s]': since(film.times, close),
        'recipe: worst error of mu at the end': float(np.abs(printed[:, -1, 2]).max()),
        'recipe: runs lost': float(np.isnan(printed[:, -1, 2]).sum()),
        'bound: sigma of mu at the end': float(bound.sigma[-1, KNOWN[2]] / values[2]),
        'bound: sigma of the root of L1 L2 at the end [m]': float(bound.middle[-1]),
        'ours: RMS error of the root of L1 L2 at the end [m]': _middle(ours),
    }
    for k, name in enumerate(('L1', 'L2')):
        errors = found[:, :, k]
        numbers |= {
            f'share of the video in which {name} is observed': float(seen[:, k].mean()),
            f'bound: sigma of {name} at the end [m]': float(bound.sigma[-1, KNOWN[k]]),
            f'ours: RMS error of {name} at the end [m]': _rms(errors[:, -1]),
            f'ours: RMS error of {name} where observed [m]': _rms(errors[:, seen[:, k]]),
            f'recipe: RMS error of {name} at the end [m]': _rms(printed[:, -1, k]),
        }
    picture = scope.save(_picture(film, found, bound), f'scenario_{version}.png')
    return Row(
        'BCD'[version - 3],
        f'scenario {version}: {PAPER}',
        _said(numbers, 'recipe'),
        _ours(numbers, len(noises)),
        WHY[version],
        numbers,
        (picture,),
    )


WHY = {
    3: 'Contacts tell of themselves where they are slow: at first the bar goes faster than it '
    'spins, so that both pull the same way, wherever they are.',
    4: 'The bar spins faster than it goes, so that its contacts pull to either side from the '
    'start.',
    5: 'The bar hardly spins. To first order in the spin friction slows it in proportion to '
    'mu L1 L2 (the lever of each contact squared, by its share of the weight), so that only the '
    'product is observed, and not which of the two is longer. The likely values are on a curve, '
    'L1 L2 = constant, and their mean lies beside it.',
}


def _errors(runs: Sequence[Run]) -> FloatArray:
    return np.array([run.parameter_errors for run in runs])


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors)))) if errors.size else float('nan')


def _middle(runs: Sequence[Run]) -> float:
    """RMS error of the root of L1 L2 [m] at the end."""
    r = runs[0].film.shot.ruler
    ends = np.array([run.mean[-1, KNOWN[:2]] for run in runs])
    return _rms(np.sqrt(ends.prod(axis=1)) - np.sqrt(r.L1 * r.L2))


def _said(numbers: dict[str, float], who: str) -> str:
    lost = numbers[f'{who}: runs lost']
    return (
        f'mu at the end within {100 * numbers[f"{who}: worst error of mu at the end"]:.2g} %; '
        f'RMS error of L1 {short(100 * numbers[f"{who}: RMS error of L1 at the end [m]"], "cm")}, '
        f'of L2 {short(100 * numbers[f"{who}: RMS error of L2 at the end [m]"], "cm")}'
        + (f'; {lost:.0f} runs lost' if lost else '')
    )


def _ours(numbers: dict[str, float], runs: int) -> str:
    words = [
        f'mu at the end within {100 * numbers["ours: worst error of mu at the end"]:.2g} % in '
        f'each of {runs} runs, within 2 % from '
        f'{short(numbers["ours: mu within 2 % in every run from [s]"], "s")} on'
    ]
    for name in ('L1', 'L2'):
        share = numbers[f'share of the video in which {name} is observed']
        there = numbers[f'ours: RMS error of {name} where observed [m]']
        end = numbers[f'ours: RMS error of {name} at the end [m]']
        words.append(
            f'{name} observed in {100 * share:.0f} % of the video'
            + (f', RMS error there {short(100 * there, "cm")}' if share else '')
            + f', at the end {short(100 * end, "cm")}'
        )
    root = numbers['ours: RMS error of the root of L1 L2 at the end [m]']
    words.append(f'of the root of L1 L2 {short(100 * root, "cm")}')
    return '; '.join(words)


def _picture(film: Filmed, errors: FloatArray, bound: Bound) -> Figure:
    """Errors of each run, and two sigmas of what no estimator can beat."""
    figure, axes = panels(3, width=4.2)
    value = film.joint[list(KNOWN)] / [0.01, 0.01, 1.0]
    for k, (axis, name) in enumerate(zip(axes, ('L1 [cm]', 'L2 [cm]', 'mu [%]'), strict=True)):
        scale = 100.0
        least = 2.0 * bound.sigma[:, KNOWN[k]] * (scale if k < 2 else scale / value[2])
        axis.plot(film.times, scale * errors[:, :, k].T, color='tab:red', alpha=0.4, linewidth=0.8)
        axis.plot(film.times, least, 'k--', film.times, -least, 'k--', linewidth=1.0)
        axis.set(xlabel='time [s]', title=f'error of {name}')
        high = np.abs(scale * errors[:, len(film.times) // 4 :, k]).max() * 1.2
        axis.set_ylim(-high, high)
        axis.grid(alpha=0.3)
    return figure


EXPERIMENTS = tuple(
    Experiment(('BCD'[version - 3],), f'scenario {version}: {PAPER}', partial(_row, version))
    for version in ANNEX_A
)
