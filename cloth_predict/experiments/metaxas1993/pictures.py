"""Pictures of bodies in space, and of the points that they follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cloth_predict.types import FloatArray, IntArray

mpl.use('Agg')

COLOURS = ('tab:orange', 'tab:blue', 'tab:green', 'tab:red', 'tab:purple')
"""Of the parts, in turn."""


@dataclass(frozen=True)
class Shown:
    """One panel: parts, each with positions, (N, 3), and triangles, (t, 3), and points, (m, 3)."""

    title: str
    parts: Sequence[tuple[FloatArray, IntArray]]
    points: FloatArray


def bodies(
    panels: Sequence[Shown],
    columns: int,
    view: tuple[float, float] = (15.0, -60.0),
    tall: float = 1.2,
) -> Figure:
    """Draw bodies as nets over their points, all panels to the same scale; z is up.

    view: elevation and azimuth [degrees]; tall: height of a panel by its width.
    """
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.0 * columns, 3.0 * tall * rows), layout='constrained')
    every = [position for panel in panels for position, _ in panel.parts]
    everything = np.concatenate([*every, *(panel.points for panel in panels)])
    low, high = np.percentile(everything, 0.5, axis=0), np.percentile(everything, 99.5, axis=0)
    middle, size = (low + high) / 2, 0.55 * np.maximum(high - low, 0.15 * (high - low).max())
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(rows, columns, k + 1, projection='3d')
        for (position, triangles), colour in zip(panel.parts, COLOURS, strict=False):
            axes.plot_trisurf(
                *position.T, triangles=triangles, color=colour, alpha=0.35, edgecolor=colour,
                linewidth=0.4,
            )  # fmt: skip
        axes.plot(*panel.points.T, 'k.', markersize=2.0)
        axes.set_box_aspect(tuple(size), zoom=1.05)  # it would change an array
        axes.set(
            xlim=(middle[0] - size[0], middle[0] + size[0]),
            ylim=(middle[1] - size[1], middle[1] + size[1]),
            zlim=(middle[2] - size[2], middle[2] + size[2]),
        )
        axes.view_init(*view)
        axes.tick_params(labelsize=5, pad=-2)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_major_locator(MaxNLocator(3))
        axes.set_title(panel.title, fontsize=9)
    return figure
