"""Figures 6.19-6.21: each row of nodes at the time at which it is drawn (Gomes 2016, 6.5)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes

from cloth_predict.config import Config
from cloth_predict.evaluation.projection import project
from cloth_predict.evaluation.projection_methods import METHODS
from cloth_predict.evaluation.projection_report import Misregistration
from cloth_predict.experiments.gomes2016.frames import TS, Frames
from cloth_predict.experiments.gomes2016.pictures import COLOURS
from cloth_predict.experiments.gomes2016.recursion import EulerStep, followed
from cloth_predict.experiments.gomes2016.shaken import small_sheet
from cloth_predict.experiments.gomes2016.simulated import for_noise, shaken
from cloth_predict.experiments.gomes2016.towel import ALPHA, BETA, fan, frames_of, recipe_model
from cloth_predict.experiments.plots import panels
from cloth_predict.experiments.rows import Experiment, Row, Scope, figures, short
from cloth_predict.formats.recording import read
from cloth_predict.share import find
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import FloatArray

PAPER = (
    'p + m dT v of each row m, dT = 1 / (fps (rows - 1)), at 24 and 10 fps: nearer to where the '
    'row is than the last measurement; at 10 fps its last row is that of the EKF'
)
FIRST = 1.0
"""Frames that start before this time [s] are not judged."""


@dataclass(frozen=True)
class Drawn:
    """How far each row is off when it is drawn, by method.

    error [m], RMS, shape (rows,), by name; dt [s], shape (rows,): when each row is drawn; shown
    [m], (rows, cols, 3), by name: one frame, where the method draws it, and where it then is.
    """

    dt: FloatArray
    error: dict[str, FloatArray]
    shown: dict[str, FloatArray]


def row_times(fps: float, rows: int) -> FloatArray:
    """Times after the start of a frame at which the rows are drawn [s], (rows,) (6.22)."""
    return np.arange(rows) / (fps * (rows - 1))


def draw(
    config: Config,
    mesh: EulerStep,
    frames: Frames,
    grid: tuple[int, int],
    fps: float,
    noise: tuple[float, float],
) -> Drawn:
    """Draw a frame every 0.1 s from what is measured at its start.

    By the last measurement (`hold`), by (6.23) with the state of the recursion of the thesis with
    the Jacobian of its step, and by the tracker, which runs its model to the time of each row.
    noise: alpha and beta of Q = alpha I and R = beta I.
    """
    rows, cols = grid
    dt, every = row_times(fps, rows), round(TS / frames.interval)
    states = followed(mesh, frames.filled(), *noise, frames.interval)
    tracker = Tracker(config)
    squares: dict[str, list[FloatArray]] = {'hold': [], 'recipe': [], 'ours': []}
    shown: dict[str, FloatArray] = {}
    held = frames.filled().positions
    for k in range(len(held)):
        tracker.step(
            round(k * frames.interval * NANOSECONDS), frames.positions[k], frames.visible[k]
        )
        if k % every or k * frames.interval < FIRST or k + every >= len(held):
            continue
        place = np.arange(rows * cols).reshape(rows, cols)
        actual = np.stack([_at(frames, k, t)[place[m]] for m, t in enumerate(dt)])
        position, velocity = states[k]
        found = {
            'hold': held[k][place],
            'recipe': (position + dt.repeat(cols)[:, None] * velocity)[place],  # 6.23
            'ours': np.stack([tracker.predict(t).position[place[m]] for m, t in enumerate(dt)]),
        }
        for name, drawn in found.items():
            squares[name].append(np.square(drawn - actual).sum(axis=2).mean(axis=1))
        shown = {'actual': actual} | found
    error = {name: np.sqrt(np.mean(values, axis=0)) for name, values in squares.items()}
    return Drawn(dt, error, shown)


def _at(frames: Frames, k: int, later: float) -> FloatArray:
    """Where the nodes are some time [s] after a frame [m], (nodes, 3), straight between frames."""
    at = k + later / frames.interval
    low = min(int(at + 1e-9), len(frames.actual) - 2)
    share = at - low
    return np.asarray((1 - share) * frames.actual[low] + share * frames.actual[low + 1])


def run(scope: Scope) -> Row:
    """Draw the sheet of figure 6.1 at 24 and 10 fps, and the towel at 10 fps; light the towel."""
    cloth, _ = small_sheet()
    sheet, stepped = shaken(), EulerStep(cloth, 0.01)
    found = {}
    for fps in (24.0, 10.0):
        label = f'sheet, {fps:g} fps'
        found[label] = draw(for_noise(), stepped, sheet, (5, 5), fps, (1e-3, 1.0))
        scope.progress(0.25)
    case, config = fan()
    frames = frames_of(case)
    mesh = EulerStep(recipe_model(config, frames), frames.interval)
    found['towel, 10 fps'] = draw(config, mesh, frames, (5, 4), 10.0, (ALPHA, BETA))
    scope.progress(0.25)
    light = _light(config)
    scope.progress(0.25)
    numbers = {
        f'{label}: {name}, last row [m]': float(error[-1])
        for label, drawn in found.items()
        for name, error in drawn.error.items()
    }
    numbers |= {f'light on the towel, {m}: 95 % [m]': 1e-3 * p for m, p in light.items()}

    def last(name: str) -> str:
        values = ', '.join(
            f'{short(1e3 * drawn.error[name][-1])} mm ({label})' for label, drawn in found.items()
        )
        return f'last row {values}'

    figure, axes = panels(3, 4.2)
    for place, (label, drawn) in zip(axes, found.items(), strict=True):
        _errors(place, drawn, label)
    axes[-1].legend(loc='upper left', bbox_to_anchor=(1, 1))
    pictures = (
        scope.save(figure, 'figure_6.19.png'),
        _rows(scope, found['towel, 10 fps'], 'figure_6.21.png'),
    )
    return Row(
        '6.19-6.21',
        PAPER,
        f'{last("recipe")}; the last measurement instead: {last("hold")}',
        f'{last("ours")}; light on the towel by `project`, 95 % within '
        + ', '.join(f'{short(light[m])} mm ({m})' for m in METHODS),
        'By the letter the velocities are lost (figures 6.2 and 6.15), so that (6.23) is given '
        'those of the recursion with I + Ts J in place of J every 0.01 s. It holds the velocity '
        'for the time of a frame, where ours runs the model to each row.',
        numbers,
        pictures,
    )


def _light(config: Config) -> dict[str, float]:
    """Distance [mm] on the towel within which 95 % of the light lands, by method, at 10 fps."""
    case, _ = fan()
    slow = replace(config, projector=replace(config.projector, fps=10.0))
    recording = read(find('bags/towel_fan'))
    found = project(case, recording.truth, slow, 0.0)
    return {method: Misregistration.of(found, method).p95_mm for method in METHODS}


def _errors(axes: Axes, drawn: Drawn, label: str) -> None:
    for name, error in drawn.error.items():
        axes.plot(1e3 * drawn.dt, 1e3 * error, 'o-', color=COLOURS[name], label=name, markersize=4)
    axes.set(
        xlabel='time at which the row is drawn [ms]',
        ylabel='RMS error of the row [mm]',
        title=label,
    )
    axes.grid(alpha=0.3)


def _rows(scope: Scope, drawn: Drawn, name: str) -> str:
    """Rows of the last frame, from above and from the side, as in figure 6.21."""
    figure, (axes,) = panels(1, 7.0, 4.2)
    colours = COLOURS | {'actual': 'tab:blue'}
    for method, nodes in drawn.shown.items():
        for m, row in enumerate(nodes):
            label = method if m == 0 else None
            axes.plot(
                1e3 * row[:, 2], row[:, 1], 'o-', color=colours[method], label=label, markersize=3
            )
    axes.set(xlabel='out of the plane [mm]', ylabel='height [m]', title='rows when they are drawn')
    axes.grid(alpha=0.3)
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    return scope.save(figure, name)


EXPERIMENTS = (Experiment(figures(6, 19, 21), PAPER, run),)
