"""The paper's filter as far as it is printed: one RK4 step a frame, and nothing about stopping."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloth_predict.experiments.goeller2015.runs import CONFIG, Filmed, Run
from cloth_predict.filters.sigma_points import SigmaPointFilter
from cloth_predict.integrators.runge_kutta import RungeKutta
from cloth_predict.models.ruler import Ruler
from cloth_predict.models.with_parameters import Parametrised, WithParameters
from cloth_predict.simulation.ruler import measured
from cloth_predict.tracking.ruler_assembly import joint_model, observation, process_noise

NO_INPUT = np.zeros(0)


def by_the_paper(film: Filmed, seed: int, off: float = 0.2) -> Run:
    """Follow a shot with no bounds, no event, and no second look at the first frames.

    The same noise and first belief as ours; the points are the 2 n + 1 of Julier & Uhlmann, with
    alpha = 1, which the paper does not say. From where the filter fails on, all is NaN.
    """
    rng, ours = np.random.default_rng(seed), joint_model(CONFIG)
    nothing = np.full(len(ours.first), np.inf)
    model = WithParameters(
        partial(Ruler, g=CONFIG.g), ours.names, ours.first, -nothing, nothing, ours.at.tolist()
    )
    kalman = SigmaPointFilter(Parametrised(RungeKutta()), alpha=1.0, beta=2.0, together=True)
    belief, obs, noise = film.start(rng, off, CONFIG), observation(CONFIG), process_noise(CONFIG)
    z = measured(film.states, float(film.shot.ruler.L), rng)
    mean = np.full((len(z), len(noise)), np.nan)
    sigma = mean.copy()
    for frame, seen in enumerate(z):
        try:
            if frame:
                dt = float(film.times[frame] - film.times[frame - 1])
                belief = kalman.predict(belief, model, NO_INPUT, noise, dt)
            belief, _ = kalman.update(belief, obs, seen)
        except FloatingPointError:
            break
        mean[frame], sigma[frame] = belief.mean, np.sqrt(belief.cov.diagonal())
    return Run(film, mean, sigma, {})
