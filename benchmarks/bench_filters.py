"""Cost of one update plus a prediction 0.1 s ahead, for every kind of filter and size of surface.

Times are those of one core of this machine; the ratios to filterpy's EKF hold elsewhere. Draws
the cost over the number of nodes into out/bench/cost.png, or where the first argument says.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import matplotlib as mpl
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter as Reference
from matplotlib.figure import Figure

from cloth_predict.config import Config, build
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.family import FILTERS
from cloth_predict.integrators.implicit_euler import ImplicitEuler
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import grid_springs
from cloth_predict.observations import VisiblePositions
from cloth_predict.performance import one_core
from cloth_predict.surface.assembly import rest_shape
from cloth_predict.tracker import Tracker
from cloth_predict.types import Dynamics, FloatArray, Gaussian

mpl.use('Agg')

T = TypeVar('T')

SIZES = ((2, 2), (3, 3), (5, 4), (7, 7), (10, 10), (14, 14), (21, 21))
LONGEST = 1.0
"""Seconds a frame may take; a kind that needs more is not run at larger sizes."""
BUDGET = 3.0
"""Seconds spent on one kind at one size."""
DT = 0.01


def main() -> None:
    """Print the tables and draw the figure."""
    target = Path(sys.argv[1] if len(sys.argv) > 1 else 'out/bench/cost.png')
    found = {kind: costs(kind) for kind in FILTERS}
    print(f'{"":24} ' + ' '.join(f'{rows}x{cols:<6}' for rows, cols in SIZES))
    for kind, rows_ in found.items():
        numbers = ' '.join(f'{median:8.2f}' for median, _ in rows_)
        print(f'{kind:24} {numbers}   median [ms]')
        print(f'{"":24} ' + ' '.join(f'{p99:8.2f}' for _, p99 in rows_) + '   99 %')
    draw(found, target)
    print(f'figure: {target}')
    for forced in (False, True):
        ours, theirs, apart = against_filterpy(*SIZES[-1], forced)
        with_ = 'with' if forced else 'without'
        print(
            f'exact EKF of 21x21 nodes {with_} forces: {ours:.2f} s a frame, filterpy '
            f'{theirs:.2f} s: {theirs / ours:.1f} times; largest difference of a mean [m] or '
            f'correlation {apart:.1e}'
        )


def settings(kind: str, rows: int, cols: int) -> Config:
    """A sheet of 0.16 m cells, no node held, with one force per node (9 states per node).

    The springs of `gomes2016` are so soft that its explicit step is not lost at once.
    """
    stiffness = 0.01 if kind == 'gomes2016' else 60.0
    config = build(
        {
            'model': {
                'rows': rows,
                'cols': cols,
                'width': 0.16 * (cols - 1),
                'height': 0.16 * (rows - 1),
                'mass': 0.017 * rows * cols,
                'gravity': [0.0, 0.0, 0.0],
                'stiffness_structural': stiffness,
                'stiffness_shear': stiffness,
                'stiffness_flexion': stiffness,
            },
            'force': {'kind': 'ornstein_uhlenbeck'},
            'filter': {'rewind': 0.0},  # a memory of large covariances is not what is timed
            'limits': {'sigma_error': 1e300},
        },
        'benchmark',
    )
    return dataclasses.replace(config, filter=dataclasses.replace(config.filter, kind=kind))


def frames(config: Config, count: int) -> FloatArray:
    """Markers [m], shape (frames, nodes, 3), of a sheet that waves, with noise of 0.3 mm."""
    rest = rest_shape(config.model)
    phase = 3.0 * rest[:, 0] + 6.0 * DT * np.arange(count)[:, None]
    positions = np.tile(rest, (count, 1, 1))
    positions[..., 2] += 0.03 * np.sin(phase)
    return positions + np.random.default_rng(1).normal(0, 3e-4, positions.shape)


def costs(kind: str) -> list[tuple[float, float]]:
    """Median and 99th percentile [ms] at each size; NaN where it takes too long."""
    found = []
    worst = 0.0
    for rows, cols in SIZES:
        if worst > LONGEST:
            found.append((np.nan, np.nan))
            continue
        taken = timed(settings(kind, rows, cols))
        worst = float(np.median(taken))
        found.append((1e3 * worst, 1e3 * float(np.percentile(taken, 99))))
    return found


def timed(config: Config) -> list[float]:
    """Seconds of each frame, until the budget is spent."""
    tracker, positions = Tracker(config), frames(config, 500)
    visible = np.ones(positions.shape[1], bool)
    taken: list[float] = []
    for k, markers in enumerate(positions):
        begin = time.perf_counter()
        tracker.step(round(1e9 * DT * k), markers, visible)
        tracker.predict(0.1)
        taken.append(time.perf_counter() - begin)
        if sum(taken) > BUDGET and len(taken) > 2:
            break
    return taken[min(20, len(taken) // 3) :]  # without the start


def against_filterpy(rows: int, cols: int, forced: bool) -> tuple[float, float, float]:
    """Seconds a frame of ours and of filterpy's EKF on the same problem, and their difference."""
    config = settings('ekf', rows, cols)
    shape = rest_shape(config.model)
    stiffness = {'structural': 60.0, 'shear': 60.0, 'flexion': 60.0}
    mesh = MassSpring(grid_springs(rows, cols, shape, stiffness, 0.1), np.full(len(shape), 0.017))
    markers, size = frames(config, 3), shape.size
    model = Disturbed(mesh, 0.3) if forced else mesh
    x = np.append(markers[0].ravel(), np.zeros(model.dim_x - size))
    q, u = np.repeat([0.0, 1.0, 0.07][: len(x) // size], size), mesh.input()
    obs = VisiblePositions.of_nodes(np.arange(len(shape)), 3e-4)
    kalman, other = ExtendedKalmanFilter(ImplicitEuler()), Reference(len(x), size)
    belief = Gaussian(x, np.diag(np.repeat([1e-7, 0.01, 0.01][: len(x) // size], size)))
    other.x, other.P, other.R = x.copy(), belief.cov.copy(), np.diag(obs.cov)
    ours, theirs = [], []
    for z in markers[1:]:
        taken, belief = seconds(frame, kalman, belief, model, u, q, obs, z.ravel())
        ours.append(taken)
        after, F = ImplicitEuler().step_jac(model, other.x, u, DT)
        other.F, other.Q = F, F @ np.diag(DT * q / 2) @ F.T + np.diag(DT * q / 2)
        theirs.append(seconds(filterpy_frame, other, after, z.ravel())[0])
    sigma = np.sqrt(np.diag(other.P))
    apart = np.abs((belief.cov - other.P) / np.outer(sigma, sigma)).max()
    return min(ours), min(theirs), float(max(apart, np.abs(belief.mean - other.x).max()))


def frame(
    kalman: ExtendedKalmanFilter,
    belief: Gaussian,
    model: Dynamics,
    u: FloatArray,
    q: FloatArray,
    obs: VisiblePositions,
    z: FloatArray,
) -> Gaussian:
    """One predict and update of ours."""
    return kalman.update(kalman.predict(belief, model, u, q, DT), obs, z)[0]


def filterpy_frame(other: Reference, after: FloatArray, z: FloatArray) -> None:
    """One predict and update of filterpy's."""
    other.predict()
    other.x = after
    selection = np.eye(len(z), len(after))
    other.update(z, lambda _: selection, lambda x: x[: len(z)])


def seconds(call: Callable[..., T], *arguments: object) -> tuple[float, T]:
    """How long a call took, and what it returned."""
    begin = time.perf_counter()
    result = call(*arguments)
    return time.perf_counter() - begin, result


def draw(found: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Median over the number of nodes, on logarithmic axes."""
    figure = Figure(figsize=(7, 4.5), layout='constrained')
    axes = figure.add_subplot()
    nodes = [rows * cols for rows, cols in SIZES]
    for kind, numbers in found.items():
        medians = [median for median, _ in numbers]
        if np.isfinite(medians).any():
            axes.loglog(nodes, medians, marker='o', markersize=4, label=kind)
    axes.axhline(10.0, color='0.6', linestyle='--', linewidth=1)
    axes.annotate('100 Hz', (nodes[-1], 10.0), ha='right', va='bottom', color='0.4')
    axes.set(
        xlabel='nodes',
        ylabel='one update and 0.1 s of prediction [ms]',
        title='Cost of each kind of filter, one core, one force per node',
    )
    axes.grid(alpha=0.3, which='both')
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


if __name__ == '__main__':
    with one_core():
        main()
