"""What pictures of experiments begin with."""

from __future__ import annotations

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

mpl.use('Agg')


def panels(count: int, width: float = 5.0, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes beside each other."""
    figure = Figure(figsize=(width * count, height), layout='constrained')
    return figure, [figure.add_subplot(1, count, k + 1) for k in range(count)]
