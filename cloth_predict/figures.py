"""Pictures of an evaluation; each is drawn from the numbers alone."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from cloth_predict.evaluation import Evaluation
from cloth_predict.types import FloatArray

mpl.use('Agg')

COLOURS = {
    'hold': '0.6',
    'kf_cv': 'tab:blue',
    'kf_ca': 'tab:cyan',
    'ekf': 'tab:red',
    'ekf_live': 'darkred',
}


def error_over_time(evaluation: Evaluation, path: Path) -> None:
    """Root mean square error over the markers of each frame, one line per method."""
    figure = Figure(figsize=(9, 4), layout='constrained')
    axes = figure.add_subplot()
    seconds = (evaluation.targets - evaluation.start) / 1e9
    for name, errors in evaluation.errors.items():
        seen = np.isfinite(errors).any(axis=1)
        mean_square = np.nanmean(np.square(errors[seen]), axis=1)
        rmse = evaluation.scores[name].rmse_mm
        axes.plot(
            seconds[seen],
            1e3 * np.sqrt(mean_square),
            color=COLOURS.get(name),
            linewidth=1.6 if name.startswith('ekf') else 1.0,
            label=f'{name}: {rmse:.1f} mm RMS',
        )
    axes.set(
        xlabel='time of the recording [s]',
        ylabel='error of the prediction [mm]',
        title=f'Predicted {1e3 * evaluation.horizon:g} ms ahead',
        xlim=(seconds[0], seconds[-1]),
        ylim=(0, None),
    )
    axes.grid(alpha=0.3)
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=120)


def snapshots(
    evaluation: Evaluation, rows: int, cols: int, path: Path, method: str = 'ekf', count: int = 4
) -> None:
    """Predicted over actual nodes at the moments of fastest and slowest motion between them.

    The figure looks along the direction in which the surface extends least, turned a little, with
    equal scales (as Gomes 2016, figure 6.14).
    """
    figure = Figure(figsize=(3.2 * count, 4.4), layout='constrained')
    frames = np.linspace(0, len(evaluation.targets) - 1, count + 1).astype(int)[1:]
    actual, predicted = evaluation.actual, evaluation.predicted[method]
    held = evaluation.predicted.get('hold')
    bounds = actual.reshape(-1, 3)
    low, high = np.nanmin(bounds, axis=0), np.nanmax(bounds, axis=0)
    for place, k in enumerate(frames):
        axes = figure.add_subplot(1, count, place + 1, projection='3d')
        if held is not None:
            _draw_grid(axes, held[k], rows, cols, '0.75', 'hold')
        _draw_grid(axes, actual[k], rows, cols, 'tab:blue', 'actual')
        _draw_grid(axes, predicted[k], rows, cols, 'tab:red', 'predicted')
        axes.set_box_aspect(np.maximum(high - low, 0.05)[[0, 2, 1]])
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[2], high[2])
        axes.set_zlim(low[1], high[1])
        axes.view_init(elev=12, azim=-60)
        axes.tick_params(labelsize=6)
        seconds = (evaluation.targets[k] - evaluation.start) / 1e9
        axes.set_title(f't = {seconds:.1f} s', fontsize=10)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=3)
    figure.savefig(path, dpi=120)


def _draw_grid(
    axes: mpl.axes.Axes, nodes: FloatArray, rows: int, cols: int, colour: str, label: str
) -> None:
    grid = nodes.reshape(rows, cols, 3)
    for n, line in enumerate([*grid, *grid.transpose(1, 0, 2)]):
        axes.plot(
            line[:, 0],
            line[:, 2],
            line[:, 1],
            color=colour,
            linewidth=0.9,
            marker='o',
            markersize=2.0,
            label=label if n == 0 else None,
        )
