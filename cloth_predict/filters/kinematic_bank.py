"""Kinematic Kalman filters of many markers at once, each marker by itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

import numpy as np

from cloth_predict.filters.kinematic import Motion
from cloth_predict.types import BoolArray, FloatArray


@dataclass(frozen=True)
class KinematicBank:
    """What is believed of each marker; never changed once made.

    motion of each coordinate of each marker, of which `order` derivatives are the state; mean,
    shape (markers, order, 3): position [m] and its derivatives; cov, shape
    (markers, order, order), of each coordinate; both NaN of a marker that was never seen.
    density, shape (markers,): spectral densities of the driving noise; variance [m^2] of a
    measured coordinate; spread: standard deviation of the unknown derivatives when a marker is
    first seen, in SI units.
    """

    motion: Motion
    mean: FloatArray
    cov: FloatArray
    density: FloatArray
    variance: float
    spread: float = 1.0

    @classmethod
    def unseen(
        cls,
        motion: Motion,
        density: float | FloatArray,
        sigma: float,
        markers: int,
        spread: float = 1.0,
    ) -> KinematicBank:
        """Nothing is known yet; density of all or of each, sigma [m] of a measured coordinate."""
        order = motion.order
        mean, cov = np.full((markers, order, 3), nan), np.full((markers, order, order), nan)
        return cls(motion, mean, cov, np.broadcast_to(density, markers), sigma**2, spread)

    def mean_at(self, ahead: float) -> FloatArray:
        """Position [m] and its derivatives `ahead` [s] later, shape (markers, order, 3)."""
        return self.motion.over(ahead)[0] @ self.mean

    def moved(self, dt: float) -> KinematicBank:
        """Return the belief dt [s] later."""
        step, noise = self.motion.over(dt)
        cov = step @ self.cov @ step.T + self.density[:, None, None] * noise
        return replace(self, mean=step @ self.mean, cov=cov)

    def updated(self, positions: FloatArray, visible: BoolArray) -> tuple[KinematicBank, float]:
        """Take measured positions [m], shape (markers, 3), of the visible ones, (markers,).

        Returns the belief, and the normalised innovation squared per degree of freedom, NaN where
        none was seen before.
        """
        seen = np.isfinite(self.cov[:, 0, 0])
        known, new = np.flatnonzero(visible & seen), np.flatnonzero(visible & ~seen)
        mean, cov, order = self.mean.copy(), self.cov.copy(), self.motion.order
        residual, before = positions[known] - mean[known, 0], cov[known]
        total = before[:, 0, 0] + self.variance
        gain = before[:, :, 0] / total[:, None]
        mean[known] += gain[:, :, None] * residual[:, None]
        keep = np.eye(order) - gain[:, :, None] * np.eye(1, order)
        noise = self.variance * gain[:, :, None] * gain[:, None]
        cov[known] = keep @ before @ keep.transpose(0, 2, 1) + noise  # Joseph's form
        mean[new], mean[new, 0] = 0.0, positions[new]
        cov[new] = np.diag([self.variance] + [self.spread**2] * (order - 1))
        nis = float(np.mean(residual**2 / total[:, None])) if len(known) else nan
        return replace(self, mean=mean, cov=cov), nis

    def ahead(self, horizon: float) -> tuple[FloatArray, FloatArray]:
        """Positions [m], shape (markers, 3), `horizon` [s] ahead; variances [m^2], (markers,)."""
        later = self.moved(horizon)
        return later.mean[:, 0], later.cov[:, 0, 0]
