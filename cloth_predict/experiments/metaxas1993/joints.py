"""How joints drift without stabilisation, and what it does (section III, eq. 27)."""

from __future__ import annotations

import numpy as np

from cloth_predict.experiments.metaxas1993.insect import NODES, SEED
from cloth_predict.experiments.plots import panels
from cloth_predict.experiments.rows import Experiment, Row, Scope, short
from cloth_predict.integrators.runge_kutta import EULER, RungeKutta
from cloth_predict.models.constraints import Articulated, drift
from cloth_predict.simulation.bodies import insect_scene, total
from cloth_predict.types import FloatArray

OF_ALPHA = 'without stabilisation C may grow without bounds; a large alpha makes the motion stiff'
ALPHAS = (0.0, 10.0, 100.0, 1000.0, 1900.0, 2100.0)
STEP, DURATION = 1e-3, 0.5
"""Step of explicit Euler [s], which limits alpha to 2 / step, and the time of flight [s]."""


def run(scope: Scope) -> Row:
    """Let the insect fly with one alpha after the other."""
    duration = 0.2 if scope.quick else DURATION
    scene, starts, forces = insect_scene(np.random.default_rng(SEED), NODES)
    parts, joints = scene.parts, scene.joints.joints
    rest = [part.position(start) for part, start in zip(parts, starts, strict=True)]

    def pulls(time: float) -> FloatArray:
        """Forces on the parts as they are at rest: those that come and go."""
        given = [total(own, at, time) for own, at in zip(forces, rest, strict=True)]
        return np.concatenate(given).ravel()

    lines = {}
    for alpha in ALPHAS:
        model = Articulated(parts, joints, alpha)
        steps = round(duration / STEP)
        lines[alpha] = drift(model, model.join(starts), pulls, STEP, steps, RungeKutta(EULER))
        scope.progress(1 / len(ALPHAS))
    figure, (axes,) = panels(1, 6.5)
    for alpha, line in lines.items():
        times = STEP * np.arange(len(line))
        shown = np.isfinite(line) & (line > 0)
        axes.plot(times[shown], line[shown], label=f'alpha = {alpha:g} / s')
    axes.set(xlabel='time [s]', ylabel='largest |C| [m]', yscale='log')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    ends = {alpha: float(line[-1]) for alpha, line in lines.items()}
    told = '; '.join(f'{alpha:g}: {short(end, "m")}' for alpha, end in ends.items())
    return Row(
        'alpha',
        OF_ALPHA,
        f'largest |C| of the insect after {duration:g} s by alpha, explicit Euler, 1 ms: {told}',
        'the joints of an insect simulated by RK4 with alpha = 20 hold to 1e-8 m',
        'An error dies out as C (1 + alpha t) exp(-alpha t), not as the printed C exp(-alpha t); '
        f'explicit Euler is unstable from alpha = 2 / step = {2 / STEP:g} on.',
        {f'alpha {alpha:g}: |C| at the end [m]': end for alpha, end in ends.items()},
        (scope.save(figure, 'figure_alpha.png'),),
    )


EXPERIMENTS = (Experiment(('alpha',), OF_ALPHA, run),)
