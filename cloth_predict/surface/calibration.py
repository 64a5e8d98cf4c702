"""Rest lengths from the first seconds: the median over time of the distance of two nodes."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from cloth_predict.surface.assembly import aligned, lengths_of
from cloth_predict.surface.topology import Topology
from cloth_predict.types import BoolArray, FloatArray, IntArray

NEVER = np.iinfo(np.int64).min
ROUNDING = 1e-6
"""Seconds by which stamps are rounded."""


class Frame(NamedTuple):
    """Markers in node order: stamp [ns], positions [m], (nodes, 3), and visible, (nodes,)."""

    stamp: int
    positions: FloatArray
    visible: BoolArray


class Calibration:
    """Collects frames for `duration` [s] from the first on; of more, the latest."""

    def __init__(self, duration: float) -> None:
        self.duration = duration
        self.last = np.zeros((0, 3))
        """Where each node is [m], shape (nodes, 3); hidden ones carried along by the others."""
        self._seen = np.zeros(0, np.int64)
        self._frames: deque[Frame] = deque()
        self._begin = 0

    @property
    def running(self) -> bool:
        """Whether there are frames."""
        return bool(self._frames)

    def begin(self, frame: Frame, surface: FloatArray) -> None:
        """Start anew with a frame; surface [m], shape (nodes, 3): its hidden nodes filled in."""
        self._frames.clear()
        self._begin, self.last = frame.stamp, surface
        self._seen = np.full(len(surface), NEVER)
        self.add(frame)

    def add(self, frame: Frame) -> None:
        """Take a frame later than the last."""
        self._frames.append(frame)
        if frame.visible.any():
            carried = aligned(self.last, frame.positions, frame.visible)
            self.last = np.where(frame.visible[:, None], frame.positions, carried)
        self._seen = np.where(frame.visible, frame.stamp, self._seen)
        while self._frames[0].stamp < frame.stamp - self.duration * 1e9:
            self._frames.popleft()

    def since(self, stamp: int) -> float:
        """Time [s] from the last frame to a stamp [ns]."""
        return (stamp - self._frames[-1].stamp) / 1e9

    @property
    def elapsed(self) -> float:
        """Time [s] from the first frame to the last."""
        return (self._frames[-1].stamp - self._begin) / 1e9

    @property
    def complete(self) -> bool:
        """Whether the frames last long enough."""
        return self.elapsed >= self.duration - ROUNDING

    @property
    def unseen(self) -> FloatArray:
        """Time [s] for which each node has not been seen, shape (nodes,), infinite of never."""
        since = (self._frames[-1].stamp - self._seen) / 1e9
        return np.where(self._seen == NEVER, np.inf, since)

    def lengths(self, pairs: IntArray) -> FloatArray:
        """Return the median lengths [m] of pairs of nodes, NaN where unknown, shape (pairs,)."""
        _, positions, visible = zip(*self._frames, strict=True)
        return median_lengths(pairs, np.array(positions), np.array(visible))


def median_lengths(pairs: IntArray, positions: FloatArray, visible: BoolArray) -> FloatArray:
    """Median length [m] of each pair over the frames that show both ends, NaN of none, (pairs,).

    pairs, shape (pairs, 2); positions [m], shape (frames, nodes, 3); visible, (frames, nodes).
    """
    both = visible[:, pairs[:, 0]] & visible[:, pairs[:, 1]]
    lengths = np.where(both, lengths_of(pairs, positions), np.nan)
    known, found = both.any(axis=0), np.full(len(pairs), np.nan)
    found[known] = np.nanmedian(lengths[:, known], axis=0)
    return found


def filled_in(lengths: FloatArray, joined: Topology, surface: FloatArray) -> FloatArray:
    """Fill in the lengths [m] of a mesh, (springs,), that are unknown, with those usual there.

    That is the median of the family, and where that is unknown too the distance on the surface
    [m], shape (nodes, 3), of which hidden nodes were made up.
    """
    lengths, first = lengths.copy(), 0
    for pairs in joined.families.values():
        family = lengths[first : first + len(pairs)]  # a view: what follows writes to lengths
        known = family[~np.isnan(family)]
        usual = np.median(known) if known.size else lengths_of(pairs, surface)
        family[:] = np.where(np.isnan(family), usual, family)
        first += len(pairs)
    return lengths
