"""Records the graph's topics: the bytes as they come over the wire, straight into a bag."""

from __future__ import annotations

import struct
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker

from cloth_predict.formats.bag import BagWriter

TOPICS: dict[str, type] = {
    '/clock': Clock,
    'markers': PointCloud2,
    'cloth/estimate': PointCloud2,
    'cloth/prediction': PointCloud2,
    'cloth/mesh': Marker,
    'projector/vertices': PointCloud2,
    'projector/scanlines': PointCloud2,
    'diagnostics': DiagnosticArray,
}
"""Every topic of the graph; each message begins with its stamp."""

DEEP = QoSProfile(depth=500, reliability=QoSReliabilityPolicy.BEST_EFFORT)
"""A recorder wants every message: the queue holds some seconds of them."""


class Recorder(Node):
    """Writes every message to a bag and keeps its stamp and its time of arrival."""

    def __init__(self, bag: BagWriter, **options: Any) -> None:
        super().__init__('recorder', **options)
        self.arrivals: dict[str, list[tuple[int, float]]] = defaultdict(list)
        """Stamp [ns] and arrival [s] of each message by topic."""
        self._bag = bag
        for topic, kind in TOPICS.items():
            self.create_subscription(kind, topic, self._callback(topic, kind), DEEP, raw=True)

    def _callback(self, topic: str, kind: type) -> Callable[[bytes], None]:
        name = self.resolve_topic_name(topic)
        msgtype = '{}/msg/{}'.format(kind.__module__.split('.')[0], kind.__name__)

        def on_message(data: bytes) -> None:
            # a little-endian CDR header of 4 bytes, then the stamp
            sec, nanosec = struct.unpack_from('<iI', data, 4)
            stamp = sec * 10**9 + nanosec
            self.arrivals[topic].append((stamp, time.monotonic()))
            self._bag.raw(name, msgtype, stamp, data)

        return on_message
