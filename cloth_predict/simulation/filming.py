"""Runs a simulated scene and says where its nodes are at each frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from cloth_predict.integrators.runge_kutta import RK4, RungeKutta
from cloth_predict.types import Dynamics, FloatArray, IntArray

Progress = Callable[[float], None]
"""Called with the seconds that were simulated since the last call."""


class Scene(Dynamics, Protocol):
    """A motion of which time is the last state, so that its input stays as it is at the start."""

    @property
    def hung(self) -> FloatArray:
        """The input, shape (dim_u,)."""

    def positions(self, x: FloatArray) -> FloatArray:
        """Positions of all nodes [m], shape (nodes, 3)."""


def film(
    scene: Scene, x: FloatArray, times: FloatArray, step: float, progress: Progress
) -> FloatArray:
    """Positions [m] of all nodes at times [s], (times, nodes, 3), by steps of at most `step`."""
    method = RungeKutta(RK4)
    frames = [scene.positions(x)]
    for duration in np.diff(times):
        parts = int(np.ceil(duration / step - 1e-9))
        for _ in range(parts):
            x = method.step(scene, x, scene.hung, duration / parts)
        if not np.isfinite(x).all():
            raise FloatingPointError(f'the simulation diverges with a step of {step} s')
        frames.append(scene.positions(x))
        progress(float(duration))
    return np.array(frames)


def frame_stamps(duration: float, rate: int = 100) -> IntArray:
    """Stamps [ns] of the frames of `duration` [s], from 0 on, `rate` in a second."""
    return np.arange(round(duration * rate) + 1, dtype=np.int64) * (10**9 // rate)
