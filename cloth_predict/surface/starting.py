"""The start: from the first frames to a model, its filter and a first belief."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FrameError
from cloth_predict.filters.family import build_filter
from cloth_predict.markers.labelling import follow, label
from cloth_predict.models.disturbed import Disturbed
from cloth_predict.models.mass_spring import MassSpring
from cloth_predict.surface.assembly import (
    build_mass_spring,
    complete,
    first_belief,
    lengths_of,
    on_mesh,
    topology_of,
)
from cloth_predict.surface.calibration import Calibration, Frame, filled_in, median_lengths
from cloth_predict.surface.driven import DrivenNodes
from cloth_predict.surface.forces import disturbed, process_noise
from cloth_predict.surface.layout import Layout, lay_out
from cloth_predict.surface.topology import Topology
from cloth_predict.types import Belief, BoolArray, Filter, FloatArray

FEWEST_TO_START = 3
"""Visible nodes without which the first surface would be a guess."""
PAUSE = 250_000_000
"""Nanoseconds after which a failed search for the nodes among unlabelled points, which takes as
long as many frames, is tried again."""
MOST_NAMED = 4
"""Nodes that a reason names one by one."""


@dataclass(frozen=True)
class Start:
    """All that following a surface needs.

    noise, shape (dim_x,): spectral densities; topology: of the markers.
    """

    mesh: MassSpring
    model: MassSpring | Disturbed
    noise: FloatArray
    filter: Filter[Any]
    driven: DrivenNodes
    belief: Belief
    topology: Topology
    layout: Layout
    nearest: FloatArray
    """Distance [m] of each marker from its nearest neighbour at rest, shape (markers,)."""

    def input(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Input for positions [m] and velocities [m/s] of the driven markers, (driven, 3)."""
        drive = self.layout.drive
        return self.mesh.input(drive @ position, drive @ velocity)


class Starter:
    """Takes frames until there is enough to start from; `reason` says in a line what it lacks.

    One that is kept over a restart need not calibrate again, if the markers have labels.
    """

    def __init__(self, config: Config) -> None:
        self.reason = 'no frame yet'
        self._config = config
        self._calibration = Calibration(config.model.calibration)
        self._topology: Topology | None = None
        self._rest_length: FloatArray | None = None
        self._failure: tuple[int, str] | None = None
        """When [ns] and why the nodes were last not found among unlabelled points."""

    def offer(
        self, stamp: int, positions: FloatArray, visible: BoolArray, points: FloatArray
    ) -> Start | None:
        """Start at rest at this frame, or None where it takes more.

        stamp [ns]; positions [m], shape (nodes, 3), and visible, shape (nodes,), of the labelled
        markers; points [m], shape (m, 3), of those without a label.
        """
        if self._calibration.running and not self._follows(stamp):
            return None
        try:
            frame = self._labelled(Frame(stamp, positions, visible), points)
            start = self._started(frame)
        except FrameError as error:
            self.reason = str(error)
            return None
        self.reason = ''
        self._calibration = Calibration(self._config.model.calibration)
        if not visible.any():  # next time the numbering may be another
            self._topology = self._rest_length = None
        return start

    def _follows(self, stamp: int) -> bool:
        """Whether a frame lies after those collected; forgets them where time has jumped."""
        since, settings = self._calibration.since(stamp), self._config.filter
        if since > settings.max_gap or since < -settings.max_backstep:
            self._calibration, self._topology = Calibration(self._calibration.duration), None
            return True
        return since > 0

    def _labelled(self, frame: Frame, points: FloatArray) -> Frame:
        """Find hidden nodes among the points. Raises FrameError where it cannot do without."""
        if not len(points) or frame.visible.all():
            return frame
        if self._calibration.running and self._topology is not None:
            last, edges = self._calibration.last, self._topology.edges
            return Frame(frame.stamp, *follow(last, edges, *frame[1:], points))
        try:
            return self._searched(frame, points)
        except FrameError:
            if self._lack(frame):
                raise
            return frame

    def _searched(self, frame: Frame, points: FloatArray) -> Frame:
        if self._failure and 0 <= frame.stamp - self._failure[0] < PAUSE:
            raise FrameError(self._failure[1])
        try:
            found = label(self._config.model, *frame[1:], points)
        except FrameError as error:
            self._failure = frame.stamp, str(error)
            raise
        self._failure = None
        return Frame(frame.stamp, *found)

    def _started(self, frame: Frame) -> Start:
        """Start at a frame. Raises FrameError that says what is lacking."""
        if not self._calibration.running:
            self._require(frame)
        if self._topology is None:
            self._topology = topology_of(self._config.model, frame.positions)
        joined, model = self._topology, self._config.model
        if model.rest_length == 'calibrated' and self._rest_length is None:
            self._collect(frame, joined)
            self._require(frame)
            self._rest_length = self._calibration.lengths(joined.pairs)
        surface, spread = complete(model, frame.positions, frame.visible, joined)
        if self._calibration.running:
            surface, spread = self._remembered(frame, joined, spread)
        return _built(self._config, surface, spread, joined, self._lengths(frame, joined, surface))

    def _collect(self, frame: Frame, joined: Topology) -> None:
        """Take a frame for the rest lengths. Raises FrameError where there are too few so far."""
        collected, model = self._calibration, self._config.model
        if collected.running:
            collected.add(frame)
        else:
            filled, _ = complete(model, frame.positions, frame.visible, joined)
            collected.begin(frame, filled)
        if not collected.complete:
            raise FrameError(f'calibrating: {collected.elapsed:.2f} of {collected.duration:g} s')

    def _remembered(
        self, frame: Frame, joined: Topology, spread: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Surface and spread [m] with hidden nodes as they were carried along since last seen.

        That is while their own motion cannot have taken them farther than filling them in errs.
        """
        gone = self._config.filter.initial_velocity * self._calibration.unseen
        there = gone < spread
        positions = np.where(there[:, None], self._calibration.last, frame.positions)
        surface, _ = complete(self._config.model, positions, frame.visible | there, joined)
        return surface, np.where(there, gone, spread)

    def _lengths(self, frame: Frame, joined: Topology, surface: FloatArray) -> FloatArray:
        """Rest lengths [m], shape (springs,), calibrated or measured in this frame."""
        known = self._rest_length
        if known is None:
            known = median_lengths(joined.pairs, frame.positions[None], frame.visible[None])
        if self._config.model.topology == 'grid':  # hidden nodes were filled in by its shape
            return np.where(np.isnan(known), lengths_of(joined.pairs, surface), known)
        return filled_in(known, joined, surface)

    def _require(self, frame: Frame) -> None:
        if lack := self._lack(frame):
            raise FrameError(lack)

    def _lack(self, frame: Frame) -> str:
        """Return what a frame lacks to start from it, or nothing."""
        seen, hidden = int(frame.visible.sum()), np.flatnonzero(~frame.visible)
        driven = np.intersect1d(hidden, self._config.anchors.nodes)
        count = f'{seen} of {self._config.model.name} seen'
        if len(driven):
            return f'{count}, waiting for the driven {self._named(driven.tolist())}'
        if self._config.model.topology == 'delaunay' and self._topology is None and len(hidden):
            return f'{count}, waiting for {self._named(hidden.tolist())}'
        fewest = min(FEWEST_TO_START, len(frame.visible))
        return f'{count}, waiting for {fewest}' if seen < fewest else ''

    def _named(self, nodes: list[int]) -> str:
        names = [self._config.labels[n] if self._config.labels else str(n) for n in nodes]
        more = [f'{len(names) - MOST_NAMED} more'] if len(names) > MOST_NAMED else []
        return ('nodes ' if len(names) > 1 else 'node ') + ', '.join(names[:MOST_NAMED] + more)


def _built(
    config: Config,
    surface: FloatArray,
    spread: FloatArray,
    joined: Topology,
    lengths: FloatArray,
) -> Start:
    """Model, filter and belief at rest at a surface [m], shape (nodes, 3), of known spread."""
    layout = lay_out(config, joined, surface)
    mesh = build_mass_spring(config, surface, layout, lengths)
    model = disturbed(config, mesh, layout, surface)
    noise = process_noise(config, mesh, model)
    nodes = DrivenNodes(config, layout.driven, surface, layout.drive)
    chosen = build_filter(config, mesh)
    prior = first_belief(config, mesh, model, *on_mesh(layout, surface, spread))
    held = nodes.extrapolate(0.0)
    nearest = config.model.refine * nearest_of(mesh)[layout.markers]
    now = Start(mesh, model, noise, chosen, nodes, prior, joined, layout, nearest)
    belief = chosen.start(prior, model, now.input(held[0], held[1]), noise)
    return replace(now, belief=belief)


def nearest_of(mesh: MassSpring) -> FloatArray:
    """Length [m] of the shortest spring of each node, shape (nodes,); infinite without any."""
    nearest = np.full(mesh.nodes, np.inf)
    np.minimum.at(nearest, mesh.springs.pairs, mesh.springs.rest_length[:, None])
    return nearest
