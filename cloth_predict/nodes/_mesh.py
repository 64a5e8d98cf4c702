"""A surface as RViz and Foxglove draw it."""

from __future__ import annotations

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from cloth_predict.nodes._ros import to_time
from cloth_predict.types import IntArray, Surface


def mesh_marker(surface: Surface, triangles: IntArray, frame_id: str) -> Marker:
    """Build a TRIANGLE_LIST; triangles, shape (t, 3): the nodes at the corners."""
    marker = Marker(
        header=Header(stamp=to_time(surface.stamp), frame_id=frame_id),
        ns='cloth',
        type=Marker.TRIANGLE_LIST,
        action=Marker.ADD,
        color=ColorRGBA(r=0.9, g=0.3, b=0.2, a=0.8),
    )
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    corners = [Point(x=x, y=y, z=z) for x, y, z in surface.position.tolist()]
    marker.points = [corners[i] for i in triangles.ravel()]
    return marker
