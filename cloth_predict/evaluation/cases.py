"""A recording as it is predicted and judged: what the methods are given, and what is true."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

import numpy as np

from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.evaluation.bodies import by_surface
from cloth_predict.formats.bag import Recording
from cloth_predict.markers.association import markers_of_nodes
from cloth_predict.tracker import NANOSECONDS, NO_POINTS, Tracker
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence

Points = tuple[FloatArray, ...]
"""Markers without a label [m], shape (m, 3), of each frame."""


@dataclass(frozen=True)
class Reference:
    """Where the nodes really are; the stamps increase strictly.

    noise [m]: standard deviation of a coordinate; zero of the truth. surface: whether these are
    points of the surface that are no nodes, each to be compared with what is nearest to it.
    """

    markers: MarkerSequence
    noise: float
    surface: bool = False

    @property
    def true(self) -> bool:
        """Whether this is the truth, and no measurement."""
        return self.noise == 0


@dataclass(frozen=True)
class Case:
    """A recording as it is evaluated; its frames are in the order in which they came.

    markers: those of the nodes; labelled, shape (frames, nodes): which of them have their label
    for a method that associates (the others need it, and have it); points: what such a method is
    given without a label.
    """

    name: str
    markers: MarkerSequence
    labelled: BoolArray
    points: Points
    reference: Reference

    @property
    def ahead(self) -> BoolArray:
        """Which frames are later than all before them, shape (frames,)."""
        return ahead(self.markers.stamps)

    def frame(self, k: int, associates: bool) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Positions [m] of the nodes, which are visible, and points, as a method is given them."""
        positions, visible = self.markers.positions[k], self.markers.visible[k]
        if not associates:
            return positions, visible, NO_POINTS
        visible = visible & self.labelled[k]
        return np.where(visible[:, None], positions, nan), visible, self.points[k]


def split(
    sequence: MarkerSequence, config: Config, source: str
) -> tuple[MarkerSequence, MarkerSequence]:
    """Return the markers in node order, and those that the mocap system did not identify.

    Where it identified none, and the parameter `labels` names none, every node is hidden. Raises
    FormatError as `markers_of_nodes`.
    """
    chosen = sequence
    if not config.labels and sequence.unlabelled.any() and sequence.unlabelled.all():
        nodes = config.model.count
        hidden = np.full((len(sequence), nodes, 3), nan)
        names = tuple(f'node{i}' for i in range(nodes))
        visible = np.zeros(hidden.shape[:2], bool)
        chosen = MarkerSequence(sequence.stamps, names, hidden, visible, sequence.frame_id)
    markers = markers_of_nodes(chosen, config, source)
    other = [label not in markers.labels for label in sequence.labels]
    return markers, sequence.select(np.flatnonzero(sequence.unlabelled & other))


def points_of(markers: MarkerSequence) -> Points:
    """Return the visible markers of each frame, without their labels."""
    both = zip(markers.positions, markers.visible, strict=True)
    return tuple(positions[visible] for positions, visible in both)


def case_of(recording: Recording, config: Config, source: str) -> Case:
    """Return a recording as it is evaluated, compared with the truth or else with itself.

    Where the mocap system identified no marker, the configured tracker says which one is which:
    its association makes the labels that other methods need, and the measurement to compare with.
    """
    markers, strangers = split(recording.markers, config, source)
    if by_surface(config):
        return _body_case(recording, markers, strangers, config, source)
    truth = _truth(recording, markers, source) if recording.truth else None
    keep = _in_reach(markers.stamps, config)
    points = points_of(frames_of(strangers, keep))
    if markers.visible.any() or not any(map(len, points)):
        return replace(labelled_case(markers, config, source, truth), points=points)
    found = relabelled(frames_of(markers, keep), points, config, source)
    case = labelled_case(found, config, source, truth)
    return replace(case, labelled=~case.labelled, points=points)


def _body_case(
    recording: Recording,
    markers: MarkerSequence,
    strangers: MarkerSequence,
    config: Config,
    source: str,
) -> Case:
    """Return a recording of a body, of which every marker is a point of its surface.

    What is true are all nodes that were simulated, or else the markers themselves. Markers without
    a label come after the nodes, where none has one.
    """
    named = markers.visible.any()
    if recording.truth is not None:
        seen, noise = recording.truth.nodes(), 0.0
    else:
        shown = markers.select(np.flatnonzero(markers.visible.any(axis=0)))
        seen, noise = shown.beside(strangers), config.filter.measurement_noise
    every = markers if named else markers.beside(strangers)
    case = labelled_case(every, config, source)
    points = points_of(frames_of(strangers, _in_reach(markers.stamps, config)))
    labelled = case.labelled & bool(named)
    reference = Reference(in_order(seen), noise, surface=True)
    return replace(case, labelled=labelled, points=points, reference=reference)


def labelled_case(
    markers: MarkerSequence, config: Config, source: str, truth: MarkerSequence | None = None
) -> Case:
    """Return markers in node order as they are evaluated.

    Frames that are later than any method could put in their place are left out.
    """
    markers = frames_of(markers, _in_reach(markers.stamps, config))
    reference = (
        Reference(in_order(markers), config.filter.measurement_noise)
        if truth is None
        else Reference(in_order(truth), 0.0)
    )
    none = (NO_POINTS,) * len(markers)
    return Case(source, markers, np.ones(markers.visible.shape, bool), none, reference)


def relabelled(
    markers: MarkerSequence, points: Points, config: Config, source: str
) -> MarkerSequence:
    """Return the markers as the configured tracker associates them with the nodes."""
    tracker = Tracker(config)
    positions, visible = markers.positions.copy(), markers.visible.copy()
    for k, stamp in enumerate(markers.stamps.tolist()):
        step = tracker.step(stamp, markers.positions[k], markers.visible[k], points[k])
        positions[k], visible[k] = step.positions, step.visible
    if not visible.any():
        raise FormatError(
            f'{source}: no marker has a label, and the tracker finds no surface in the points '
            f'(at most {max(map(len, points))} in a frame for {len(markers.labels)} nodes)'
        )
    positions[~visible] = nan
    return replace(markers, positions=positions, visible=visible)


def _truth(recording: Recording, markers: MarkerSequence, source: str) -> MarkerSequence:
    """Return the true motion of the nodes."""
    assert recording.truth is not None
    labels = recording.markers.labels
    if set(markers.labels) <= set(labels):
        truth = recording.truth.markers(recording.markers)
        return truth.select([labels.index(label) for label in markers.labels])
    try:
        return recording.truth.markers(markers)  # without labels, node i is marker i
    except KeyError as error:
        raise FormatError(f'{source}: the truth has no marker {error}') from None


def ahead(stamps: IntArray) -> BoolArray:
    """Which stamps [ns] are later than all before them, shape (frames,)."""
    latest = np.maximum.accumulate(stamps)
    return np.append(True, stamps[1:] > latest[:-1])


def in_order(markers: MarkerSequence) -> MarkerSequence:
    """Sort the frames by their stamps; of those with the same stamp the first is kept."""
    _, first = np.unique(markers.stamps, return_index=True)
    return frames_of(markers, first)


def frames_of(markers: MarkerSequence, frames: IntArray | BoolArray) -> MarkerSequence:
    """Return these frames only."""
    frames = np.arange(len(markers))[frames]
    if np.array_equal(frames, np.arange(len(markers))):
        return markers
    return replace(
        markers,
        stamps=markers.stamps[frames],
        positions=markers.positions[frames],
        visible=markers.visible[frames],
    )


def _in_reach(stamps: IntArray, config: Config) -> BoolArray:
    """Which frames are no later than any method could put in their place, shape (frames,)."""
    farthest = config.filter.max_backstep * NANOSECONDS
    return np.asarray(stamps >= np.maximum.accumulate(stamps) - farthest)
