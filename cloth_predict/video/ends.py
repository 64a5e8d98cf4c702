"""The ends of a bar in a video, as a recording of markers."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from cloth_predict.config.ruler_video import RulerVideoConfig
from cloth_predict.encoding.bar import ENDS, ends_of
from cloth_predict.errors import FormatError
from cloth_predict.tracking.ruler_assembly import ANGLE, unwrapped
from cloth_predict.types import FloatArray, MarkerSequence
from cloth_predict.video.detector import BarDetector
from cloth_predict.video.files import frames
from cloth_predict.video.watching import Watcher


class Ends(NamedTuple):
    """Markers at the ends of a bar, faults of the video, and the bytes of its pictures."""

    markers: MarkerSequence
    faults: tuple[str, ...]
    pictures: int


def ends_in(video: Path, config: RulerVideoConfig) -> Ends:
    """Find the bar in each frame. Raises FormatError where no frame shows one.

    Which end is which goes on from frame to frame, as the bar does not make half a turn between
    two. A video that ends in a fault is told up to there.
    """
    watcher, faults = Watcher(BarDetector(config.camera)), list[str]()
    stamps, places = list[int](), list[FloatArray]()
    pictures, angle = 0, 0.0
    try:
        for frame in frames(video, config.video.fps):
            sighting = watcher.see(frame)
            faults += sighting.faults
            stamps.append(frame.stamp)
            pictures += frame.picture.nbytes
            if sighting.z is None:
                places.append(np.full((2, 3), np.nan))
                continue
            z = unwrapped(config.ruler, sighting.z, angle)
            angle = float(z[ANGLE])
            places.append(ends_of(z))
    except FormatError as error:
        if not places:
            raise
        faults.append(str(error))
    positions = np.array(places).reshape(-1, 2, 3)
    visible = np.isfinite(positions[..., 0])
    if not visible.any():
        fault = faults[0] if faults else 'no frame'
        raise FormatError(f'{video}: no bar in {len(places)} frames: {fault}')
    markers = MarkerSequence(np.array(stamps), ENDS, positions, visible, config.frame)
    return Ends(markers, tuple(faults), pictures)
