"""Warp maps from a process of their own: a map takes longer than a frame of vertices may wait."""

from __future__ import annotations

import array
import multiprocessing
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cloth_predict.nodes._ros import to_time
from cloth_predict.performance import one_core
from cloth_predict.projection import field_maps
from cloth_predict.projection.frames import Shown
from cloth_predict.projection.warp import Warper

TOPIC = 'projector/warp_map'
QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.RELIABLE)
"""A map is sent in hundreds of parts, of which best effort would lose some."""
LEAVE = 2.0
"""Seconds that the process may take to end."""


class MapWriter:
    """Has a frame's map drawn and published while the last one's is done, and skips it if not.

    published, skipped: frames so far.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        """Start the process, which is ready about a second later."""
        spawn = multiprocessing.get_context('spawn')
        self._pipe, theirs = spawn.Pipe()
        self._frame_id, self._busy, self._ended = frame_id, True, False
        self._warper: Warper | None = None
        self.published, self.skipped = 0, 0
        topic, domain = node.resolve_topic_name(TOPIC), node.context.get_domain_id()
        self._process = spawn.Process(target=_serve, args=(theirs, topic, domain), daemon=True)
        self._process.start()
        theirs.close()

    def offer(self, shown: Shown, warper: Warper) -> None:
        """Send a frame that is shown, unless the process is still at work; never waits."""
        try:
            if self._busy and self._pipe.poll():
                self._pipe.recv()
                self._busy = False
            if self._busy:
                self.skipped += 1
                return
            if warper is not self._warper:
                self._pipe.send(warper)
                self._warper = warper
            keys = shown.warped.keys if shown.warped else ()
            self._pipe.send((shown.start, self._frame_id, keys))
            self._busy = True
            self.published += 1
        except (OSError, EOFError):
            self._ended = True

    def findings(self) -> Iterator[tuple[str, str]]:
        """Whether it still runs."""
        if self._ended:
            yield 'WARN', f'the process that publishes {TOPIC} has ended'

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(LEAVE)
        if self._process.is_alive():
            self._process.kill()


def _serve(pipe: Connection, topic: str, domain: int) -> None:
    """Publish the maps of the frames that come through the pipe until its other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the node, which closes the pipe
    context = Context()
    rclpy.init(
        args=[], context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
    )
    node = Node('projector_warp_map', context=context, use_global_arguments=False)
    publisher = node.create_publisher(Image, topic, QOS)
    warper: Warper | None = None
    try:
        with one_core():
            pipe.send('ready')
            while True:
                received = pipe.recv()
                if isinstance(received, Warper):
                    warper = received
                    continue
                assert warper is not None
                start, frame_id, keys = received
                for begin, picture in field_maps.field_maps(warper, keys):
                    publisher.publish(image(start + round(1e9 * begin), frame_id, picture))
                pipe.send('done')
    except (EOFError, OSError):
        pass
    finally:
        node.destroy_node()
        context.try_shutdown()


def image(stamp: int, frame_id: str, picture: field_maps.Image) -> Image:
    """Build a 32FC2 image of a map, shape (height, width, 2)."""
    height, width, _ = picture.shape
    data = array.array('B')  # taken as it is; a numpy array would be copied number by number
    data.frombytes(picture.data.cast('B'))
    return Image(
        header=Header(stamp=to_time(stamp), frame_id=frame_id),
        height=height,
        width=width,
        encoding='32FC2',
        is_bigendian=0,
        step=8 * width,
        data=data,
    )
