"""What the experiments on a sliding bar share: starts that are off, runs, what can be known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from cloth_predict.config.ruler import RulerConfig
from cloth_predict.errors import UncertainError
from cloth_predict.experiments.rows import Scope
from cloth_predict.identification.observability import bounds, sensitivities
from cloth_predict.integrators.sliding import Sliding
from cloth_predict.models.ruler import Ruler
from cloth_predict.simulation.ruler import Shot, Slide, measured, slide
from cloth_predict.tracking.ruler import RulerTracker
from cloth_predict.tracking.ruler_assembly import (
    ANGLE,
    STATES,
    first_belief,
    joint_model,
    observation,
)
from cloth_predict.tracking.stopping import Stop
from cloth_predict.types import BoolArray, FloatArray, Gaussian

RATE = 50
"""Frames in a second (Goeller et al. 2015, 4.5)."""
CONFIG = RulerConfig(g=10.0)
"""As it comes, with the gravity of annex A."""
KNOWN = tuple(STATES.index(name) for name in ('L1', 'L2', 'mu'))


@dataclass(frozen=True)
class Filmed:
    """A shot as it was: frames at times [s], states, shape (frames, 6), and its end."""

    shot: Shot
    times: FloatArray
    states: FloatArray
    duration: float
    rest: FloatArray

    @classmethod
    def of(cls, shot: Shot, longest: float = np.inf) -> Filmed:
        """Film it until it rests, or for `longest` [s]."""
        found: Slide = slide(shot, tolerance=1e-9)
        times = np.arange(int(min(found.duration + 0.1, longest) * RATE) + 1) / RATE
        states = found.at(np.append(times, found.duration))
        return cls(shot, times, states[:-1], found.duration, states[-1, :3])

    @property
    def joint(self) -> FloatArray:
        """The joint state at the start, shape (10,)."""
        r = self.shot.ruler
        return joint_model(CONFIG).joint(self.shot.start, np.array([r.L, r.L1, r.L2, r.mu]))

    def start(self, rng: np.random.Generator, off: float, config: RulerConfig) -> Gaussian:
        """What is believed before the first frame: off by up to a share of each.

        Places by a share of the length, angles of a radian, velocities of their own; the
        parameters are the first guess of the configuration, as are all sigmas.
        """
        truth, model = self.joint, joint_model(config)
        scale = np.abs(truth)
        scale[[0, 1, 2]], scale[ANGLE] = self.shot.ruler.L, 1.0
        mean = truth + off * rng.uniform(-1.0, 1.0, len(truth)) * scale
        mean[list(KNOWN)] = model.first[1:]
        return Gaussian(mean, first_belief(config, model, mean[:4]).cov)


@dataclass(frozen=True)
class Run:
    """A filter along a shot: means, sigmas, (frames, 10), and stops by frame, None if unknown."""

    film: Filmed
    mean: FloatArray
    sigma: FloatArray
    stops: dict[int, Stop | None]

    @property
    def parameter_errors(self) -> FloatArray:
        """Errors of L1, L2 [m] and, relative, of mu, shape (frames, 3)."""
        r = self.film.shot.ruler
        error = self.mean[:, KNOWN] - np.array([r.L1, r.L2, r.mu])
        return np.asarray(error / [1.0, 1.0, r.mu])

    def stop_errors(self, frame: int) -> tuple[float, float]:
        """Distance [m] and angle [rad] of the predicted stop from the true one."""
        stop = self.stops[frame]
        if stop is None:
            return np.inf, np.inf
        error = stop.mean - self.film.rest
        return float(np.hypot(error[0], error[1])), float(abs(error[2]))


def followed(
    film: Filmed,
    seed: int,
    off: float = 0.2,
    config: RulerConfig = CONFIG,
    stops: Iterable[int] = (),
) -> Run:
    """Follow a shot with noise of a seed, and predict its stop at some frames."""
    rng = np.random.default_rng(seed)
    tracker = RulerTracker(config, film.start(rng, off, config))
    z = measured(film.states, float(film.shot.ruler.L), rng)
    mean, sigma, wanted = [], [], set(stops)
    ends: dict[int, Stop | None] = {}
    for frame, stamp in enumerate(np.round(film.times * 1e9).astype(int).tolist()):
        tracker.step(stamp, z[frame])
        mean.append(tracker.belief.mean)
        sigma.append(np.sqrt(tracker.belief.cov.diagonal()))
        if frame in wanted:
            ends[frame] = _stop(tracker)
    return Run(film, np.array(mean), np.array(sigma), ends)


def _stop(tracker: RulerTracker) -> Stop | None:
    try:
        return tracker.stop()
    except UncertainError:
        return None


@dataclass(frozen=True)
class Bound:
    """Sigmas that no estimator can beat, along a shot: of the joint state, and of the stop.

    sigma, shape (frames, 10); place [m] and angle [rad] of the stop, shape (frames,); middle [m]:
    of the root of L1 L2, shape (frames,).
    """

    sigma: FloatArray
    place: FloatArray
    angle: FloatArray
    middle: FloatArray

    @classmethod
    def of(cls, film: Filmed, config: RulerConfig = CONFIG) -> Bound:
        """From exact derivatives of the motion, and the sigmas before the first frame."""
        model, obs = joint_model(config), observation(config)
        prior = np.sqrt(first_belief(config, model, film.joint[:4]).cov.diagonal())
        count = len(film.times)
        slopes = sensitivities(partial(_poses, film), film.joint)
        seen = np.zeros((count, len(obs.rows), len(prior)))
        seen[:, [0, 1, ANGLE]] = slopes[:count]
        seen[:, STATES.index('L'), STATES.index('L')] = 1.0
        cov = bounds(seen, np.sqrt(obs.cov), prior)
        stop = slopes[-1] @ cov @ slopes[-1].T
        l1, l2 = film.joint[list(KNOWN[:2])]
        along = np.zeros(len(prior))
        along[list(KNOWN[:2])] = 0.5 * np.sqrt([l2 / l1, l1 / l2])
        return cls(
            np.sqrt(np.einsum('fii->fi', cov)),
            np.sqrt(stop[:, 0, 0] + stop[:, 1, 1]),
            np.sqrt(stop[:, 2, 2]),
            np.sqrt(along @ cov @ along),
        )


def _poses(film: Filmed, unknowns: FloatArray) -> FloatArray:
    """Poses at each frame and at rest, (2 n, frames + 1, 3), of joint states at the start."""
    model, r = joint_model(CONFIG), film.shot.ruler
    length, behind, before, mu = unknowns[:, model.at].T
    bars = Ruler(length, behind, before, mu, r.g, r.share)
    method, x, u = Sliding(2e-3), unknowns[:, model.own], np.zeros(0)
    poses = [x[:, :3]]
    for duration in np.diff(film.times):
        x = method.step(bars, x, u, float(duration))
        poses.append(x[:, :3])
    while not bars.resting(x).all():
        x = method.step(bars, x, u, 0.1)
    return np.stack([*poses, x[:, :3]], axis=1)


def seeds(scope: Scope, many: int) -> range:
    """Seeds of the noise: fewer in a quick run."""
    return range(max(many // 5, 2) if scope.quick else many)


def since(times: FloatArray, good: BoolArray) -> float:
    """Time [s] from which on all is good, shape (times,) both; infinite if never."""
    bad = np.flatnonzero(~good)
    last = -1 if not bad.size else int(bad[-1])
    return float(times[last + 1]) if last + 1 < len(times) else float('inf')
