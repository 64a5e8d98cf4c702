"""The augmented view of a surface as messages."""

from __future__ import annotations

import numpy as np
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from cloth_predict import overlay
from cloth_predict.config import Config
from cloth_predict.nodes._markers import arrows, lines, words
from cloth_predict.nodes._ros import to_time
from cloth_predict.overlay import Shown

LINE, SHAFT, TEXT = 1 / 300, 1 / 150, 1 / 25
"""Widths of lines and of arrows, and height of letters, by the extent of the surface."""


def surface_markers(shown: Shown, config: Config) -> MarkerArray:
    """Estimate solid, prediction dashed at its own time, unknown forces as arrows, and words."""
    position, up = shown.estimate.position, overlay.upwards(config)
    reach = float(np.linalg.norm(np.ptp(position, axis=0)))
    now = Header(stamp=to_time(shown.estimate.stamp), frame_id=config.frame)
    then = shown.estimate if shown.prediction is None else shown.prediction
    ahead = Header(stamp=to_time(then.stamp), frame_id=config.frame)
    above = (position @ up).max() + 2.0 * TEXT * reach - position.mean(axis=0) @ up
    place = position.mean(axis=0) + above * up
    width = LINE * reach
    return MarkerArray(
        markers=[
            lines(now, 'estimate', overlay.ESTIMATE, shown.solid, width),
            lines(ahead, 'prediction', overlay.PREDICTION, shown.dashed, width),
            *arrows(now, 'forces', overlay.FORCE, shown.arrows, SHAFT * reach),
            words(now, 'values', overlay.ESTIMATE, shown.told, place, TEXT * reach),
        ]
    )


def no_markers(stamp: int, config: Config) -> MarkerArray:
    """Take away all that was shown of a surface that is no more; stamp [ns]."""
    header = Header(stamp=to_time(stamp), frame_id=config.frame)
    return MarkerArray(markers=[Marker(header=header, action=Marker.DELETEALL)])
