"""The curve of the cost of a search."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from cloth_predict.formats.files import writing

mpl.use('Agg')


def draw(trace: Sequence[tuple[int, float]], label: str, evaluations: int, path: Path) -> None:
    """Best RMS distance [mm] over evaluations, on log axes; it stays until it falls again.

    trace: evaluations and the best distance after them, at the first and whenever it fell.
    Raises FormatError where the picture cannot be written.
    """
    figure = Figure(figsize=(7, 4), layout='constrained')
    axes = figure.add_subplot()
    number, best = zip(*trace, (evaluations, trace[-1][1]), strict=True)
    axes.step(number, best, where='post', color='tab:red', label=label)
    axes.set(
        xscale='log',
        yscale='log',
        xlabel='evaluations of the model',
        ylabel='RMS error [mm]',
        title='Best error of the search',
    )
    axes.grid(which='both', color='0.9')
    axes.legend()
    with writing(path):
        figure.savefig(path, dpi=120)
