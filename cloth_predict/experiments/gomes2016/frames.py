"""Markers at even times, and how wrong predictions of them were."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, nan

import numpy as np

from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.types import BoolArray, FloatArray, IntArray

TS = 0.1
"""How far ahead the thesis predicts [s], and how often (Gomes 2016, section 6.4)."""


@dataclass(frozen=True)
class Frames:
    """Markers of a surface at even times.

    interval [s]; positions [m], shape (frames, nodes, 3), and visible, (frames, nodes), as
    measured; actual [m], shape (frames, nodes, 3), what predictions are held against.
    """

    interval: float
    positions: FloatArray
    visible: BoolArray
    actual: FloatArray

    @classmethod
    def exact(cls, positions: FloatArray, interval: float) -> Frames:
        """Markers that are seen without noise, as the simulated ones of the thesis."""
        return cls(interval, positions, np.ones(positions.shape[:2], bool), positions)

    @classmethod
    def of_states(
        cls, cloth: MassSpring, nodes: FloatArray, states: FloatArray, interval: float
    ) -> Frames:
        """Markers on all nodes of a simulated cloth; driven ones stand still at `nodes` [m]."""
        positions = np.tile(nodes, (len(states), 1, 1))
        n = 3 * len(cloth.free)
        positions[:, cloth.free] = states[:, :n].reshape(len(states), -1, 3)
        return cls.exact(positions, interval)

    def times(self, at: IntArray) -> FloatArray:
        """Times of some frames [s]."""
        return np.asarray(at * self.interval, float)

    def filled(self) -> Frames:
        """Close gaps with straight lines: the recordings of the thesis have none."""
        positions, at = self.positions.copy(), np.arange(len(self.positions))
        for node in np.flatnonzero(~self.visible.all(axis=0)):
            seen = self.visible[:, node]
            for axis in range(3):
                positions[:, node, axis] = np.interp(at, at[seen], positions[seen, node, axis])
        return replace(self, positions=positions, visible=np.ones_like(self.visible))


@dataclass(frozen=True)
class Track:
    """How wrong the predictions of a filter were.

    times [s], shape (steps,), predicted for; error [m], shape (steps, nodes, 3), NaN where there
    was no prediction; condition, shape (steps,), of the covariance after the update before; lost:
    when the filter gave up [s], or infinite.
    """

    times: FloatArray
    error: FloatArray
    condition: FloatArray
    lost: float = inf

    @classmethod
    def of(cls, frames: Frames, at: IntArray, error: FloatArray) -> Track:
        """Return the errors [m] of predictions for some frames, shape (steps,), without P."""
        return cls(frames.times(at), error, np.full(len(at), nan))

    @property
    def mse(self) -> FloatArray:
        """Mean squared error of a coordinate [m^2], shape (steps,) (Gomes 2016, eq. 6.12)."""
        return np.asarray(np.square(self.error).mean(axis=(1, 2)))

    @property
    def distance(self) -> FloatArray:
        """Distance of each node from its prediction [m], shape (steps, nodes) (6.13)."""
        return np.asarray(np.linalg.norm(self.error, axis=2))

    @property
    def peak(self) -> float:
        """Largest mean squared error [m^2]; NaN of no prediction."""
        known = self.mse[np.isfinite(self.mse)]
        return float(known.max()) if len(known) else nan

    @property
    def farthest(self) -> float:
        """Largest distance of a node [m]; NaN of no prediction."""
        known = self.distance[np.isfinite(self.distance)]
        return float(known.max()) if len(known) else nan

    @property
    def rms(self) -> float:
        """RMS distance of all nodes from their predictions [m]; NaN of no prediction."""
        known = self.distance[np.isfinite(self.distance)]
        return float(np.sqrt(np.square(known).mean())) if len(known) else nan

    def after(self, time: float) -> Track:
        """What was predicted for times after this one [s]."""
        late = self.times > time
        return replace(
            self, times=self.times[late], error=self.error[late], condition=self.condition[late]
        )

    def around(self, time: float, width: float = 1.0) -> float:
        """Mean of the mean squared errors [m^2] over `width` [s] up to a time [s]."""
        near = self.mse[(self.times > time - width + 1e-9) & (self.times < time + 1e-9)]
        return float(np.mean(near[np.isfinite(near)])) if np.isfinite(near).any() else nan


def held(frames: Frames, horizon: float = TS) -> Track:
    """Take each marker for where it was last seen `horizon` [s] before."""
    every = round(horizon / frames.interval)
    at, filled = np.arange(every, len(frames.positions), every), frames.filled()
    error = filled.positions[at - every] - frames.actual[at]
    return Track.of(frames, at, error)
