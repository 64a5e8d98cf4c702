"""Section 3.3 on a towel: its stiffness among the states, found while the towel is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from cloth_predict.experiments.plots import panels
from cloth_predict.experiments.rows import Experiment, Row, Scope
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import grid_pairs
from cloth_predict.models.with_parameters import Parametrised, WithParameters
from cloth_predict.observations import VisiblePositions
from cloth_predict.simulation.recordings import hung_cloth
from cloth_predict.types import FloatArray, Gaussian

ROWS, COLS = 5, 4
TRUE = {'structural': 250.0, 'shear': 60.0, 'flexion': 10.0}
"""Stiffness [N/m] of the springs."""
OFF = 0.5
"""Share by which each first guess is too low."""
FRAME, NOISE = 0.01, 3e-4
"""Time between frames [s]; sigma of a marker [m]."""
PAPER = 'unknown parameters as states of the filter, of any model; done for the ruler only'


def towel() -> tuple[MassSpring, FloatArray]:
    """A towel of 0.51 x 0.80 m hung by its first row, and where its nodes are held level [m]."""
    shape = np.zeros((ROWS, COLS, 3))
    shape[..., 0] = np.linspace(0.0, 0.51, COLS)
    shape[..., 2] = np.linspace(0.0, 0.80, ROWS)[:, None]
    return hung_cloth(shape, 0.34, TRUE, damping=0.05), shape.reshape(-1, 3)


def unknown(mesh: MassSpring) -> WithParameters:
    """The towel with the stiffness of each family of springs as a state."""
    counts = [len(pairs) for pairs in grid_pairs(ROWS, COLS).values()]

    def make(**stiffness: float) -> MassSpring:
        each = np.repeat([stiffness[name] for name in TRUE], counts)
        return mesh.with_springs(replace(mesh.springs, stiffness=each))

    true = np.array(list(TRUE.values()))
    return WithParameters(make, tuple(TRUE), (1.0 - OFF) * true, 0.01 * true, 10.0 * true)


def _row(scope: Scope) -> Row:
    mesh, level = towel()
    model, frames = unknown(mesh), 100 if scope.quick else 400
    u, rng = mesh.input(level[mesh.driven]), np.random.default_rng(0)
    size = mesh.dim_x // 2
    x = np.append(level[mesh.free].ravel(), rng.normal(0.0, 0.2, size))
    obs = VisiblePositions.of_rows(np.arange(size), NOISE)
    own = np.append(x[:size], np.zeros(size))
    sigma = np.append(np.full(size, NOISE), np.full(size, 0.3))
    prior = np.square(model.joint(sigma, OFF * np.array(list(TRUE.values()))))
    belief = Gaussian(model.joint(own, model.first), np.diag(prior))
    kalman, q = ExtendedKalmanFilter(Parametrised(RungeKutta())), np.zeros(model.dim_x)
    q[size : 2 * size] = 1e-6
    mean, spread = [model.first], [np.sqrt(prior[model.at])]
    for _ in range(frames):
        for _ in range(10):
            x = RungeKutta().step(mesh, x, u, 0.1 * FRAME)
        for _ in range(2):
            belief = kalman.predict(belief, model, u, q, 0.5 * FRAME)
        z = x[obs.rows] + rng.normal(0.0, NOISE, size)
        belief = model.kept(kalman.update(belief, obs, z)[0])
        mean.append(belief.mean[model.at])
        spread.append(np.sqrt(belief.cov.diagonal()[model.at]))
        scope.progress(1.0 / frames)
    true = np.array(list(TRUE.values()))
    error, known = (np.array(mean) - true) / true, np.array(spread) / true
    numbers = {}
    for k, name in enumerate(TRUE):
        numbers[f'{name}: error at the end'] = float(error[-1, k])
        numbers[f'{name}: sigma at the end'] = float(known[-1, k])
    return Row(
        '3.3',
        PAPER,
        '-',
        f'a towel of {ROWS} x {COLS} nodes let go from level, each stiffness guessed '
        f'{100 * OFF:.0f} % too low: after {frames * FRAME:g} s '
        + ', '.join(
            f'{name} off by {100 * error[-1, k]:+.2g} % (sigma {100 * known[-1, k]:.2g} %)'
            for k, name in enumerate(TRUE)
        ),
        'The same wrapper as for the bar, around another model, integrator and filter (an '
        'extended one).',
        numbers,
        (scope.save(_picture(error, known), 'stiffness.png'),),
    )


def _picture(error: FloatArray, known: FloatArray) -> Figure:
    """Errors of each stiffness, and two of the filter's sigmas."""
    figure, axes = panels(len(TRUE), width=4.2)
    times = FRAME * np.arange(len(error))
    for k, (axis, name) in enumerate(zip(axes, TRUE, strict=True)):
        axis.plot(times, 100.0 * error[:, k], color='tab:red')
        for sign in (-2.0, 2.0):
            axis.plot(times, sign * 100.0 * known[:, k], 'k--', linewidth=1.0)
        axis.set(xlabel='time [s]', title=f'error of the {name} stiffness [%]', ylim=(-60, 60))
        axis.grid(alpha=0.3)
    return figure


EXPERIMENTS = (Experiment(('3.3',), PAPER, _row),)
