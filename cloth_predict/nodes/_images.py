"""Pictures as messages."""

from __future__ import annotations

import array

import numpy as np
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cloth_predict.errors import FrameError
from cloth_predict.nodes._ros import to_time
from cloth_predict.video.files import Picture

TOPIC = 'video/image'
QOS = QoSProfile(depth=20, reliability=QoSReliabilityPolicy.RELIABLE)
"""A picture is sent in hundreds of parts, of which best effort would lose some."""
CHANNELS = {'bgr8': (0, 1, 2), 'rgb8': (2, 1, 0), 'mono8': (0, 0, 0)}
"""Where each encoding has blue, green and red."""


def image(stamp: int, frame_id: str, picture: Picture) -> Image:
    """Build a bgr8 image."""
    height, width, depth = picture.shape
    data = array.array('B')  # taken as it is; a numpy array would be copied number by number
    data.frombytes(np.ascontiguousarray(picture).data.cast('B'))
    return Image(
        header=Header(stamp=to_time(stamp), frame_id=frame_id),
        height=height,
        width=width,
        encoding='bgr8',
        is_bigendian=0,
        step=depth * width,
        data=data,
    )


def picture_of(message: Image) -> Picture:
    """Read an image of bgr8, rgb8 or mono8. Raises FrameError."""
    if message.encoding not in CHANNELS:
        raise FrameError(f'encoding {message.encoding!r}, expected {", ".join(CHANNELS)}')
    depth = 1 if message.encoding == 'mono8' else 3
    data = np.frombuffer(message.data, np.uint8)
    height, width, step = message.height, message.width, message.step
    if step < depth * width or data.size != height * step or not data.size:
        raise FrameError(f'an image of {data.size} bytes, not of {height} x {width} pixels')
    rows = data.reshape(height, step)[:, : depth * width]
    pixels = rows.reshape(height, width, depth)
    return np.ascontiguousarray(pixels[..., list(CHANNELS[message.encoding])])
