"""What is known of a state once the future is known too: the smoother of Rauch, Tung and Striebel.

Their recursion (1965), in the form of Bryson and Frazier (Bierman 1973): it carries what the
future says back through the derivatives of the steps, and inverts no covariance of the state.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve

from cloth_predict.filters.kinematic_bank import KinematicBank
from cloth_predict.filters.linear import condition, propagate, root, symmetric
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Gaussian,
    IntArray,
    Integrator,
    Observation,
    Tangent,
)


@dataclass(frozen=True)
class Learnt:
    """What a measurement said.

    jac: H, or the rows of the state seen; cross: H P, shape (m, dim_x), P that before it; lower:
    L of S = L L', shape (m, m); residual, (m,); nis: normalised innovation squared.
    """

    jac: FloatArray | IntArray
    cross: FloatArray
    lower: FloatArray
    residual: FloatArray
    nis: float


@dataclass(frozen=True)
class Moment:
    """The filter at one time, with what the way back needs.

    mean, shape (r,), and cov, shape (r, dim_x): the rows of x and P that are asked for, given all
    measurements so far; tangent: derivative of the step that led there; learnt: of the measurement
    that was taken there.
    """

    mean: FloatArray
    cov: FloatArray
    rows: IntArray
    tangent: Tangent | None = None
    learnt: Learnt | None = None

    @classmethod
    def of(
        cls,
        belief: Gaussian,
        rows: IntArray,
        tangent: Tangent | None = None,
        learnt: Learnt | None = None,
    ) -> Moment:
        """Keep these rows of a belief."""
        return cls(belief.mean[rows], belief.cov[rows], rows, tangent, learnt)


def stepped(
    integrator: Integrator,
    belief: Gaussian,
    model: Dynamics,
    u: FloatArray,
    q: FloatArray,
    dt: float,
    about: FloatArray | None = None,
) -> tuple[Gaussian, Tangent]:
    """Belief dt [s] later, as of the extended Kalman filter, and the derivative of the step.

    about: a state, shape (dim_x,), about which the step is linearised in place of the mean.
    """
    at = belief.mean if about is None else about
    mean, tangent = integrator.step_tangent(model, at, u, dt)
    if about is not None:
        mean = mean + tangent.push((belief.mean - about)[:, None])[:, 0]
    return Gaussian(mean, propagate(belief.cov, tangent, dt * q)), tangent


def taken(belief: Gaussian, obs: Observation, z: FloatArray) -> tuple[Gaussian, Learnt | None]:
    """Belief given z, shape (m,), and what was learnt; nothing where m is 0."""
    jac = obs.jac(belief.mean)
    after, innovation = condition(belief, jac, obs.cov, z - obs.h(belief.mean))
    if not len(z):
        return after, None
    cross = belief.cov[jac] if np.issubdtype(jac.dtype, np.integer) else jac @ belief.cov
    lower = root(innovation.cov, 'innovation covariance')
    return after, Learnt(jac, cross, lower, innovation.residual, innovation.nis)


def smooth(
    moments: Iterable[Moment], window: int | None = None, lag: int = 0
) -> Iterator[Gaussian]:
    """Yield the rows of each moment given all measurements, in order.

    With a window only so many moments, and `lag` more that come after them, are held at a time:
    each is then smoothed with a future of at least `lag` moments in place of the whole of it.
    """
    held: list[Moment] = []
    for moment in moments:
        held.append(moment)
        if window is not None and len(held) == window + lag:
            yield from _backward(held)[:window]
            held = held[window:]
    yield from _backward(held)


def smooth_bank(
    before: Sequence[KinematicBank], after: Sequence[KinematicBank], dt: FloatArray
) -> list[KinematicBank]:
    """Kinematic filters given all measurements, from those before and after each; in order.

    dt [s], shape (times - 1,): the steps between them.
    """
    found = [after[-1]]
    for k in reversed(range(len(dt))):
        then, ahead = after[k], before[k + 1]
        step, _ = then.motion.over(float(dt[k]))
        gain = then.cov @ step.T @ np.linalg.inv(ahead.cov)
        mean = then.mean + gain @ (found[-1].mean - ahead.mean)
        cov = then.cov + gain @ (found[-1].cov - ahead.cov) @ gain.transpose(0, 2, 1)
        found.append(replace(then, mean=mean, cov=cov))
    return found[::-1]


def _backward(moments: list[Moment]) -> list[Gaussian]:
    """Smooth moments, of which the last knows no future.

    What the future says is held as y, shape (dim_x,), and Y, (dim_x, dim_x): with it the mean is
    x + P y and the covariance P - P Y P.
    """
    found: list[Gaussian] = []
    size = moments[0].cov.shape[1] if moments else 0
    vector, matrix = np.zeros(size), np.zeros((size, size))
    for moment in reversed(moments):
        mean = moment.mean + moment.cov @ vector
        cov = moment.cov[:, moment.rows] - moment.cov @ matrix @ moment.cov.T
        found.append(Gaussian(mean, symmetric(cov)))
        if moment.learnt is not None:
            vector, matrix = _before(moment.learnt, vector, matrix)
        if moment.tangent is not None:
            vector = moment.tangent.pull(vector[None])[0]
            matrix = symmetric(moment.tangent.pull(moment.tangent.pull(matrix).T))
    return found[::-1]


def _before(
    learnt: Learnt, vector: FloatArray, matrix: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What the future says before a measurement: with K the gain, and S^-1 = (L L')^-1.

    y <- (I - K H)' y + H' S^-1 residual, Y <- (I - K H)' Y (I - K H) + H' S^-1 H.
    """
    factor = (learnt.lower, True)
    gain = cho_solve(factor, learnt.cross)  # K'
    white = cho_solve(factor, learnt.residual - learnt.cross @ vector)
    seen = gain @ matrix
    inner = seen @ gain.T + cho_solve(factor, np.eye(len(factor[0])))
    across = _back(learnt.jac, seen, len(vector))
    within = _back(learnt.jac, _back(learnt.jac, inner, len(vector)).T, len(vector))
    return vector + _back(learnt.jac, white, len(vector)), matrix - across - across.T + within


def _back(jac: FloatArray | IntArray, values: FloatArray, size: int) -> FloatArray:
    """H' times values, shape (m, ...), of a state of this size."""
    if not np.issubdtype(jac.dtype, np.integer):
        return np.asarray(jac.T @ values)
    spread = np.zeros((size, *values.shape[1:]))
    spread[jac] = values
    return spread
