"""A sliding bar as messages: poses with covariance, and what RViz and Foxglove draw."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from cloth_predict.nodes._ros import to_time
from cloth_predict.types import FloatArray
from cloth_predict.video.following import Seen
from cloth_predict.video.overlay import friction_arrows, outline, told

PLANAR = np.array([0, 1, 5])
"""Where x, y and the angle about z are among the six of a pose's covariance."""
RED, BLUE, YELLOW = (0.9, 0.1, 0.1), (0.1, 0.3, 1.0), (1.0, 0.85, 0.0)
LINE, SHAFT, HEAD, TEXT = 0.01, 0.01, 0.03, 0.08
"""Sizes [m]: width of lines, of arrows and their heads, height of letters."""
DASHES = 12
"""Dashes, and gaps, of each edge."""


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
    length, rest = float(seen.ruler.L), seen.certain_rest
    here = outline(seen.state[:3], length)
    found = [_marker(header, 'estimate', Marker.LINE_STRIP, RED, LINE, [*here, here[0]])]
    dashes = _dashes(outline(rest.stop.mean, length)) if rest else []
    found.append(_marker(header, 'stop', Marker.LINE_LIST, BLUE, LINE, dashes))
    for number, arrow in enumerate(friction_arrows(seen)):
        found.append(_marker(header, 'friction', Marker.ARROW, YELLOW, SHAFT, arrow, number))
    text = _marker(header, 'values', Marker.TEXT_VIEW_FACING, RED, LINE, [])
    text.text, text.scale.z = '\n'.join(told(seen)), TEXT
    text.pose.position.x, text.pose.position.y = map(float, seen.state[:2])
    text.pose.position.z = TEXT
    return MarkerArray(markers=[*found, text])


def _marker(
    header: Header,
    name: str,
    kind: int,
    colour: tuple[float, float, float],
    width: float,
    points: Iterable[FloatArray],
    number: int = 0,
) -> Marker:
    red, green, blue = colour
    corners = [Point(x=float(x), y=float(y)) for x, y in points]
    empty = kind != Marker.TEXT_VIEW_FACING and not corners
    marker = Marker(
        header=header,
        ns=name,
        id=number,
        type=kind,
        action=Marker.DELETE if empty else Marker.ADD,
        color=ColorRGBA(r=red, g=green, b=blue, a=1.0),
        points=corners,
    )
    marker.pose.orientation.w = 1.0
    marker.scale.x = width
    if kind == Marker.ARROW:
        marker.scale.y = HEAD
    return marker


def _dashes(corners: FloatArray) -> list[FloatArray]:
    """Ends of the dashes along the edges of a polygon, shape (2,) each."""
    share = np.linspace(0.0, 1.0, 2 * DASHES + 1)[: 2 * DASHES, None]
    ends = np.roll(corners, -1, axis=0)
    return [p for a, b in zip(corners, ends, strict=True) for p in a + share * (b - a)]
