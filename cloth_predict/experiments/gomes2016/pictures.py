"""Pictures that several experiments draw: errors over time, and sheets in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cloth_predict.experiments.gomes2016.frames import Track
from cloth_predict.experiments.plots import panels
from cloth_predict.types import FloatArray, IntArray

mpl.use('Agg')

COLOURS = {
    'recipe': 'tab:orange',
    'recipe, 0.01 s': 'tab:brown',
    'I + Ts J, 0.01 s': 'tab:purple',
    'ours': 'tab:red',
    'hold': '0.6',
}
"""Of the filters that several pictures show."""


MANY = 200
"""Edges from which on thick lines would cover the picture."""


def over_time(
    axes: Axes,
    lines: Mapping[str, tuple[FloatArray, FloatArray]],
    label: str,
    said: Mapping[str, float],
) -> None:
    """Draw values over times [s] on a log axis, and what the thesis says as level lines."""
    for name, (times, values) in lines.items():
        known = np.isfinite(values) & (values > 0)
        axes.plot(times[known], values[known], color=COLOURS.get(name), label=name, linewidth=1.1)
    for name, value in said.items():
        axes.axhline(value, color='0.4', linestyle='--', linewidth=0.8)
        axes.annotate(
            name, (1.0, value), xycoords=('axes fraction', 'data'), fontsize=7, ha='right',
            va='bottom', color='0.3',
        )  # fmt: skip
    axes.set(yscale='log', xlabel='time [s]', ylabel=label)
    axes.grid(alpha=0.3)


def errors(tracks: Mapping[str, Track], said: Mapping[str, float], worst: float) -> Figure:
    """Mean squared error (6.12), and the distance of the node that is farthest (6.13).

    said: mean squared errors [m^2] of the thesis by what they are; worst [m]: its worst node.
    """
    figure, (left, right) = panels(2)
    over_time(left, {n: (t.times, t.mse) for n, t in tracks.items()}, 'MSE [m²]', said)
    farthest = {n: (t.times, t.distance.max(axis=1)) for n, t in tracks.items()}
    over_time(right, farthest, 'worst node [m]', {'thesis': worst})
    right.legend(loc='upper left', bbox_to_anchor=(1, 1))
    return figure


def sheets(
    shown: Mapping[str, FloatArray],
    edges: IntArray,
    times: Sequence[float],
    colours: Sequence[str],
) -> Figure:
    """Nodes [m], (times, nodes, 3), and the edges that join them, one over the other at each time.

    Seen from the side, y up; what comes later is drawn thinner, so that what it covers shows.
    """
    figure = Figure(figsize=(3.2 * len(times), 4.4), layout='constrained')
    every = np.concatenate([nodes.reshape(-1, 3) for nodes in shown.values()])
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    for k, time in enumerate(times):
        axes = figure.add_subplot(1, len(times), k + 1, projection='3d')
        widths = np.linspace(3.0 if len(edges) < MANY else 1.0, 1.0, len(shown))
        for (name, nodes), colour, width in zip(shown.items(), colours, widths, strict=True):
            gap = np.full((len(edges), 1, 3), np.nan)  # one line with gaps draws faster than many
            line = np.concatenate([nodes[k][edges], gap], axis=1).reshape(-1, 3)
            axes.plot(
                line[:, 0], line[:, 2], line[:, 1], color=colour, label=name, linewidth=width
            )
        axes.set_box_aspect(np.maximum(high - low, 0.05)[[0, 2, 1]])
        axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), zlim=(low[1], high[1]))
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_major_locator(MaxNLocator(3))
        axes.view_init(elev=12, azim=-60)
        axes.tick_params(labelsize=6)
        axes.set_title(f't = {time:.1f} s', fontsize=10)
    figure.legend(*axes.get_legend_handles_labels(), loc='lower center', ncols=4)
    return figure
