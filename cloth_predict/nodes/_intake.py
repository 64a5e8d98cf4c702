"""Frames of markers on their way into a tracker."""

from __future__ import annotations

from dataclasses import dataclass

from sensor_msgs.msg import PointCloud2

from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import decode_markers
from cloth_predict.nodes._diagnostics import Diagnostics
from cloth_predict.nodes._ros import ConfiguredNode, nanoseconds
from cloth_predict.tracker import Step, Tracker

DROPPED = {
    'late': 'its stamp is too far before the latest one, see filter.rewind',
    'duplicate': 'there is one with its stamp already',
}


@dataclass
class Intake:
    """Gives the messages that a node hears to its tracker; what is of no use is counted.

    unlabelled: markers without a label in the last frame that was used.
    """

    node: ConfiguredNode
    tracker: Tracker
    diagnostics: Diagnostics
    unlabelled: int = 0

    def take(self, message: PointCloud2) -> Step | None:
        """What became of a frame, or None where it is dropped."""
        try:
            self.node.check_frame(message.header)
            positions, visible, points = decode_markers(message, self.tracker.nodes)
            stamp = nanoseconds(message.header.stamp)
            step = self.tracker.step(stamp, positions, visible, points)
        except FrameError as error:
            self.diagnostics.drop('bad', str(error))
            return None
        if step.outcome in DROPPED:
            self.diagnostics.drop(step.outcome, DROPPED[step.outcome])
            return None
        self.unlabelled = len(points)
        return step
