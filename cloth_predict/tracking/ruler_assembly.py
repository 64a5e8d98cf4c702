"""From the configuration of a sliding bar to its joint filter (Goeller et al. 2015, 3.3)."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.filters.sigma_points import SigmaPointFilter
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import Ruler
from cloth_predict.models.with_parameters import Parametrised, WithParameters
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import FloatArray, Gaussian

STATES = ('x_G', 'y_G', 'L', 'alpha', 'V_x', 'V_y', 'V_alpha', 'L1', 'L2', 'mu')
"""The joint state X; the first four are what a frame tells, Z."""
PARAMETERS = ('L', 'L1', 'L2', 'mu')
MEASURED = np.arange(4)
ANGLE = STATES.index('alpha')


def joint_model(config: RulerConfig) -> WithParameters:
    """Bar with its length, contacts and friction as states, in the order of `STATES`.

    Raises ConfigError for a first guess that is out of its bounds.
    """
    near, far = config.contact_low, config.contact_high
    return WithParameters(
        partial(Ruler, g=config.g, share=None if config.share < 0 else config.share),
        PARAMETERS,
        first=(config.length, config.contact, config.contact, config.mu),
        low=(config.length_low, near, near, config.mu_low),
        high=(config.length_high, far, far, config.mu_high),
        at=[STATES.index(name) for name in PARAMETERS],
    )


def joint_filter(config: RulerConfig) -> SigmaPointFilter:
    """Unscented filter whose 21 points take each step together."""
    steps = Parametrised(Sliding(config.step))
    return SigmaPointFilter(steps, config.alpha, beta=2.0, together=True)


def process_noise(config: RulerConfig) -> FloatArray:
    """Spectral densities, shape (10,)."""
    velocity, contact = config.velocity_noise, config.contact_noise
    known = [0.0, 0.0, 0.0, 0.0]
    return np.array(
        [*known, velocity, velocity, config.spin_noise, contact, contact, config.mu_noise]
    )


def observation(config: RulerConfig) -> VisiblePositions:
    """What a frame tells: Z = [x_G, y_G, L, alpha]."""
    sigma = np.full(len(MEASURED), config.position_noise)
    sigma[ANGLE] = config.angle_noise
    return VisiblePositions(MEASURED, sigma**2)


def first_belief(config: RulerConfig, model: WithParameters, z: FloatArray) -> Gaussian:
    """Belief before the first frame: at rest where that frame has the bar, shape (4,).

    The parameters are the first guess of the model.
    """
    place, speed, contact = config.place_sigma, config.speed_sigma, config.contact_sigma
    sigma = [place, place, config.length_sigma, place / config.length, speed, speed]
    sigma += [config.spin_sigma, contact, contact, config.mu_sigma]
    mean = model.joint(np.array([z[0], z[1], z[ANGLE], 0.0, 0.0, 0.0]), model.first)
    return Gaussian(mean, np.diag(np.square(sigma)))


def unwrapped(config: RulerConfig, z: FloatArray, angle: float) -> FloatArray:
    """Measurement whose angle is the nearest to one that is expected [rad]."""
    turn = 2.0 * np.pi if config.ends else np.pi
    near = z.copy()
    near[ANGLE] += turn * np.round((angle - z[ANGLE]) / turn)
    return near
