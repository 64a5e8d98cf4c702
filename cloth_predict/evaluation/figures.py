"""Pictures of an evaluation; each is drawn from the numbers alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import inf
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from cloth_predict.config import ModelConfig
from cloth_predict.errors import ConfigError
from cloth_predict.evaluation.compare import Evaluation
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.surface.assembly import topology_of
from cloth_predict.types import FloatArray, IntArray

mpl.use('Agg')

BASELINES = {'hold': '0.6', 'kf_cv': 'tab:blue', 'kf_ca': 'tab:cyan', 'rigid': 'tab:blue'}
OTHERS = (
    'tab:red', 'tab:orange', 'tab:green', 'tab:purple', 'tab:brown', 'tab:pink', 'tab:olive', 'k',
)  # fmt: skip
NORMAL = (0.682689, 0.954500, 0.997300)
"""Share of normal errors within 1, 2 and 3 sigma."""
FARTHEST = 100.0
"""Times the least error of a horizon, beyond which a method would press all others together."""


def colours(methods: Iterable[str]) -> dict[str, str]:
    """Return a colour for each method: the baselines have theirs, the others come in turn."""
    others = [name for name in methods if name not in BASELINES]
    return BASELINES | {name: OTHERS[i % len(OTHERS)] for i, name in enumerate(others)}


def ladder(evaluations: Sequence[Evaluation], path: Path) -> None:
    """RMS error of each method at each horizon, with its 95 % interval, on a log axis.

    What is above a hundred times the best method of its horizon is left out, and named.
    """
    figure = Figure(figsize=(9, 4), layout='constrained')
    axes = figure.add_subplot()
    names = list(evaluations[0].scores)
    chosen, width = colours(names), 0.8 / len(names)
    least = [min(s.rmse_mm for s in e.scores.values()) for e in evaluations]
    for i, name in enumerate(names):
        rmse = np.array([e.scores[name].rmse_mm for e in evaluations])
        ends = np.array([e.scores[name].rmse_95_mm for e in evaluations]).T
        place = np.arange(len(rmse)) + (i - (len(names) - 1) / 2) * width
        inside = rmse < FARTHEST * np.maximum(least, 1e-3)
        lost = 'beyond the axis' if np.isfinite(rmse).all() else 'no prediction'
        label = name if inside.all() else f'{name}: {lost}'
        axes.plot(place[inside], rmse[inside], 'o', color=chosen[name], label=label)
        axes.vlines(place[inside], *ends[:, inside], color=chosen[name], linewidth=2)
    for between in range(1, len(evaluations)):
        axes.axvline(between - 0.5, color='0.8', linewidth=0.8)
    axes.set(
        xlabel='horizon',
        title='Error of each method, with its 95 % interval',
        xlim=(-0.5, len(evaluations) - 0.5),
        xticks=range(len(evaluations)),
        xticklabels=[f'{1e3 * evaluation.horizon:g} ms' for evaluation in evaluations],
    )
    _millimetres(axes, 'RMS error [mm]')
    figure.savefig(path, dpi=120)


def coverage(evaluation: Evaluation, path: Path) -> None:
    """Share of the errors within 1, 2 and 3 predicted sigma, beside that of a normal error."""
    figure = Figure(figsize=(6.5, 4), layout='constrained')
    axes = figure.add_subplot()
    axes.plot((1, 2, 3), NORMAL, 's--', color='0.3', linewidth=1, label='normal error')
    chosen = colours(evaluation.scores)
    for name, found in evaluation.details.items():
        if found.coverage is not None:
            axes.plot((1, 2, 3), found.coverage, 'o-', color=chosen[name], label=name)
    axes.set(
        xlabel='predicted sigma',
        ylabel='share of the errors within, free nodes',
        title=f'Does sigma tell the error, {1e3 * evaluation.horizon:g} ms ahead?',
        xticks=(1, 2, 3),
        ylim=(0, 1.03),
    )
    axes.grid(alpha=0.3)
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=120)


def errors_by_speed(evaluation: Evaluation, path: Path) -> None:
    """RMS error of each method at slow, middle and fast motion, on a log axis."""
    figure = Figure(figsize=(7, 4), layout='constrained')
    axes = figure.add_subplot()
    chosen = colours(evaluation.scores)
    ends: list[float] = []
    for name, found in evaluation.details.items():
        ends = [part.up_to_m_s for part in found.by_speed]
        errors = [part.rmse_mm for part in found.by_speed]
        if not np.isfinite(errors).any():
            continue  # it predicted nothing
        axes.plot(range(len(ends)), errors, 'o-', color=chosen[name], label=name, markersize=4)
    axes.set(
        xlabel='speed of the marker, each a third of the errors',
        title=f'Errors by speed, {1e3 * evaluation.horizon:g} ms ahead',
        xlim=(-0.4, len(ends) - 0.6),
        xticks=range(len(ends)),
        xticklabels=[f'up to {end:.2f} m/s' for end in ends],
    )
    _millimetres(axes, 'RMS error [mm], free nodes')
    figure.savefig(path, dpi=120)


def _millimetres(axes: mpl.axes.Axes, label: str) -> None:
    """Give a log axis of errors with a legend beside it."""
    axes.set(yscale='log', ylabel=label)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis='y', alpha=0.3)
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))


def error_over_time(evaluation: Evaluation, path: Path) -> None:
    """Root mean square error over the markers of each frame, one line per method."""
    figure = Figure(figsize=(9, 4), layout='constrained')
    axes = figure.add_subplot()
    judged, chosen = evaluation.judged, colours(evaluation.scores)
    seconds = (judged.targets - judged.start) / 1e9
    highest = {'': 1e-3}
    for name, errors in evaluation.errors.items():
        seen = np.isfinite(errors).any(axis=1)
        if not seen.any():
            continue  # it predicted nothing
        error = 1e3 * np.sqrt(np.nanmean(np.square(errors[seen]), axis=1))
        highest[name], rmse = float(error.max()), evaluation.scores[name].rmse_mm
        axes.plot(
            seconds[seen],
            error,
            color=chosen[name],
            linewidth=1.0 if name in BASELINES else 1.6,
            label=f'{name}: {rmse:.3g} mm RMS',
        )
    usual = max((top for name, top in highest.items() if name in BASELINES), default=inf)
    axes.set(
        xlabel='time of the recording [s]',
        ylabel='error of the prediction [mm]',
        title=f'Predicted {1e3 * evaluation.horizon:g} ms ahead',
        xlim=(seconds[0], seconds[-1]),
        # a method that goes astray does not press the others together
        ylim=(0, 1.05 * min(max(highest.values()), 3 * usual)),
    )
    axes.grid(alpha=0.3)
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=120)


def shown(evaluation: Evaluation) -> str:
    """Return the method whose predictions are drawn: the first that is no baseline, if any."""
    return next((name for name in evaluation.scores if name not in BASELINES), 'hold')


def snapshots(evaluation: Evaluation, edges: IntArray, path: Path, count: int = 4) -> None:
    """Predicted over actual nodes, and the edges, shape (edges, 2), that join them.

    The figure looks along the direction in which the surface extends least, turned a little, with
    equal scales (as Gomes 2016, figure 6.14).
    """
    above_legend = ConstrainedLayoutEngine(rect=(0.0, 0.08, 1.0, 0.92))
    figure = Figure(figsize=(3.2 * count, 4.4), layout=above_legend)
    judged, method = evaluation.judged, shown(evaluation)
    frames = np.linspace(0, len(judged.targets) - 1, count + 1).astype(int)[1:]
    actual, predicted = judged.actual, judged.answers[method].predicted
    held = judged.answers['hold'].predicted if 'hold' in judged.answers else None
    bounds = actual.reshape(-1, 3)
    low, high = np.nanmin(bounds, axis=0), np.nanmax(bounds, axis=0)
    for place, k in enumerate(frames):
        axes = figure.add_subplot(1, count, place + 1, projection='3d')
        if held is not None:
            _draw_mesh(axes, held[k], edges, '0.75', 'hold')
        _draw_mesh(axes, actual[k], edges, 'tab:blue', 'actual')
        _draw_mesh(axes, predicted[k], edges, 'tab:red', f'predicted ({method})')
        axes.set_box_aspect(np.maximum(high - low, 0.05)[[0, 2, 1]])
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[2], high[2])
        axes.set_zlim(low[1], high[1])
        axes.view_init(elev=12, azim=-60)
        axes.tick_params(labelsize=6)
        seconds = (judged.targets[k] - judged.start) / 1e9
        axes.set_title(f't = {seconds:.1f} s', fontsize=10)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc='lower center', ncols=3)
    figure.savefig(path, dpi=120)


def edges_of(model: ModelConfig, frames: FloatArray) -> IntArray:
    """Edges to draw, shape (edges, 2), of nodes [m], shape (frames, nodes, 3).

    What is triangulated is the median of the frames, and nothing where a node was never seen; the
    points of a body are joined as they surround its middle, if they do.
    """
    if model.topology not in ('delaunay', 'closed'):
        return topology_of(model, frames[0]).edges
    if not np.isfinite(frames).all(axis=2).any(axis=0).all():
        return np.zeros((0, 2), np.int64)
    usual = np.nanmedian(frames, axis=0)
    if model.topology == 'delaunay':
        return topology_of(model, usual).edges
    try:
        mesh = ClosedMesh.through(usual, usual.mean(axis=0), np.eye(3), np.ones(3))
    except ConfigError:
        return np.zeros((0, 2), np.int64)
    # each side of a closed mesh is that of two triangles, and goes up in one of them
    sides = mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.asarray(sides[sides[:, 0] < sides[:, 1]])


def _draw_mesh(
    axes: mpl.axes.Axes, nodes: FloatArray, edges: IntArray, colour: str, label: str
) -> None:
    axes.plot(nodes[:, 0], nodes[:, 2], nodes[:, 1], 'o', color=colour, markersize=2.0)
    gap = np.full((len(edges), 1, 3), np.nan)  # one line with gaps draws faster than many
    line = np.concatenate([nodes[edges], gap], axis=1).reshape(-1, 3)
    axes.plot(line[:, 0], line[:, 2], line[:, 1], color=colour, linewidth=0.9, label=label)
