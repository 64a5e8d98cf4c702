"""A sliding bar as messages: poses with covariance, and what RViz and Foxglove draw."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from cloth_predict import overlay
from cloth_predict.nodes._markers import arrows, lines, words
from cloth_predict.nodes._ros import to_time
from cloth_predict.types import FloatArray
from cloth_predict.video.following import Seen
from cloth_predict.video.overlay import dashed_rest, friction_arrows, outline, told

PLANAR = np.array([0, 1, 5])
"""Where x, y and the angle about z are among the six of a pose's covariance."""
LINE, TEXT = 0.01, 0.08
"""Width of lines and of arrows, and height of letters [m]."""


def pose(
    stamp: int, frame_id: str, mean: FloatArray, cov: FloatArray
) -> PoseWithCovarianceStamped:
    """Build a pose on the table: mean x, y, angle [m, rad], shape (3,), and cov, (3, 3)."""
    message = PoseWithCovarianceStamped(header=Header(stamp=to_time(stamp), frame_id=frame_id))
    inner = message.pose.pose
    inner.position.x, inner.position.y = float(mean[0]), float(mean[1])
    inner.orientation.z = float(np.sin(0.5 * mean[2]))
    inner.orientation.w = float(np.cos(0.5 * mean[2]))
    full = np.zeros((6, 6))
    full[np.ix_(PLANAR, PLANAR)] = cov
    message.pose.covariance = full.ravel()
    return message


def markers(seen: Seen, frame_id: str) -> MarkerArray:
    """Estimate solid, place of rest dashed once it is known, friction as arrows, and values."""
    assert seen.state is not None
    assert seen.ruler is not None
    header = Header(stamp=to_time(seen.frame.stamp), frame_id=frame_id)
    here = overlay.polygon(outline(seen.state[:3], float(seen.ruler.L)))
    place = np.append(seen.state[:2], TEXT)
    return MarkerArray(
        markers=[
            lines(header, 'estimate', overlay.ESTIMATE, here, LINE),
            lines(header, 'stop', overlay.PREDICTION, dashed_rest(seen), LINE),
            *arrows(header, 'friction', overlay.FORCE, friction_arrows(seen), LINE),
            words(header, 'values', overlay.ESTIMATE, told(seen), place, TEXT),
        ]
    )
