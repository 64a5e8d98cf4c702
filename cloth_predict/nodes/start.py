"""Starts a node; imports nothing heavy, so that a signal is obeyed from the first moment on."""

from __future__ import annotations

import signal
import sys
from importlib import import_module

from cloth_predict.errors import ClothPredictError


def mocap_replay_node() -> int:
    """Run the replay node."""
    return _start('mocap_replay_node')


def ekf_node() -> int:
    """Run the EKF node."""
    return _start('ekf_node')


def projector_node() -> int:
    """Run the projector node."""
    return _start('projector_node')


def rest_node() -> int:
    """Run the rest node."""
    return _start('rest_node')


def video_node() -> int:
    """Run the video node."""
    return _start('video_node')


def ruler_node() -> int:
    """Run the ruler node."""
    return _start('ruler_node')


def _start(name: str) -> int:
    # Until rclpy listens for it, Ctrl-C ends the process at once, not with a traceback of the
    # half second in which the node is imported.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        node = import_module(f'cloth_predict.nodes.{name}')
    except ClothPredictError as error:  # such as OpenCV, which only some nodes need
        print(f'[FATAL] {error}', file=sys.stderr)
        return 1
    return int(node.main())
