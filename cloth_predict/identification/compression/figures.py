"""Pictures of a compression, as those of Gomes 2016, figures 5.7 to 5.11."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from cloth_predict.identification.compression.falling import times
from cloth_predict.identification.compression.modal import Rival
from cloth_predict.identification.compression.search import Compression
from cloth_predict.identification.cost_curve import draw

mpl.use('Agg')


def errors(found: Compression, path: Path) -> None:
    """Mean squared distance over time, equal and compressed (figures 5.7, 5.9 and 5.11)."""
    names = found.task.names
    figure = Figure(figsize=(9, 2.2 * len(names)), layout='constrained')
    axes = figure.subplots(len(names), sharex=True, squeeze=False)[:, 0]
    for name, part in zip(names, axes, strict=True):
        for what, of, colour in (
            ('all equal', found.before, '0.6'),
            ('compressed', found.after, 'tab:red'),
        ):
            part.semilogy(
                times(found.task.duration)[1:], of[name].error[1:], color=colour, label=what
            )
        role = 'trained' if name in found.task.trained else 'held out'
        part.set(title=f'{name}, {role}', ylabel='MSE, m$^2$')
    axes[0].legend()
    axes[-1].set(xlabel='time, s')
    figure.savefig(path, dpi=110)


def costs(found: Compression, path: Path) -> None:
    """Best RMS distance over evaluations (figures 5.3 and 5.8)."""
    draw(found.trace, found.method.optimiser, found.result.evaluations, path)


def parameters(found: Compression, path: Path) -> None:
    """Distributions of what was found, and what all were equal to (figure 5.10)."""
    model, equal = found.config.model, found.task.equal.model
    shown = [
        ('masses, kg', model.masses, equal.mass / equal.count),
        ('springs, N/m', model.springs, equal.stiffness_structural),
        ('dampers, N s/m', model.dampers, equal.damping),
        ('factors of gravity', model.loads, 1.0),
    ]
    figure = Figure(figsize=(9, 5), layout='constrained')
    for axes, (name, values, before) in zip(figure.subplots(2, 2).flat, shown, strict=True):
        axes.hist(values, bins=20, color='tab:red', alpha=0.7)
        axes.axvline(before, color='0.4', linestyle='--')
        axes.set(xlabel=name, ylabel='number')
    figure.savefig(path, dpi=110)


def at_cost(found: Compression, rivals: Sequence[Rival], path: Path) -> None:
    """Error of each model over the time of an EKF cycle, trained and held out."""
    task = found.task
    held_out = [name for name in task.names if name not in task.trained]
    sides = {'trained': list(task.trained), 'held out': held_out}
    figure = Figure(figsize=(9, 4), layout='constrained')
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, (side, names) in zip(panels, sides.items(), strict=True):
        for kind in dict.fromkeys(rival.kind for rival in rivals) if names else ():
            own = [rival for rival in rivals if rival.kind == kind]
            rms = [np.sqrt(np.mean([rival.rms[name] ** 2 for name in names])) for rival in own]
            axes.loglog([1e3 * r.cycle for r in own], 1e3 * np.array(rms), 'o-', label=kind)
        axes.set(title=side, xlabel='EKF cycle, ms', ylabel='RMS distance, mm')
    panels[0].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panels[0].xaxis.set_major_formatter('{x:g}')
    panels[0].xaxis.set_minor_formatter(NullFormatter())
    panels[0].legend(fontsize='small')
    figure.savefig(path, dpi=110)
