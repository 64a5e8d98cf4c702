"""The start of a body: from the markers of a frame to its shape, its pose and a first belief."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cloth_predict.bodies.assembly import (
    Assembly,
    assemble,
    free_parameters,
    initial_parameters,
    mesh_of,
)
from cloth_predict.bodies.association import UNNAMED, Attached, attach
from cloth_predict.bodies.global_fit import GlobalFit, global_fit
from cloth_predict.bodies.moments import Ellipsoid, ellipsoid
from cloth_predict.config import Config
from cloth_predict.errors import ConfigError, FrameError
from cloth_predict.models import rotation
from cloth_predict.models.superquadric import GLOBAL
from cloth_predict.observations import NodePositions
from cloth_predict.tracking.track import Frame
from cloth_predict.types import Belief, BoolArray, FloatArray, Gaussian, IntArray

ROUNDS = 8
"""Rounds of leaving out what is not on the body after which it is left at that."""
INSIDE, OUTSIDE = 0.5, 1.6
"""Distance from the middle, in semi-axes and by the median, of what may be on the body."""


@dataclass(frozen=True)
class Start:
    """A body in its first frame; places [m], shape (k, 3): of the markers that are on it."""

    assembly: Assembly
    belief: Belief
    attached: Attached
    places: FloatArray


class Starter:
    """Fits a body to the markers of a frame; `reason` says in a line why it could not."""

    def __init__(self, config: Config) -> None:
        """Prepare. Raises ConfigError for parameters of a body that are none."""
        self.reason = 'no frame yet'
        self._config = config
        self._initial = initial_parameters(config.body)
        self._fewest = int(free_parameters(config.body).sum())

    def offer(self, frame: Frame) -> Start | None:
        """Start at rest at this frame, or None where it does not show a body."""
        try:
            start = self._started(frame)
        except (FrameError, ConfigError) as error:  # such as of a mesh through markers
            self.reason = str(error)
            return None
        self.reason = ''
        return start

    def _started(self, frame: Frame) -> Start:
        named = np.flatnonzero(frame.visible)
        places = np.concatenate([frame.positions[named], frame.points])
        label = np.append(named, np.full(len(frame.points), UNNAMED))
        self._require(len(places))
        guess, on_body = _guess(places)
        places, label = places[on_body], label[on_body]
        self._require(len(places))
        if self._config.nodes_are_markers:
            order = self._by_label(label)
            places, label = places[order], label[order]
        shared, directions = self._fitted(guess, places)
        mesh = mesh_of(self._config, directions)
        assembly = assemble(self._config, mesh, shared[GLOBAL])
        attached = self._attached(assembly, assembly.at_rest(shared), places, label, frame.stamp)
        return Start(assembly, self._first(assembly, shared, attached, places), attached, places)

    def _require(self, markers: int) -> None:
        if markers < self._fewest:
            raise FrameError(
                f'{markers} markers, fewer than the {self._fewest} global parameters of a body '
                f'(those in body.fixed do not count)'
            )

    def _by_label(self, label: IntArray) -> IntArray:
        """Order in which each label is the node of its number; points take what is left."""
        nodes, named = self._config.model.nodes, label[label != UNNAMED]
        if len(label) != nodes:
            raise FrameError(f'{len(label)} of {nodes} markers seen, of which each is a node')
        return np.argsort(np.append(named, np.setdiff1d(np.arange(nodes), named)))

    def _fitted(self, guess: Ellipsoid, places: FloatArray) -> GlobalFit:
        parameters = guess.parameters if self._initial is None else self._initial
        theta = rotation.from_matrix(guess.rotation)
        begin = np.concatenate([guess.centre, theta, parameters])
        return global_fit(begin, free_parameters(self._config.body), places)

    def _attached(
        self, assembly: Assembly, mean: FloatArray, places: FloatArray, label: IntArray, stamp: int
    ) -> Attached:
        """Markers at nodes of their own, or at the nearest ones."""
        if self._config.body.mesh == 'markers':
            number, seen = np.arange(len(places)), np.full(len(places), stamp)
            return Attached(number, np.zeros_like(places), label, seen)
        body = assembly.body
        return attach(places, label, stamp, body.mesh, body.position(mean), body.rotation(mean))

    def _first(
        self, assembly: Assembly, shared: FloatArray, attached: Attached, places: FloatArray
    ) -> Belief:
        """What the filter believes after the first frame."""
        mean, sigma = assembly.at_rest(shared), self._config.filter.measurement_noise
        prior = Gaussian(mean, np.diag(assembly.first**2))
        first = assembly.filter.start(prior, assembly.model, assembly.still, assembly.noise)
        obs = NodePositions(assembly.body, attached.node, sigma)
        z = attached.of_nodes(places, assembly.body.rotation(mean))
        belief: Belief = assembly.filter.update(first, obs, z.ravel())[0]
        return belief


def _guess(places: FloatArray) -> tuple[Ellipsoid, BoolArray]:
    """An ellipsoid by the points [m], (m, 3), that may be on one surface, and which they are."""
    on_body = np.ones(len(places), bool)
    for _ in range(ROUNDS):
        guess = ellipsoid(places[on_body])
        size = np.linalg.norm(guess.in_axes(places), axis=1)
        size /= np.median(size)
        before, on_body = on_body, (size > INSIDE) & (size < OUTSIDE)
        if np.array_equal(on_body, before):
            break
    return guess, on_body
