"""Predictions over recordings: by the recursion of the thesis, and by this project's tracker."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan
from typing import Any

import numpy as np
from scipy import sparse

from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.evaluation.conditioning import condition_number
from cloth_predict.experiments.gomes2016.frames import TS, Frames, Track
from cloth_predict.filters.gomes2016 import Gomes2016
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.observations import VisiblePositions
from cloth_predict.tracker import NANOSECONDS, Tracker
from cloth_predict.types import FloatArray, Gaussian, IntArray


@dataclass(frozen=True)
class EulerStep:
    """A model whose `jac` is that of its explicit Euler step, I + Ts J, in place of J.

    In the recursion of the thesis it makes of (6.1) what its own step (6.5) asks for.
    """

    model: MassSpring
    step: float

    def jac(self, x: FloatArray, u: FloatArray) -> sparse.csr_array:
        """Jacobian of the step, shape (dim_x, dim_x)."""
        return sparse.csr_array(sparse.eye(len(x)) + self.step * self.model.jac(x, u))

    def __getattr__(self, name: str) -> object:
        return getattr(self.model, name)


def by_the_letter(
    model: MassSpring | EulerStep,
    frames: Frames,
    alpha: float,
    beta: float,
    step: float = TS,
    conditions: bool = False,
) -> Track:
    """Run the recursion (6.1-6.11) with Q = alpha I and R = beta I every `step` [s].

    It starts at the first frame at rest with P = 0 (6.15) and predicts each time for the next.
    Driven nodes are where they were last measured.
    """
    run = _Recursion(model, frames, alpha, beta, step)
    at = np.arange(run.every, len(frames.positions), run.every)
    error, condition = np.full((len(at), run.mesh.nodes, 3), nan), np.full(len(at), nan)
    lost = inf
    for i, k in enumerate(at):
        try:
            error[i] = run.predict()[0] - frames.actual[k]
            run.update(int(k))
        except FloatingPointError:
            lost = float(k * frames.interval)
            break
        if conditions:
            condition[i] = condition_number(run.belief.cov)
    return Track(frames.times(at), error, condition, lost)


def followed(
    model: MassSpring | EulerStep, frames: Frames, alpha: float, beta: float, step: float
) -> FloatArray:
    """Positions [m] and velocities [m/s] after each update, (steps + 1, 2, nodes, 3).

    NaN once the recursion is lost.
    """
    run = _Recursion(model, frames, alpha, beta, step)
    found = np.full((len(frames.positions[:: run.every]), 2, run.mesh.nodes, 3), nan)
    found[0] = run.surface()
    for i in range(1, len(found)):
        try:
            run.predict()
            run.update(i * run.every)
        except FloatingPointError:
            break
        found[i] = run.surface()
    return found


class _Recursion:
    """The belief of the recursion as it goes from measurement to measurement."""

    def __init__(
        self,
        model: MassSpring | EulerStep,
        frames: Frames,
        alpha: float,
        beta: float,
        step: float,
    ) -> None:
        self.mesh = model.model if isinstance(model, EulerStep) else model
        self.every = round(step / frames.interval)
        self._model: Any = model
        self._frames, self._beta, self._step = frames, beta, step
        size = self.mesh.dim_x
        self._noise = np.full(size, alpha / step)
        self._held = frames.positions[0, self.mesh.driven]
        start = frames.positions[0, self.mesh.free].ravel()
        prior = Gaussian(np.concatenate([start, np.zeros(size // 2)]), np.eye(size))
        self.belief = Gomes2016().start(prior, self.mesh, self._input(), self._noise)

    def surface(self) -> FloatArray:
        """Positions [m] and velocities [m/s] of all nodes, shape (2, nodes, 3)."""
        return np.stack(self.mesh.surface(self.belief.mean, self._input()))

    def predict(self) -> FloatArray:
        """Go one step ahead; returns the surface there."""
        self.belief = Gomes2016().predict(
            self.belief, self._model, self._input(), self._noise, self._step
        )
        return self.surface()

    def update(self, k: int) -> None:
        """Take a frame: its free nodes are measured, its driven ones known."""
        frames, mesh = self._frames, self.mesh
        seen = frames.visible[k, mesh.free]
        obs = VisiblePositions.of_nodes(np.flatnonzero(seen), np.sqrt(self._beta))
        z = frames.positions[k, mesh.free][seen].ravel()
        self.belief, _ = Gomes2016().update(self.belief, obs, z)
        there = frames.visible[k, mesh.driven]
        self._held = np.where(there[:, None], frames.positions[k, mesh.driven], self._held)

    def _input(self) -> FloatArray:
        return self.mesh.input(self._held)


def tracked(config: Config, frames: Frames, horizon: float = TS) -> Track:
    """Run the tracker over every frame, and predict `horizon` [s] ahead as often as that."""
    tracker, every = Tracker(config), round(horizon / frames.interval)
    at: IntArray = np.arange(every, len(frames.positions), every)
    error = np.full((len(at), *frames.actual.shape[1:]), nan)
    for k in range(len(frames.positions)):
        tracker.step(
            round(k * frames.interval * NANOSECONDS), frames.positions[k], frames.visible[k]
        )
        i = k // every
        if k % every or i >= len(at):
            continue
        try:
            error[i] = tracker.predict(horizon).position - frames.actual[at[i]]
        except FrameError:
            continue
    return Track.of(frames, at, error)
