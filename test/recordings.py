"""The shipped recording, or its beginning, where that says as much in less time."""

from functools import cache
from pathlib import Path

from cloth_predict.formats.bag import Recording, Truth, read_recording
from cloth_predict.types import MarkerSequence

BAG = Path(__file__).parents[1] / 'bags' / 'towel_fan'


@cache
def shipped() -> Recording:
    """All 11 s of a towel in the wind of a fan, at 100 Hz."""
    return read_recording(BAG)


def beginning(frames: int) -> Recording:
    """Return the first frames of the shipped recording, with their truth."""
    markers, truth, part = shipped().markers, shipped().truth, slice(frames)
    assert truth is not None
    return Recording(
        MarkerSequence(
            markers.stamps[part],
            markers.labels,
            markers.positions[part],
            markers.visible[part],
            markers.frame_id,
        ),
        Truth(truth.stamps[part], truth.surface[part], truth.ids),
    )
