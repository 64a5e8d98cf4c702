"""What a tracker asks of a kind of surface: how it starts, and what a frame does to it."""

from __future__ import annotations

from typing import Protocol, TypeVar

from cloth_predict.tracking.settling import Rest
from cloth_predict.tracking.track import Frame, Step
from cloth_predict.types import Belief, FloatArray, IntArray, Surface


class Followed(Protocol):
    """A surface that is followed, as it is after a frame; never changed once made."""

    @property
    def stamp(self) -> int:
        """Time [ns] of the frame."""

    @property
    def belief(self) -> Belief:
        """What the filter believes of the state."""

    @property
    def triangles(self) -> IntArray:
        """Triangles of nodes, shape (t, 3); none of a chain."""


T = TypeVar('T', bound=Followed)


class Follower(Protocol[T]):
    """A kind of surface. What it remembers is about starts; a surface's own state is its track."""

    @property
    def reason(self) -> str:
        """What a start still lacks, in a line."""

    def start(self, frame: Frame) -> tuple[T, Step] | None:
        """Start at a frame, or None where it takes more."""

    def follow(self, track: T, frame: Frame) -> tuple[T, Step]:
        """Move on to a later frame and take it. Raises FloatingPointError where that fails."""

    def recover(self, before: T, after: T, frame: Frame) -> tuple[T, Step] | None:
        """Find the surface anew where the markers of a frame, taken in between, are elsewhere.

        None where they are not, or where it is not found among them.
        """

    def estimate(self, track: T) -> Surface:
        """Return the surface at the frame of the track."""

    def edges(self, track: T) -> IntArray:
        """Return the neighbours among the nodes, shape (edges, 2)."""

    def loads(self, track: T) -> FloatArray | None:
        """Return the unknown force [N] on the part of each node, (nodes, 3), as is believed.

        None where the state has none.
        """

    def predict(self, track: T, horizon: float) -> tuple[Surface, float]:
        """Return the surface `horizon` [s] ahead, and its sigma [m]. Raises FrameError."""

    def rest(self, track: T) -> Rest:
        """Return when and in which shape the motion ends. Raises FrameError."""
