"""The parameters of a sliding bar that is followed: defaults, meanings, units, and their range."""

from __future__ import annotations

from dataclasses import dataclass

from cloth_predict.config.parameter import param


@dataclass(frozen=True)
class RulerConfig:
    """A rigid bar that slides on a table, seen by its centre, length and angle."""

    g: float = param(9.81, 'gravity', 'm/s^2', above=0)
    share: float = param(
        -1.0,
        'part of the weight on the contact behind the centre; below 0 it is that of statics',
        low=-1,
        high=1,
    )
    ends: bool = param(
        False, 'whether the two ends are told apart; if not, angles are known but for half turns'
    )
    position_noise: float = param(0.001, 'sigma of a measured centre and length', 'm', above=0)
    angle_noise: float = param(0.0087, 'sigma of a measured angle: half a degree', 'rad', above=0)
    length: float = param(1.0, 'first guess of the length', 'm', above=0)
    length_low: float = param(0.05, 'lower bound of the length', 'm', above=0)
    length_high: float = param(3.0, 'upper bound of the length', 'm', above=0)
    contact: float = param(
        0.25, 'first guess of the distance of either contact from the centre', 'm', above=0
    )
    contact_low: float = param(0.005, 'lower bound of that distance', 'm', above=0)
    contact_high: float = param(0.5, 'upper bound of that distance', 'm', above=0)
    mu: float = param(0.05, 'first guess of the coefficient of friction', low=0)
    mu_low: float = param(0.001, 'lower bound of the coefficient of friction', low=0)
    mu_high: float = param(1.5, 'upper bound of the coefficient of friction', above=0)
    length_sigma: float = param(0.1, 'sigma of the first guess of the length', 'm', above=0)
    contact_sigma: float = param(0.15, 'sigma of the first guess of the contacts', 'm', above=0)
    mu_sigma: float = param(0.2, 'sigma of the first guess of the friction', above=0)
    place_sigma: float = param(
        0.2,
        'sigma of the centre before the first frame, and of the angle by the length',
        'm',
        above=0,
    )
    speed_sigma: float = param(5.0, 'sigma of each velocity at the start', 'm/s', above=0)
    spin_sigma: float = param(15.0, 'sigma of the angular velocity at the start', 'rad/s', above=0)
    velocity_noise: float = param(
        1e-6, 'spectral density of the noise of the velocities', 'm^2/s^3', above=0
    )
    spin_noise: float = param(
        1e-5, 'spectral density of the noise of the angular velocity', 'rad^2/s^3', above=0
    )
    contact_noise: float = param(
        3e-8, 'spectral density of the random walk of the contacts', 'm^2/s', low=0
    )
    mu_noise: float = param(
        3e-8, 'spectral density of the random walk of the friction', '1/s', low=0
    )
    alpha: float = param(0.6, 'spread of the sigma points', above=0, high=1)
    step: float = param(0.01, 'longest step of the motion', 's', above=0)
    again: float = param(
        0.6,
        'time after which the frames so far are filtered again from the parameters found: what '
        'they taught under a wrong guess is learnt anew; 0 leaves it out',
        's',
        low=0,
    )
    gate: float = param(
        50.0,
        'normalised innovation squared (of four numbers) above which a frame is not believed',
        above=0,
    )
    patience: int = param(5, 'frames not believed after which the bar is taken anew', low=1)
    max_gap: float = param(1.0, 'longest time between frames that is bridged', 's', above=0)
    stop_position: float = param(
        0.01, 'sigma of the place of rest under which it is told', 'm', above=0
    )
    stop_angle: float = param(
        0.0175, 'sigma of the angle at rest under which it is told: 1 degree', 'rad', above=0
    )
    stop_after: float = param(20.0, 'longest time ahead that a stop is looked for', 's', above=0)
