"""Annex E: where and when the bar will rest, told ahead, and how well that can be told at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from cloth_predict.experiments.goeller2015.runs import (
    CONFIG,
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

PLACE, ANGLE = 0.01, np.radians(1.0)
"""Distance [m] and angle [rad] from the true stop that are asked for."""
EVERY = 6
"""Frames from one prediction to the next."""
NOISES = 20
MOST = 0.95
"""Share of the runs that counts as all."""


PAPER = 'the place of rest is told after 1 to 2 s, not very precisely as the contacts are not'
WHY = (
    'Two sigmas of the bound are above a degree at half of the motion, so that no method can be '
    'within a degree there: half a degree of noise in each frame leaves too much open of the '
    'spin and of the friction that takes it away over so many turns.'
)


def _row(scope: Scope) -> Row:
    noises = seeds(scope, NOISES)
    figure, axes = panels(2 * len(ANNEX_A), width=3.4)
    numbers: dict[str, float] = {}
    words = []
    for place, (version, shot) in enumerate(ANNEX_A.items()):
        film = Filmed.of(shot)
        frames = [f for f in range(EVERY, len(film.times), EVERY) if film.times[f] < film.duration]
        runs = []
        for seed in noises:
            runs.append(followed(film, seed, stops=frames))
            scope.progress(1.0 / len(noises) / len(ANNEX_A))
        bound = Bound.of(film)
        errors = np.array([[run.stop_errors(f) for f in frames] for run in runs])
        least = np.stack([bound.place, bound.angle], axis=-1)[frames]
        found = _summary(film, film.times[frames], errors, least) | _told(runs, frames, errors)
        numbers |= {f'scenario {version}: {name}': value for name, value in found.items()}
        words.append(f'scenario {version}: {_said(found)}')
        _draw(axes[2 * place :], version, film.times[frames], errors, least)
    picture = scope.save(figure, 'stops.png')
    return Row(
        'E', PAPER, 'no error of a stop is printed', '; '.join(words), WHY, numbers, (picture,)
    )


def _summary(
    film: Filmed, times: FloatArray, errors: FloatArray, least: FloatArray
) -> dict[str, float]:
    """Numbers of errors [m, rad], shape (runs, frames, 2), and their bound, (frames, 2)."""
    found = {'rests at [s]': film.duration}
    for k, (asked, unit, name) in enumerate(((PLACE, 'cm', 'place'), (ANGLE, 'degrees', 'angle'))):
        scale = 100.0 if unit == 'cm' else np.degrees(1.0)
        close = (errors[:, :, k] <= asked).mean(axis=0)
        found |= {
            f'{name} within one of {unit} in 95 % of runs from [s]': since(times, close >= MOST),
            f'{name}: two sigmas of the bound within it from [s]': since(
                times, 2.0 * least[:, k] <= asked
            ),
        }
        for what, begin in (('the motion', 0.5 * film.duration), ('two seconds', 1.0)):
            later = times >= begin
            half = int(np.flatnonzero(later)[0])
            found |= {
                f'{name} within it from half of {what} on': float(close[later].mean()),
                f'{name}: RMS error at half of {what} [{unit}]': scale
                * float(np.sqrt(np.mean(np.square(errors[:, half, k])))),
                f'{name}: bound at half of {what} [{unit}]': scale * float(least[half, k]),
            }
    return found


def _told(runs: Sequence[Run], frames: Sequence[int], errors: FloatArray) -> dict[str, float]:
    """When the trigger first tells the stop, and how far off it is then."""
    first = []
    for number, run in enumerate(runs):
        for at, frame in enumerate(frames):
            stop = run.stops[frame]
            if stop and stop.certain(CONFIG.stop_position, CONFIG.stop_angle):
                first.append((run.film.times[frame], *errors[number, at]))
                break
    when, place, angle = np.array(first).T
    return {
        'told at [s], mean': float(when.mean()),
        'place: RMS error when told [cm]': 100.0 * float(np.sqrt(np.mean(place**2))),
        'angle: RMS error when told [degrees]': float(np.degrees(np.sqrt(np.mean(angle**2)))),
    }


def _said(found: dict[str, float]) -> str:
    words = [f'rests at {found["rests at [s]"]:.2f} s']
    for name, unit, asked in (('place', 'cm', '1 cm'), ('angle', 'degrees', '1 degree')):
        from_ = found[f'{name} within one of {unit} in 95 % of runs from [s]']
        least = found[f'{name}: two sigmas of the bound within it from [s]']
        error = found[f'{name}: RMS error at half of the motion [{unit}]']
        bound = found[f'{name}: bound at half of the motion [{unit}]']
        words.append(
            f'{name} at half of the motion off by {short(error, unit)} RMS (bound '
            f'{short(bound, unit)}), within {asked} from {short(from_, "s")} on (two sigmas of '
            f'the bound: {short(least, "s")})'
        )
    place = short(found['place: RMS error when told [cm]'], 'cm')
    angle = short(found['angle: RMS error when told [degrees]'], 'degrees')
    words.append(f'told at {found["told at [s], mean"]:.2f} s, off by {place} and {angle} RMS')
    return ', '.join(words)


def _draw(
    axes: Sequence[Axes], version: int, times: FloatArray, errors: FloatArray, least: FloatArray
) -> None:
    """Errors of each run, two sigmas of the bound, and what is asked for."""
    for k, (scale, name) in enumerate(((100.0, 'cm'), (np.degrees(1.0), 'degrees'))):
        shown = np.where(np.isfinite(errors[:, :, k]), errors[:, :, k], np.nan)
        axes[k].semilogy(times, scale * shown.T, color='tab:red', alpha=0.3, linewidth=0.8)
        axes[k].semilogy(times, 2.0 * scale * least[:, k], 'k--')
        axes[k].axhline(1.0, color='0.5', linewidth=0.8)
        axes[k].set(xlabel='time [s]', title=f'scenario {version}: stop off by, {name}')
        axes[k].grid(alpha=0.3)


EXPERIMENTS = (Experiment(('E',), PAPER, _row),)
