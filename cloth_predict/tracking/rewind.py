"""Late frames: a short memory of frames and of the tracks after them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic

from cloth_predict.tracking.follower import T
from cloth_predict.tracking.motion import NANOSECONDS
from cloth_predict.tracking.track import Frame, Step


@dataclass(frozen=True)
class Entry(Generic[T]):
    """A frame, the track after it, and what became of it."""

    frame: Frame
    track: T
    step: Step


class Memory(Generic[T]):
    """The frames of the last `reach` [s] in the order of their stamps, and the one before them."""

    def __init__(self, reach: float, first: Entry[T]) -> None:
        self._reach = round(reach * NANOSECONDS)
        self._entries = [first]

    @property
    def latest(self) -> Entry[T]:
        """The latest frame."""
        return self._entries[-1]

    def add(self, entry: Entry[T]) -> None:
        """Take a frame that is later than all others, and forget what is out of reach."""
        self._entries.append(entry)
        horizon = entry.frame.stamp - self._reach
        while len(self._entries) > 1 and self._entries[1].frame.stamp <= horizon:
            self._entries.pop(0)

    def place(self, stamp: int) -> int | None:
        """Number of frames after which a late stamp [ns] comes; None where out of reach."""
        stamps = [entry.frame.stamp for entry in self._entries]
        if stamp < stamps[-1] - self._reach or stamp < stamps[0]:
            return None
        return sum(other < stamp for other in stamps)

    def holds(self, stamp: int) -> bool:
        """Whether there is a frame with this stamp [ns]."""
        return any(entry.frame.stamp == stamp for entry in self._entries)

    def insert(
        self, place: int, frame: Frame, follow: Callable[[T, Frame], tuple[T, Step]]
    ) -> tuple[list[Entry[T]], list[Entry[T]]]:
        """Put a frame after `place` others and take those after it again.

        Returns what came after the place before and now. Nothing changes where `follow` raises.
        """
        track, before, after = self._entries[place - 1].track, self._entries[place:], []
        for later in (frame, *(entry.frame for entry in before)):
            track, step = follow(track, later)
            after.append(Entry(later, track, step))
        self._entries[place:] = after
        return before, after
