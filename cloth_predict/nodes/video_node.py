"""Publishes the frames of a video as a camera would."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from sensor_msgs.msg import Image

from cloth_predict.config.ruler_video import build_ruler_video
from cloth_predict.errors import ConfigError, FormatError
from cloth_predict.nodes._diagnostics import STEADY, Diagnostics
from cloth_predict.nodes._images import QOS, TOPIC, image
from cloth_predict.nodes._ros import ParameterNode, run
from cloth_predict.video.files import Frame, frames

POLL = 0.005
"""Seconds between looks for subscribers, and at what is due."""
LINGER = 1.0
"""Seconds after the last frame before the node ends, so that it still arrives."""


class VideoNode(ParameterNode):
    """Publishes each frame when it is due, once somebody listens; stamps are those of the file."""

    def __init__(self, **options: object) -> None:
        super().__init__('video_node', **options)
        self.finished = False
        self._publisher = self.create_publisher(Image, TOPIC, QOS)
        self._diagnostics = Diagnostics(self, lambda: {'next_frame': self._number})
        self._origin: float | None = None
        self._ends_at = 0.0
        self.create_timer(POLL, self._on_timer, clock=STEADY)

    def configure(self, values: dict[str, Any]) -> None:
        """Build the configuration, and open the video."""
        self.config = build_ruler_video(values, self.get_name())
        video = self.config.video
        if not video.path:
            raise ConfigError(f'{self.get_name()}: video.path: no video is given')
        self._frames = frames(Path(video.path), video.fps)
        first = next(self._frames)  # a file that is no video ends the node here
        self._next: Frame | None = first
        self._first, self._number = first.stamp, first.number

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._next is None:
            self.finished = now >= self._ends_at
            return
        if self._origin is None:
            if self._publisher.get_subscription_count() < self.config.video.subscribers:
                return
            self._origin = now
        due = self._origin + 1e-9 * (self._next.stamp - self._first) / self.config.video.speed
        if now < due:
            return
        message = image(self._next.stamp, self.config.frame, self._next.picture)
        self._publisher.publish(message)
        self._number = self._next.number
        self._diagnostics.frame(time.monotonic() - due)
        self._advance(now)

    def _advance(self, now: float) -> None:
        try:
            self._next = next(self._frames, None)
        except FormatError as error:  # what came before it was good
            self._diagnostics.drop('bad', str(error))
            self._next = None
        if self._next is None:
            self._ends_at = now + LINGER


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(VideoNode, args)


if __name__ == '__main__':
    sys.exit(main())
