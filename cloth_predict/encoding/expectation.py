"""What comes next in a recording, as the encoder and the decoder both expect it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from cloth_predict.config import Config
from cloth_predict.config.ruler_video import RulerVideoConfig
from cloth_predict.encoding.bar import BarExpectation
from cloth_predict.errors import FrameError
from cloth_predict.evaluation.cases import split
from cloth_predict.tracker import NANOSECONDS, Step, Tracker
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence, Surface


class Expectation(Protocol):
    """Expects the next frame of markers from the rebuilt ones before it."""

    @property
    def nodes(self) -> tuple[str, ...]:
        """Labels of the nodes that are followed, in order."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the nodes."""

    def at(self, stamp: int) -> FloatArray:
        """Multiples of the step that are expected at a stamp [ns], shape (markers, 3)."""

    def take(self, stamp: int, multiples: IntArray, visible: BoolArray) -> Step:
        """Take the rebuilt frame: multiples of the step, (markers, 3), where visible, (markers,).

        Returns what the tracker made of it.
        """

    def estimate(self) -> Surface | None:
        """Return what the filter makes of the last frame; None where it follows nothing."""


def expecting(
    config: Config | RulerVideoConfig,
    labels: tuple[str, ...],
    frame_id: str,
    step: float,
    source: str,
) -> Expectation:
    """Return what expects markers with these labels, of what the configuration describes.

    step [m], of which rebuilt coordinates are multiples. Raises FormatError of `source`.
    """
    if isinstance(config, RulerVideoConfig):
        return BarExpectation(config.ruler, step)
    return SurfaceExpectation(config, labels, frame_id, step, source)


class SurfaceExpectation:
    """Expects the markers of the next frame, as the model predicts them from the rebuilt ones.

    What is expected is a multiple of the step, as a rebuilt coordinate is, but no whole one. A
    marker that is no node of the surface, and a node while there is no prediction, goes on as it
    moved between the last two frames.
    """

    def __init__(
        self, config: Config, labels: tuple[str, ...], frame_id: str, step: float, source: str
    ) -> None:
        """Prepare for markers with these labels; step [m]. Raises FormatError of `source`."""
        nothing = np.zeros((0, len(labels), 3))
        of_file = MarkerSequence(
            np.zeros(0, np.int64), labels, nothing, nothing[..., 0].astype(bool), frame_id
        )
        nodes, strangers = split(of_file, config, source)
        self.nodes, self.shape = nodes.labels, config.model.shape
        self._column = np.array([_place(labels, label) for label in nodes.labels])
        self._strangers = np.array([_place(labels, label) for label in strangers.labels], int)
        self._tracker, self._step = Tracker(config), step
        self._stamp = 0
        self._last = self._before = np.zeros((len(labels), 3), np.int64)
        self._known = self._moving = np.zeros(len(labels), bool)

    def at(self, stamp: int) -> FloatArray:
        """Multiples of the step that are expected at a stamp [ns], shape (markers, 3)."""
        on = np.where(self._moving[:, None], self._last - self._before, 0)
        expected = (self._last + on).astype(float)
        dt = (stamp - self._stamp) / NANOSECONDS
        if self._tracker.started and 0 < dt <= self._tracker.config.filter.max_gap:
            try:
                predicted = self._tracker.predict(dt).position / self._step
            except FrameError:
                return expected
            of_nodes = self._column >= 0
            expected[self._column[of_nodes]] = predicted[: len(of_nodes)][of_nodes]
        return expected

    def take(self, stamp: int, multiples: IntArray, visible: BoolArray) -> Step:
        """Take the rebuilt frame: multiples of the step, (markers, 3), where visible, (markers,).

        Returns what the tracker made of it, of which it takes no node where it can make nothing.
        """
        held = np.where(visible[:, None], multiples, self._last)
        self._moving = visible & self._known
        self._before, self._last, self._known = self._last, held, visible
        positions = np.where(visible[:, None], multiples * self._step, np.nan)
        there = (self._column >= 0) & visible[self._column]
        nodes = np.where(there[:, None], positions[self._column], np.nan)
        points = positions[self._strangers[visible[self._strangers]]]
        try:
            step = self._tracker.step(stamp, nodes, there, points)
        except FrameError:
            return Step('unusable', np.full_like(nodes, np.nan), np.zeros_like(there))
        if step.outcome not in ('late', 'duplicate', 'rewound'):
            self._stamp = stamp
        return step

    def estimate(self) -> Surface | None:
        """Return what the filter makes of the last frame; None where it follows no surface."""
        return self._tracker.estimate() if self._tracker.started else None


def _place(labels: tuple[str, ...], label: str) -> int:
    """Column of a label; -1 where the recording has no such marker."""
    return labels.index(label) if label in labels else -1
