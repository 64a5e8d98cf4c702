"""Figures 6.1-6.3 and 6.5-6.9: the filter on a falling sheet that is shaken or blown at."""

from __future__ import annotations

from typing import Any

from cloth_predict.config import Config, build
from cloth_predict.experiments.gomes2016.frames import TS, Frames, Track
from cloth_predict.experiments.gomes2016.pictures import errors, sheets
from cloth_predict.experiments.gomes2016.recursion import EulerStep, by_the_letter, tracked
from cloth_predict.experiments.gomes2016.shaken import (
    DAMPING,
    INTERVAL,
    SIDE,
    STIFFNESS,
    noisy,
    small_sheet,
    viscous,
)
from cloth_predict.experiments.rows import Experiment, Row, Scope, figures, short
from cloth_predict.models.stiffness import carried
from cloth_predict.surface.topology import grid

DURATION = 10.0
OF_NOISE = (
    'process noise of variance 0.001, Q 0.001 I, R I: MSE falls to 5e-4 m² at 10 s; worst node '
    '30 cm at 0.8 s, then 5 cm'
)
OF_WIND = (
    'viscous force, U(1, 10) m/s, Q 100 I, R I: MSE 6e-4 m² at first, then about 0; one node 10 '
    'cm, then < 0.5 cm'
)
OF_STORM = 'viscous force, U(1, 100) m/s: MSE up to 0.05 m², nodes > 1 m off, then 5e-4 m²'
RECIPES = ('recipe', 'recipe, 0.01 s', 'I + Ts J, 0.01 s')
"""By the letter every 0.1 s; every 0.01 s; and with the Jacobian of the step in place of J."""


def shaken() -> Frames:
    """Markers of the sheet with process noise, 100 a second."""
    return Frames.of_states(*small_sheet(), noisy(0, DURATION), INTERVAL)


def blown(fastest: float) -> Frames:
    """Markers of the sheet in a medium of U(1, fastest) m/s, 100 a second."""
    return Frames.of_states(*small_sheet(), viscous(1, DURATION, fastest), INTERVAL)


def config(**groups: dict[str, Any]) -> Config:
    """Describe the sheet of table 6.1 to the tracker, with what else is given by group."""
    stiffness = {f'stiffness_{name}': STIFFNESS for name in ('structural', 'shear', 'flexion')}
    settings: dict[str, Any] = {
        'horizon': TS,
        'model': {
            'rows': 5, 'cols': 5, 'width': SIDE, 'height': SIDE, 'mass': 25 * 0.441,
            'damping': DAMPING, **stiffness,
        },
        'anchors': {'nodes': [0, 1, 2, 3, 4]},
        'force': {'kind': 'none'},
        # what is simulated is seen exactly, and starts at rest
        'filter': {'measurement_noise': 1e-4, 'initial_velocity': 1e-3, 'process_noise': 1e-3},
        'association': {'check_labels': False},
        'limits': {'sigma_error': 10.0},
    }  # fmt: skip
    for name, values in groups.items():
        settings[name] = settings.get(name, {}) | values
    return build(settings, 'the sheet of table 6.1')


def for_noise() -> Config:
    """Settings of the tracker for the sheet with process noise: its own model, by RK4."""
    return config(filter={'integrator': 'rk4'})


def for_wind(sigma: float, tau: float) -> Config:
    """Settings of the tracker where the air is not known: a force [N] on each node as a state."""
    return config(force={'kind': 'ornstein_uhlenbeck', 'sigma': sigma, 'tau': tau})


def recipes(frames: Frames, alpha: float, beta: float) -> dict[str, Track]:
    """Run the recursion of the thesis in each of its readings."""
    cloth, _ = small_sheet()
    found = (
        by_the_letter(cloth, frames, alpha, beta),
        by_the_letter(cloth, frames, alpha, beta, INTERVAL),
        by_the_letter(EulerStep(cloth, INTERVAL), frames, alpha, beta, INTERVAL),
    )
    return dict(zip(RECIPES, found, strict=True))


def numbers_of(tracks: dict[str, Track]) -> dict[str, float]:
    """Return what the row rests on."""
    found = {}
    for name, track in tracks.items():
        found[f'{name}: peak MSE [m^2]'] = track.peak
        found[f'{name}: MSE of the first second [m^2]'] = track.around(1.0)
        found[f'{name}: MSE of the last second [m^2]'] = track.around(DURATION)
        found[f'{name}: worst node [m]'] = track.farthest
        found[f'{name}: worst node at the end [m]'] = float(track.distance[-1].max())
    return found


def words(track: Track) -> str:
    """Return the errors of a filter as a sentence."""
    return (
        f'MSE peak {short(track.peak)}, last second {short(track.around(DURATION), "m²")}; worst '
        f'node {short(track.farthest)}, at the end {short(float(track.distance[-1].max()), "m")}'
    )


def _readings(tracks: dict[str, Track]) -> str:
    shorter, stepped = (tracks[name] for name in RECIPES[1:])
    return (
        f'Every 0.01 s (the time of "10 iterations" in section 6.2): {words(shorter)}. With '
        f'I + Ts J in place of J every 0.01 s: {words(stepped)}; but that looks 0.01 s ahead, a '
        'tenth of what ours does.'
    )


def of_noise(scope: Scope) -> Row:
    """Figures 6.1-6.3."""
    frames = shaken()
    scope.progress(0.4)
    tracks = recipes(frames, 1e-3, 1.0)
    scope.progress(0.3)
    tracks['ours'] = tracked(for_noise(), frames)
    usual = tracked(config(), frames)
    scope.progress(0.3)
    numbers = numbers_of(tracks | {'ours, implicit 10 ms steps': usual})
    picture = errors(tracks, {'thesis, 10 s': 5e-4}, 0.3)
    pictures = (
        scope.save(picture, 'figure_6.2.png'),
        _snapshots(scope, frames, tracks['ours'], 'figure_6.1.png'),
    )
    return Row(
        '6.1-6.3',
        OF_NOISE,
        words(tracks['recipe']),
        f'{words(tracks["ours"])} (steps by RK4; by the implicit step of 10 ms: {words(usual)})',
        f'In a step of explicit Euler of 0.1 s the stiffest mode turns by {_turn():.2g} rad, and '
        'J as transition matrix has no identity: what P knows of the positions is forgotten in '
        'each step. ' + _readings(tracks),
        numbers,
        pictures,
    )


def of_wind(scope: Scope) -> Row:
    """Figures 6.5-6.7."""
    return _of_air(scope, 10.0, OF_WIND, '6.5-6.7', (3.0, 1.0), {'thesis, start': 6e-4}, 0.1)


def of_storm(scope: Scope) -> Row:
    """Figures 6.8-6.9."""
    said = {'thesis, peak': 0.05, 'thesis, end': 5e-4}
    return _of_air(scope, 100.0, OF_STORM, '6.8-6.9', (30.0, 0.3), said, 1.0)


def _of_air(
    scope: Scope,
    fastest: float,
    paper: str,
    figure: str,
    force: tuple[float, float],
    said: dict[str, float],
    worst: float,
) -> Row:
    frames = blown(fastest)
    scope.progress(0.5)
    tracks = recipes(frames, 100.0, 1.0)
    scope.progress(0.3)
    tracks['ours'] = tracked(for_wind(*force), frames)
    scope.progress(0.2)
    first = figure.split('-')[0]
    last = figure.split('-')[1]
    names = f'figure_{first}.png', f'figure_{last}.png'
    pictures = (
        _snapshots(scope, frames, tracks['ours'], names[0]),
        scope.save(errors(tracks, said, worst), names[1]),
    )
    sigma, tau = force
    return Row(
        figure,
        paper,
        words(tracks['recipe']),
        f'{words(tracks["ours"])} (a force of {sigma:g} N, {tau:g} s on each node as a state)',
        'The air does not calm down, as its velocity is drawn at every step, so neither do the '
        'errors; the recipe knows no force that lasts. ' + _readings(tracks),
        numbers_of(tracks),
        pictures,
    )


def _turn() -> float:
    """Angle [rad] by which the stiffest mode turns in 0.1 s."""
    return carried(*small_sheet(), TS).omega * TS


def _snapshots(scope: Scope, frames: Frames, ours: Track, name: str) -> str:
    times = (0.1, 0.8, 5.0, 10.0)
    rows = [round(time / TS) - 1 for time in times]
    actual = frames.actual[[round(time / frames.interval) for time in times]]
    shown = {'measured': actual, 'ours, predicted 0.1 s before': actual + ours.error[rows]}
    edges = grid(5, 5).edges
    return scope.save(sheets(shown, edges, times, ('tab:blue', 'tab:red')), name)


EXPERIMENTS = (
    Experiment(figures(6, 1, 3), OF_NOISE, of_noise),
    Experiment(figures(6, 5, 7), OF_WIND, of_wind),
    Experiment(figures(6, 8, 9), OF_STORM, of_storm),
)
