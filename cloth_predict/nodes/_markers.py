"""Lines, arrows and words as RViz and Foxglove draw them; what is empty is taken away."""

from __future__ import annotations

from collections.abc import Sequence

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from cloth_predict.types import FloatArray

Colour = tuple[float, float, float]
"""Red, green, blue."""


def lines(header: Header, name: str, colour: Colour, segments: FloatArray, width: float) -> Marker:
    """Build a LINE_LIST of segments [m], shape (s, 2, 2) or (s, 2, 3); width [m]."""
    found = _marker(header, name, Marker.LINE_LIST, colour, len(segments) > 0)
    found.scale.x = width
    found.points = _points(segments)
    return found


def arrows(
    header: Header, name: str, colour: Colour, ends: FloatArray, width: float
) -> list[Marker]:
    """Build an ARROW for each tail and tip [m], shape (a, 2, 2) or (a, 2, 3).

    Those of no length are taken away.
    """
    found = []
    for number, pair in enumerate(ends):
        there = bool((pair[0] != pair[1]).any())
        arrow = _marker(header, name, Marker.ARROW, colour, there, number)
        arrow.scale.x, arrow.scale.y = width, 3.0 * width
        arrow.points = _points(pair)
        found.append(arrow)
    return found


def words(
    header: Header, name: str, colour: Colour, told: Sequence[str], at: FloatArray, height: float
) -> Marker:
    """Build lines of text at a place [m], shape (3,); height [m] of its letters."""
    found = _marker(header, name, Marker.TEXT_VIEW_FACING, colour, bool(told))
    found.text, found.scale.z = '\n'.join(told), height
    found.pose.position.x, found.pose.position.y, found.pose.position.z = at.tolist()
    return found


def _marker(
    header: Header, name: str, kind: int, colour: Colour, there: bool, number: int = 0
) -> Marker:
    red, green, blue = colour
    marker = Marker(
        header=header,
        ns=name,
        id=number,
        type=kind,
        action=Marker.ADD if there else Marker.DELETE,
        color=ColorRGBA(r=red, g=green, b=blue, a=1.0),
    )
    marker.pose.orientation.w = 1.0
    return marker


def _points(places: FloatArray) -> list[Point]:
    flat = places.reshape(-1, places.shape[-1]).tolist()
    return [Point(x=place[0], y=place[1], z=place[2] if len(place) > 2 else 0.0) for place in flat]
