"""Figures 6.14 and 6.15: the filter on a towel in a fan, and on a real rope.

The recordings of the thesis are not published. The towel is the simulated one of bags/towel_fan,
of the same size, mass and markers; the rope is a real one, where its recordings are at hand.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cloth_predict.config import Config, load
from cloth_predict.evaluation.cases import Case, case_of
from cloth_predict.evaluation.judging import WARM_UP
from cloth_predict.experiments.gomes2016.frames import TS, Frames, Track, held
from cloth_predict.experiments.gomes2016.pictures import over_time, sheets
from cloth_predict.experiments.gomes2016.recursion import EulerStep, by_the_letter, tracked
from cloth_predict.experiments.gomes2016.shaken import DAMPING, STIFFNESS
from cloth_predict.experiments.gomes2016.simulated import RECIPES
from cloth_predict.experiments.plots import panels
from cloth_predict.experiments.rows import Experiment, Row, Scope, figures, short
from cloth_predict.formats.recording import read
from cloth_predict.metrics import at_times
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.stiffness import carried
from cloth_predict.share import find
from cloth_predict.surface.assembly import build_mass_spring
from cloth_predict.surface.topology import grid

IN_FAN = (
    'towel in a fan, m 0.017, k 300, d 0.08, Q 100 I, R I: MSE peaks of 7e-4 m² each 5 s, '
    '< 2.5e-5 m² at 7.5 s'
)
ALPHA, BETA = 100.0, 1.0
"""Of Q = alpha I and R = beta I (Gomes 2016, section 6.4)."""
ROPE = 'rope/rope_take4.csv'
"""A take on which config/rope.yaml was not set."""


@lru_cache(maxsize=1)
def fan() -> tuple[Case, Config]:
    """Recording of the towel, as it is judged by its truth, and the settings of the tracker."""
    config = load(find('config/towel.yaml'))
    path = find('bags/towel_fan')
    return case_of(read(path), config, str(path)), config


def frames_of(case: Case) -> Frames:
    """Markers of a case at even times, and what they are held against: the truth where known."""
    stamps = case.markers.stamps
    interval = int(np.median(np.diff(stamps)))
    even = stamps[0] + interval * np.arange((stamps[-1] - stamps[0]) // interval + 1)
    positions, visible = at_times(case.markers, even)
    actual, known = at_times(case.reference.markers, even)
    positions = np.where(visible[..., None], positions, np.nan)
    return Frames(1e-9 * interval, positions, visible, np.where(known[..., None], actual, np.nan))


def arbitrary(config: Config) -> Config:
    """Return the settings with the springs of the thesis: one node per marker, k 300, d 0.08."""
    springs = replace(
        config.model,
        refine=1,
        compression=1.0,
        compression_flexion=-1.0,
        prestretch=0.0,
        damping=DAMPING,
        stiffness_structural=STIFFNESS,
        stiffness_shear=STIFFNESS,
        stiffness_flexion=STIFFNESS,
    )
    still = replace(config.wind, kind='none'), replace(config.force, kind='none')
    return replace(config, model=springs, wind=still[0], force=still[1])


def recipe_model(config: Config, frames: Frames) -> MassSpring:
    """Build the mesh of the thesis for these markers."""
    return build_mass_spring(arbitrary(config), frames.positions[0])


def readings(mesh: MassSpring, frames: Frames) -> dict[str, Track]:
    """Run the recursion of the thesis as in `simulated.recipes`, on markers without gaps."""
    frames, short_step = frames.filled(), frames.interval
    found = (
        by_the_letter(mesh, frames, ALPHA, BETA),
        by_the_letter(mesh, frames, ALPHA, BETA, short_step),
        by_the_letter(EulerStep(mesh, short_step), frames, ALPHA, BETA, short_step),
    )
    return dict(zip(RECIPES, found, strict=True))


def words(track: Track) -> str:
    """Return the errors of a filter after its first second as a sentence."""
    late = track.after(WARM_UP)
    if not np.isfinite(late.rms):
        return f'lost after {track.lost:.2g} s'
    return (
        f'MSE peak {short(late.peak)}, least of a second {short(_calmest(late), "m²")}; '
        f'{short(1e3 * late.rms, "mm")} RMS'
    )


def _calmest(track: Track) -> float:
    """Least mean of the mean squared errors of a second [m^2]."""
    means = [track.around(time) for time in np.arange(2.0, track.times[-1] + 1e-9, 0.5)]
    return float(np.nanmin(means))


def in_fan(scope: Scope) -> Row:
    """Figures 6.14 and 6.15 on the simulated towel."""
    case, config = fan()
    frames = frames_of(case)
    scope.progress(0.1)
    mesh = recipe_model(config, frames)
    tracks = readings(mesh, frames)
    scope.progress(0.2)
    tracks |= {'ours': tracked(config, frames), 'hold': held(frames)}
    tracks['hold, 0.01 s'] = held(frames, frames.interval)
    scope.progress(0.5)
    coarse = tracked(load(find('config/towel_coarse.yaml')), frames)
    scope.progress(0.2)
    pictures = (
        _snapshots(scope, frames, tracks['ours'], 'figure_6.14.png'),
        _errors(scope, tracks, 'figure_6.15.png', {'thesis, peak': 7e-4, 'thesis, calm': 2.5e-5}),
    )
    return _row(
        '6.14-6.15',
        tracks,
        pictures,
        f'; a node per marker: {words(coarse)}',
        _omega(mesh, frames),
    )


def on_rope(scope: Scope) -> Row:
    """Figures 6.14 and 6.15 on the real rope."""
    name = '6.14-6.15 rope'
    if scope.data is None or not (scope.data / ROPE).exists():
        return Row.left_out(name, IN_FAN, f'needs --data, a folder with {ROPE}')
    config, path = load(find('config/rope.yaml')), scope.data / ROPE
    frames = frames_of(case_of(read(path), config, str(path)))
    mesh = build_mass_spring(
        replace(arbitrary(config), model=replace(arbitrary(config).model, rest_length='measured')),
        frames.positions[0],
    )
    tracks = readings(mesh, frames)
    scope.progress(0.5)
    tracks |= {'ours': tracked(config, frames), 'hold': held(frames)}
    tracks['hold, 0.01 s'] = held(frames, frames.interval)
    scope.progress(0.5)
    pictures = (_errors(scope, tracks, 'figure_6.15_rope.png', {}),)
    return _row(name, tracks, pictures, ', both hands included', _omega(mesh, frames))


def _row(
    name: str, tracks: dict[str, Track], pictures: tuple[str, ...], more: str, omega: float
) -> Row:
    shorter, stepped = (tracks[reading] for reading in RECIPES[1:])
    soon, numbers = tracks['hold, 0.01 s'].after(WARM_UP), dict[str, float]()
    for who, track in tracks.items():
        late = track.after(WARM_UP)
        numbers |= {f'{who}: peak MSE [m^2]': late.peak, f'{who}: RMS distance [m]': late.rms}
    return Row(
        name,
        IN_FAN,
        words(tracks['recipe']),
        words(tracks['ours']) + more,
        f'k 300 N/m on masses this small makes modes of up to {omega:.0f} rad/s, of which '
        f'explicit Euler at 0.1 s makes anything. Every 0.01 s: {words(shorter)}. With I + Ts J '
        f'in place of J every 0.01 s: {words(stepped)}; it looks 0.01 s ahead, where the last '
        f'measurement is off by {short(1e3 * soon.rms, "mm")} RMS. Held for 0.1 s the last '
        f'measurement has {words(tracks["hold"])}. Ours has the unknown forces among its states, '
        'and steps that carry such springs.',
        numbers,
        pictures,
    )


def _omega(mesh: MassSpring, frames: Frames) -> float:
    """Angular frequency of the fastest mode [rad/s]."""
    return carried(mesh, frames.positions[0], TS).omega


def _errors(scope: Scope, tracks: dict[str, Track], name: str, said: dict[str, float]) -> str:
    figure, (axes,) = panels(1, 7.0)
    over_time(axes, {n: (t.times, t.mse) for n, t in tracks.items()}, 'MSE [m²]', said)
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    return scope.save(figure, name)


def _snapshots(scope: Scope, frames: Frames, ours: Track, name: str) -> str:
    times = (0.1, 2.0, 5.0, 10.0)
    rows = [round(time / TS) - 1 for time in times]
    actual = frames.actual[[round(time / frames.interval) for time in times]]
    shown = {'actual': actual, 'ours, predicted 0.1 s before': actual + ours.error[rows]}
    _, config = fan()
    edges = grid(config.model.rows, config.model.cols).edges
    return scope.save(sheets(shown, edges, times, ('tab:blue', 'tab:red')), name)


EXPERIMENTS = (
    Experiment(figures(6, 14, 15), IN_FAN, in_fan),
    Experiment(figures(6, 14, 15), IN_FAN, on_rope, 'rope'),
)
