"""The driven nodes: what moves them is not modelled, so each has a kinematic filter of its own."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from cloth_predict.config import AnchorsConfig, Config
from cloth_predict.filters.kinematic import POLYNOMIALS, Motion, swing
from cloth_predict.filters.kinematic_bank import KinematicBank
from cloth_predict.integrators.family import INTEGRATORS
from cloth_predict.types import BoolArray, Dynamics, FloatArray, IntArray


def motion_of(anchors: AnchorsConfig) -> Motion:
    """Return how a coordinate of a driven node moves."""
    if anchors.motion == 'swing':
        return swing(anchors.decay, anchors.restoring)
    return POLYNOMIALS[anchors.motion]


class DrivenNodes:
    """Follows the driven nodes and extrapolates them; `nodes`, shape (driven,), are their markers.

    What is extrapolated has shape (driven, 3), in the order of `nodes`.
    """

    def __init__(
        self, config: Config, nodes: IntArray, surface: FloatArray, drive: FloatArray | None = None
    ) -> None:
        """Start at `surface` [m], shape (markers, 3).

        drive, shape (driven mesh nodes, driven): how they move those of the model, if not as one.
        """
        self.nodes = nodes
        drive = np.eye(len(nodes)) if drive is None else drive
        self._drive = np.kron(drive, np.eye(3))
        self._integrator = INTEGRATORS[config.filter.integrator]
        self._moving = bool(len(nodes)) and config.anchors.motion != 'fixed'
        unseen = KinematicBank.unseen(
            motion_of(config.anchors),
            config.anchors.process_noise,
            config.filter.measurement_noise,
            len(nodes),
            config.filter.initial_velocity,
        )
        self._bank, _ = unseen.updated(surface[nodes], np.ones(len(nodes), bool))

    @property
    def bank(self) -> KinematicBank:
        """What is believed of each driven marker."""
        return self._bank

    def copy(self) -> DrivenNodes:
        """Return a copy that can be moved on by itself."""
        return copy.copy(self)  # a bank is never changed once made

    def advance(self, dt: float) -> None:
        """Move on by dt [s]."""
        if len(self.nodes):
            self._bank = self._bank.moved(dt)

    def update(self, positions: FloatArray, visible: BoolArray) -> None:
        """Take the measured positions [m], shape (nodes, 3), of the visible ones, (nodes,)."""
        if visible[self.nodes].any():
            self._bank, _ = self._bank.updated(positions[self.nodes], visible[self.nodes])

    def extrapolate(self, ahead: float) -> FloatArray:
        """Positions [m], velocities and accelerations after `ahead` [s], shape (3, driven, 3)."""
        derivatives = np.zeros((3, len(self.nodes), 3))
        if not self._moving:
            derivatives[0] = self._bank.mean[:, 0]
            return derivatives
        derivatives[: self._bank.motion.order] = self._bank.mean_at(ahead).transpose(1, 0, 2)
        return derivatives

    def path(self, times: Sequence[float]) -> list[tuple[FloatArray, FloatArray]]:
        """Position [m] at the start of each interval between `times` [s], and mean velocity."""
        at = [self.extrapolate(time)[0] for time in times]
        return [
            (at[k], (at[k + 1] - at[k]) / (times[k + 1] - times[k])) for k in range(len(at) - 1)
        ]

    def spread(
        self, model: Dynamics, mean: FloatArray, inputs: Sequence[FloatArray], dt: float
    ) -> FloatArray:
        """What the state owes to the errors of the extrapolation, shape (dim_x, columns).

        S S' is the covariance of the state after one step of dt [s] per input that comes from not
        knowing where the driven nodes go. The error of a coordinate is taken to keep its sign and
        to grow as its standard deviation does.
        """
        size, count = self._drive.shape
        spread = np.zeros((model.dim_x, count))
        if not self._moving or not inputs:
            return spread[:, :0]
        sigma = np.sqrt([self.variances(k * dt) for k in range(len(inputs) + 1)]).repeat(3, axis=1)
        change = np.zeros((model.dim_u, count))
        for u, now, then in zip(inputs, sigma[:-1], sigma[1:], strict=True):
            mean, tangent = self._integrator.step_tangent(model, mean, u, dt)
            change[:size] = self._drive * now
            change[size : 2 * size] = self._drive * ((then - now) / dt)
            spread = tangent.push(spread) + tangent.drive(change)
        return spread

    def variances(self, ahead: float) -> FloatArray:
        """Variance [m^2] of a coordinate of the positions after `ahead` [s], shape (driven,)."""
        return self._bank.ahead(ahead)[1] if len(self.nodes) else np.zeros(0)
