"""Least squares over a sliding window of measurements (Gomes 2016, section 4.1).

Within the window the model is taken as exact: the fit is to one state, that at its start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.linear import condition, propagate, root
from cloth_predict.types import (
    Dynamics,
    FloatArray,
    Gaussian,
    Innovation,
    IntArray,
    Integrator,
    Observation,
    read_only,
)

ITERATIONS = 3
"""Most Gauss-Newton iterations per update: it starts close, at the fit to the frame before."""
CONVERGED = 1e-2
"""Change of the whole state, in standard deviations of the fit, below which it stops."""


@dataclass(frozen=True)
class Leg:
    """One step of the window: its input and length [s], and what was measured at its end."""

    u: FloatArray
    dt: float
    measured: tuple[tuple[Observation, FloatArray], ...] = ()

    def given(self, obs: Observation, z: FloatArray) -> Leg:
        """Return the step with one measurement more."""
        return replace(self, measured=(*self.measured, (obs, _kept(z))))


@dataclass(frozen=True)
class Window:
    """A belief: the state now, and all that it is fitted to.

    now: the fit at the end of the window. prior: the state at the window's start, from all that
    was measured up to then. start, shape (dim_x,): the fit there. legs: the steps since.
    """

    now: Gaussian
    prior: Gaussian
    start: FloatArray
    legs: tuple[Leg, ...]
    model: Dynamics

    def __post_init__(self) -> None:
        object.__setattr__(self, 'start', read_only(self.start))

    @property
    def mean(self) -> FloatArray:
        """Expected state, shape (dim_x,)."""
        return self.now.mean

    @property
    def cov(self) -> FloatArray:
        """Covariance of the state, shape (dim_x, dim_x)."""
        return self.now.cov

    @property
    def duration(self) -> float:
        """Length [s]."""
        return sum(leg.dt for leg in self.legs)

    def marginals(self, rows: IntArray) -> FloatArray:
        """Covariances of k groups of m states each, rows of shape (k, m), shape (k, m, m)."""
        return self.now.marginals(rows)


@dataclass(frozen=True)
class LeastSquares:
    """Fits the state at the window's start to all measurements in it, by Gauss-Newton.

    It minimises |x0 - m|^2 in the metric of the prior N(m, P0) at the window's start, plus the
    squared residuals over sigma of every measurement under the model without process noise. What
    leaves the window goes into the prior, which an EKF with process noise carries along: without
    it, the damped model would take the oldest data for certain. Over a window that holds all, the
    fit on a linear model is (A'A)^-1 A'y (Gomes 2016, eq. 4.10) with the covariance
    (A'A)^-1 sigma^2.

    An update costs at most ITERATIONS (window / step) linearised steps of a dim_x^2 matrix.
    """

    integrator: Integrator
    window: float
    """Length [s]."""

    def start(self, prior: Gaussian, model: Dynamics, u: FloatArray, q: FloatArray) -> Window:
        """Belief before the first measurement: the prior, and an empty window."""
        return Window(prior, prior, prior.mean, (), model)

    def predict(
        self, belief: Window, model: Dynamics, u: FloatArray, q: FloatArray, dt: float
    ) -> Window:
        """Belief dt [s] later, without process noise; the window moves on."""
        mean, tangent = self.integrator.step_tangent(model, belief.mean, u, dt)
        now = Gaussian(mean, propagate(belief.cov, tangent, 0.0 * q))
        longer = replace(belief, now=now, legs=(*belief.legs, Leg(_kept(u), dt)), model=model)
        # a step of the window's own length, but for rounding, is no step too many
        while longer.duration > self.window + 1e-9 and len(longer.legs) > 1:
            longer = self._without_the_oldest(longer, q)
        return longer

    def update(self, belief: Window, obs: Observation, z: FloatArray) -> tuple[Window, Innovation]:
        """Belief given z, fitted anew; the innovation is that of the fit without z."""
        now, learnt = condition(belief.now, obs.jac(belief.mean), obs.cov, z - obs.h(belief.mean))
        if not z.size:
            return belief, learnt
        if not belief.legs:  # at the window's start
            return replace(belief, now=now, prior=now, start=now.mean), learnt
        legs = (*belief.legs[:-1], belief.legs[-1].given(obs, z))
        return self._fitted(replace(belief, legs=legs)), learnt

    def forecast(
        self,
        belief: Window,
        model: Dynamics,
        inputs: Sequence[FloatArray],
        q: FloatArray,
        dt: float,
        rows: IntArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariances of `rows` after one step of dt [s] per input; no process noise."""
        ekf = ExtendedKalmanFilter(self.integrator)
        return ekf.forecast(belief.now, model, inputs, 0.0 * q, dt, rows)

    def _without_the_oldest(self, belief: Window, q: FloatArray) -> Window:
        """Move the oldest step and what was measured after it into the prior."""
        ekf, leg, model = ExtendedKalmanFilter(self.integrator), belief.legs[0], belief.model
        prior = ekf.predict(belief.prior, model, leg.u, q, leg.dt)
        for obs, z in leg.measured:
            prior, _ = ekf.update(prior, obs, z)
        start = self.integrator.step(model, belief.start, leg.u, leg.dt)
        return replace(belief, prior=prior, start=start, legs=belief.legs[1:])

    def _fitted(self, belief: Window) -> Window:
        """Gauss-Newton on y with x0 = m + L y, P0 = L L': the prior's share is then |y|^2."""
        prior, start = belief.prior, belief.start
        lower = root(prior.cov, 'covariance')
        y = solve_triangular(lower, start - prior.mean, lower=True)
        for _ in range(ITERATIONS):
            normal, right, end = self._linearised(belief, start, lower)
            normal_root = root(normal, 'normal matrix')
            better = cho_solve((normal_root, True), right + normal @ y - y)
            change, y = better - y, better
            start = prior.mean + lower @ y
            if change @ normal @ change < CONVERGED**2:
                break
        mean = start
        for leg in belief.legs:
            mean = self.integrator.step(belief.model, mean, leg.u, leg.dt)
        half = solve_triangular(normal_root, end.T, lower=True)
        return replace(belief, now=Gaussian(mean, half.T @ half), start=start)

    def _linearised(
        self, belief: Window, start: FloatArray, lower: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations of the window run from `start`.

        With A the derivative of all measurements over sigma by y, and r the residuals over sigma:
        A'A + I, A'r, and the derivative of the last state by y.
        """
        normal, right = np.eye(len(start)), np.zeros(len(start))
        x, by_y = start, lower
        for leg in belief.legs:
            x, tangent = self.integrator.step_tangent(belief.model, x, leg.u, leg.dt)
            by_y = tangent.push(by_y)
            for obs, z in leg.measured:
                jac = obs.jac(x)
                slope = by_y[jac] if np.issubdtype(jac.dtype, np.integer) else jac @ by_y
                both = _over_sigma(np.column_stack([slope, z - obs.h(x)]), obs.cov)
                normal += both[:, :-1].T @ both[:, :-1]
                right += both[:, :-1].T @ both[:, -1]
        return normal, right, by_y


def _over_sigma(rows: FloatArray, noise: FloatArray) -> FloatArray:
    """Rows over the noise's standard deviation, or its root where it is a matrix."""
    if noise.ndim == 1:
        return np.asarray(rows / np.sqrt(noise)[:, None])
    return np.asarray(solve_triangular(root(noise, 'noise'), rows, lower=True))


def _kept(array: FloatArray) -> FloatArray:
    """Return a copy of one's own that nobody can write to."""
    return np.asarray(read_only(array.copy()))
