"""The whole method, and its only state: what is believed of the surface, and when."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import ceil

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from cloth_predict.config import Config, ModelConfig
from cloth_predict.errors import FrameError
from cloth_predict.filters.ekf import ExtendedKalmanFilter
from cloth_predict.filters.kinematic import KinematicTrack
from cloth_predict.integrators import INTEGRATORS
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.models.springs import Springs, grid_pairs
from cloth_predict.observations import VisiblePositions
from cloth_predict.types import BoolArray, FloatArray, Gaussian, Innovation, IntArray, Surface

NANOSECONDS = 1e9
FEWEST_TO_START = 3
"""Visible nodes without which the first surface would be a guess."""


@dataclass(frozen=True)
class Step:
    """What became of a frame: `updated`, `started`, `restarted`, `waiting` or `late`."""

    outcome: str
    innovation: Innovation | None = None


class Tracker:
    """Follows a surface through frames of markers and predicts it; marker i is node i."""

    def __init__(self, config: Config) -> None:
        """Prepare; the surface starts with the first frame that shows enough of it."""
        self.config = config
        self.nodes = config.model.rows * config.model.cols
        self.counts: Counter[str] = Counter()
        self._stamp: int | None = None
        self._belief: Gaussian | None = None
        self._filter = ExtendedKalmanFilter(INTEGRATORS[config.filter.integrator])

    @property
    def started(self) -> bool:
        """Whether there is a surface to predict."""
        return self._belief is not None

    def step(self, stamp: int, positions: FloatArray, visible: BoolArray) -> Step:
        """Take a frame: stamp [ns], positions [m], shape (nodes, 3), visible, shape (nodes,).

        Raises FrameError, and changes nothing, where the frame does not fit the model.
        """
        self._check(positions, visible)
        step = self._advance(stamp, positions, visible)
        self.counts[step.outcome] += 1
        return step

    def estimate(self) -> Surface:
        """Return the surface at the last frame."""
        belief, rows = self._started_belief(), self._position_rows()
        return self._surface(belief.mean, np.diagonal(belief.cov)[rows], 0.0)

    def predict(self, horizon: float) -> Surface:
        """Return the surface `horizon` [s] after the last frame, by running the model there."""
        belief = self._started_belief()
        steps, dt = self._steps(horizon)
        inputs = [self._input((k + 1) * dt) for k in range(steps)]
        mean, variance = self._filter.forecast(
            belief, self._model, inputs, self._noise, dt, self._position_rows()
        )
        return self._surface(mean, variance, horizon)

    def _check(self, positions: FloatArray, visible: BoolArray) -> None:
        if positions.shape != (self.nodes, 3) or visible.shape != (self.nodes,):
            raise FrameError(
                f'{len(positions)} markers, but model.rows x model.cols has {self.nodes} nodes'
            )
        bad = visible & ~np.isfinite(positions).all(axis=1)
        if bad.any():
            raise FrameError(f'marker {int(bad.argmax())} has a coordinate that is not finite')

    def _advance(self, stamp: int, positions: FloatArray, visible: BoolArray) -> Step:
        if self._stamp is None or self._belief is None:
            return self._start(stamp, positions, visible, 'started')
        dt = (stamp - self._stamp) / NANOSECONDS
        if dt > self.config.filter.max_gap or dt < -self.config.filter.max_backstep:
            return self._start(stamp, positions, visible, 'restarted')
        if dt <= 0:
            return Step('late')
        try:
            innovation = self._update(positions, visible, dt)
        except FloatingPointError:
            self.counts['diverged'] += 1
            return self._start(stamp, positions, visible, 'restarted')
        self._stamp = stamp
        return Step('updated', innovation)

    def _start(self, stamp: int, positions: FloatArray, visible: BoolArray, outcome: str) -> Step:
        self._stamp = self._belief = None
        driven = list(self.config.anchors.nodes)
        if visible.sum() < min(FEWEST_TO_START, self.nodes) or not visible[driven].all():
            return Step('waiting')
        settings, anchors = self.config.filter, self.config.anchors
        filled, spread = complete(self.config.model, positions, visible)
        mesh = build_mass_spring(self.config, filled)
        force_noise: list[float] = []
        self._mesh, self._model = mesh, mesh
        if self.config.force.kind != 'none':
            self._model = Disturbed(mesh, self.config.force.tau)
            sigma, tau = self.config.force.sigma, self.config.force.tau
            force_noise = [2 * sigma**2 / tau] * (3 * len(mesh.free))
        self._tracks = [
            KinematicTrack(
                anchors.motion,
                anchors.process_noise,
                settings.measurement_noise,
                filled[node],
                settings.initial_velocity,
            )
            for node in driven
        ]
        size = 3 * len(mesh.free)
        self._noise = np.concatenate(
            [np.zeros(size), np.full(size, settings.process_noise), force_noise]
        )
        variance = np.concatenate(
            [
                np.repeat((settings.measurement_noise + spread[mesh.free]) ** 2, 3),
                np.full(size, settings.initial_velocity**2),
                np.full(len(force_noise), self.config.force.sigma**2),
            ]
        )
        mean = np.zeros(len(variance))
        mean[:size] = filled[mesh.free].ravel()
        self._belief = Gaussian(mean, np.diag(variance))
        self._stamp = stamp
        return Step(outcome)

    def _update(self, positions: FloatArray, visible: BoolArray, dt: float) -> Innovation:
        belief = self._started_belief()
        for node, track in zip(self._mesh.driven, self._tracks, strict=True):
            track.predict(dt)
            if visible[node]:
                track.update(positions[node])
        steps, part = self._steps(dt)
        for k in range(steps):
            # the input at the end of each part, counted back from the frame
            u = self._input((k + 1) * part - dt)
            belief = self._filter.predict(belief, self._model, u, self._noise, part)
        seen = np.flatnonzero(visible[self._mesh.free])
        obs = VisiblePositions.of_nodes(seen, self.config.filter.measurement_noise)
        z = positions[self._mesh.free[seen]].ravel()
        belief, innovation = self._filter.update(belief, obs, z)
        if not np.isfinite(belief.mean).all():
            raise FloatingPointError('the estimate is not finite')
        self._belief = belief
        return innovation

    def _steps(self, duration: float) -> tuple[int, float]:
        """Split a duration into equal steps no longer than `max_step`, but for rounding."""
        steps = max(ceil(duration / self.config.filter.max_step - 1e-6), 1 if duration else 0)
        return steps, duration / max(steps, 1)

    def _input(self, ahead: float) -> FloatArray:
        if not self._tracks:
            return self._mesh.input()
        derivatives = np.array([track.extrapolate(ahead) for track in self._tracks])
        return self._mesh.input(derivatives[:, 0], derivatives[:, 1])

    def _started_belief(self) -> Gaussian:
        if self._belief is None:
            raise FrameError('no surface yet: not enough markers have been seen')
        return self._belief

    def _position_rows(self) -> IntArray:
        return np.arange(3 * len(self._mesh.free))

    def _surface(self, mean: FloatArray, variance: FloatArray, ahead: float) -> Surface:
        mesh, u = self._mesh, self._input(ahead)
        size = 3 * len(mesh.free)
        position, velocity = mesh.surface(mean, u)
        acceleration, sigma = np.zeros((self.nodes, 3)), np.zeros(self.nodes)
        acceleration[mesh.free] = self._model.f(mean, u)[size : 2 * size].reshape(-1, 3)
        sigma[mesh.free] = np.sqrt(np.maximum(variance.reshape(-1, 3).mean(axis=1), 0.0))
        for node, track in zip(mesh.driven, self._tracks, strict=True):
            acceleration[node] = track.extrapolate(ahead)[2]
            sigma[node] = track.variance(ahead) ** 0.5
        assert self._stamp is not None
        return Surface(
            self._stamp + round(ahead * NANOSECONDS), position, velocity, acceleration, sigma
        )


def rest_shape(model: ModelConfig) -> FloatArray:
    """Flat grid at rest [m], shape (nodes, 3): rows go down (-y), columns to the right (+x)."""
    x = np.linspace(0.0, model.width, model.cols) if model.cols > 1 else np.zeros(1)
    y = -np.linspace(0.0, model.height, model.rows) if model.rows > 1 else np.zeros(1)
    grid = np.zeros((model.rows, model.cols, 3))
    grid[..., 0], grid[..., 1] = x, y[:, None]
    return grid.reshape(-1, 3)


def build_mass_spring(config: Config, surface: FloatArray) -> MassSpring:
    """Build the configured model; `surface` [m], shape (nodes, 3), gives measured rest lengths."""
    model = config.model
    families = grid_pairs(model.rows, model.cols)
    pairs = np.concatenate(list(families.values()))
    shape = rest_shape(model) if model.rest_length == 'dimensions' else surface
    rest_length = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)
    stiffness = np.concatenate(
        [np.full(len(p), getattr(model, f'stiffness_{name}')) for name, p in families.items()]
    )
    nodes = model.rows * model.cols
    springs = Springs(pairs, stiffness, np.full(len(pairs), model.damping), rest_length)
    mass = np.full(nodes, model.mass / nodes)
    return MassSpring(springs, mass, list(config.anchors.nodes), np.array(model.gravity))


def complete(
    model: ModelConfig, positions: FloatArray, visible: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Fill in the nodes that are not visible by the mean of their neighbours.

    Returns positions [m], shape (nodes, 3), and a standard deviation [m], shape (nodes,): zero
    where measured, the length of the shortest side of a cell where filled in.
    """
    spread = np.zeros(len(positions))
    if visible.all():
        return positions, spread
    pairs = grid_pairs(model.rows, model.cols)['structural']
    i, j = pairs.T
    graph = sparse.coo_array((np.ones(len(pairs)), (i, j)), shape=(len(positions),) * 2)
    laplacian = sparse.csr_array(sparse.csgraph.laplacian(graph + graph.T))
    hidden = np.flatnonzero(~visible)
    seen = np.flatnonzero(visible)
    right = -(laplacian[hidden][:, seen] @ positions[seen])
    filled = positions.copy()
    filled[hidden] = spsolve(sparse.csc_array(laplacian[hidden][:, hidden]), right).reshape(-1, 3)
    shape = rest_shape(model)
    spread[hidden] = np.linalg.norm(shape[i] - shape[j], axis=1).min()
    return filled, spread
