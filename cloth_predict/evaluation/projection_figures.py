"""Pictures of what compensation buys; each is drawn from the numbers alone."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cloth_predict.evaluation.projection import METHODS, Compensation
from cloth_predict.evaluation.projection_report import JUST_NOTICEABLE
from cloth_predict.types import FloatArray

mpl.use('Agg')

COLOURS = {'none': '0.6', 'frame': 'tab:blue', 'rows': 'tab:orange', 'full': 'tab:red'}
LEGEND = {
    'none': 'none: where each marker was last',
    'frame': 'frame: predicted for the start of the frame',
    'rows': 'rows: moved on by the time of the row of nodes',
    'full': 'full: at the moment its own line is lit',
}
PARTS = 5
"""Of the vertices by when they are lit, each with an error of its own."""


def fastest(found: Compensation) -> int:
    """Return the frame of the most vertices that count in which the last frame serves worst."""
    counts = found.judged.sum(axis=(1, 2))
    full = counts == counts.max()
    worst = np.nanmax(np.where(np.isfinite(found.error[0]), found.error[0], 0.0), axis=(1, 2))
    return int(np.argmax(np.where(full, worst, -1.0)))


def rows_of_frame(found: Compensation, frame: int, path: Path) -> None:
    """Each row of nodes at one frame, as it truly is when it is lit and as each method draws it.

    Seen from the side, as Gomes 2016, figures 6.19-6.21, and how far from the truth.
    """
    field = 0
    actual, shown = found.actual[frame, field], found.shown(frame).position[:, field]
    moved = actual - shown[0]
    known = np.isfinite(moved).all(axis=1)
    along = np.linalg.svd(moved[known], full_matrices=False)[2][0]
    along = along * np.sign(moved[known].sum(axis=0) @ along)
    across = -found.pinhole.rotation[0 if found.scan.columns else 1]
    across = across - (across @ along) * along
    across /= np.linalg.norm(across)
    figure = Figure(figsize=(14, 5), layout='constrained')
    left, right = figure.subplots(1, 2)
    model = found.config.model
    for name, place in [('true', actual), *zip(METHODS, shown, strict=True)]:
        colour = COLOURS.get(name, 'k')
        label = LEGEND.get(name, 'where it truly is when it is lit')
        style = {'color': colour, 'markersize': 3, 'linewidth': 1.0}
        for k, row in enumerate(_rows(place, model.shape, found.scan.columns)):
            left.plot(1e3 * row @ along, 1e3 * row @ across, 'o-', **style,
                      label=label if k == 0 else None)  # fmt: skip
        if name != 'true':
            right.plot(1e3 * (place - actual) @ along, 1e3 * found.dt[frame, field], 'o', **style)
    right.axvline(0, color='k', linewidth=1)
    right.invert_yaxis()
    left.set(
        xlabel='position along the motion [mm]',
        ylabel='position along the scan [mm]',
        title=f'Rows of nodes in the frame at {_seconds(found, frame):.2f} s',
    )
    right.set(
        xlabel='from where it truly is when it is lit [mm]',
        ylabel='when it is lit, from the start of the frame [ms]',
        title='Error along the motion',
    )
    right.grid(alpha=0.3)
    right.legend(*left.get_legend_handles_labels(), loc='upper left', bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=120)


def _rows(place: FloatArray, shape: tuple[int, int], columns: bool) -> FloatArray:
    """Rows of nodes as the scan has them, shape (rows, nodes of a row, 3)."""
    grid = place.reshape(*shape, 3)
    return grid.swapaxes(0, 1) if columns else grid


def errors(found: Compensation, path: Path) -> None:
    """Error by the time within the frame, by its share, and over the recording."""
    figure = Figure(figsize=(13, 4), layout='constrained')
    by_time, share, over = figure.subplots(1, 3)
    _by_time(found, by_time)
    _shares(found, share)
    _over_time(found, over)
    figure.suptitle(
        f'Misregistration at {found.scan.fps:g} Hz, {1e3 * found.delay:g} ms after the markers'
    )
    share.legend(loc='upper left')
    figure.savefig(path, dpi=120)


def _by_time(found: Compensation, axes: Axes) -> None:
    dt = found.dt[found.judged]
    parts = np.array_split(np.argsort(dt), PARTS)
    when = [1e3 * np.median(dt[part]) for part in parts]
    for name, error in zip(METHODS, found.error, strict=True):
        mm = 1e3 * error[found.judged]
        p95 = [np.percentile(mm[part], 95) for part in parts]
        axes.plot(when, p95, 'o-', color=COLOURS[name], markersize=4, label=name)
    axes.axhline(JUST_NOTICEABLE, color='k', linestyle=':', linewidth=1)
    axes.set(
        xlabel='when it is lit, from the start of the frame [ms]',
        ylabel='95 % of the errors are below [mm]',
        yscale='log',
    )
    axes.grid(alpha=0.3, which='both')


def _shares(found: Compensation, axes: Axes) -> None:
    for name, error in zip(METHODS, found.error, strict=True):
        mm = np.sort(1e3 * error[found.judged])
        axes.plot(mm, np.arange(1, len(mm) + 1) / len(mm), color=COLOURS[name], label=name)
    axes.axvline(JUST_NOTICEABLE, color='k', linestyle=':', linewidth=1, label='just noticeable')
    least = max(0.05, float(np.nanpercentile(1e3 * found.error, 1)))
    axes.set(xlabel='error [mm]', ylabel='share of the errors below', xscale='log',
             xlim=(least, None), ylim=(0, 1.01))  # fmt: skip
    axes.grid(alpha=0.3, which='both')


def _over_time(found: Compensation, axes: Axes) -> None:
    frames = found.judged_frames
    time = [_seconds(found, frame) for frame in frames]
    for name, error in zip(METHODS, found.error, strict=True):
        p95 = np.nanpercentile(1e3 * error[frames].reshape(len(frames), -1), 95, axis=1)
        axes.plot(time, p95, color=COLOURS[name], linewidth=0.8, label=name)
    axes.axhline(JUST_NOTICEABLE, color='k', linestyle=':', linewidth=1)
    axes.set(
        xlabel='time [s]', ylabel='95 % of the errors of a frame are below [mm]', yscale='log'
    )
    axes.grid(alpha=0.3, which='both')


def _seconds(found: Compensation, frame: int) -> float:
    return 1e-9 * float(found.starts[frame] - found.surface.vertices.start)
