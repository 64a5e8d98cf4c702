"""What the nodes share: parameters to configuration, arrays to messages, spinning."""

from __future__ import annotations

import array
import copy
import gc
import os
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from cloth_predict.config import Config, build, flatten, nest, parse_yaml
from cloth_predict.errors import ClothPredictError, FrameError
from cloth_predict.formats.pointcloud import fields_of
from cloth_predict.performance import one_core

SENSOR_QOS = QoSProfile(depth=5, reliability=QoSReliabilityPolicy.BEST_EFFORT)
"""Latest data over complete data: a late frame is of no use to a projector."""

INPUT_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.BEST_EFFORT)
"""A filter wants every frame: the queue outlasts the fraction of a second for which Fast DDS
blocks a publisher while a new subscriber is being discovered."""

LATEST_QOS = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)
"""Of what the next message makes worthless, a node that is busy hears the last one only."""

OVERRIDABLE = QoSOverridingOptions.with_default_policies()
ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')
SHUTDOWN_LIMIT = 5.0
"""Seconds that a node may take to leave, after which its process ends all the same."""


class ParameterNode(Node, ABC):
    """A node whose parameters are checked as a whole, at the start only."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)
        flat = {k: p.value for k, p in self.get_parameters_by_prefix('').items()}
        flat |= _hidden(sys.argv, self.get_name(), flat)
        known = {k: v for k, v in flat.items() if k.split('.')[0] not in ROS_PARAMETERS}
        try:
            self.configure(nest(known))
        except ClothPredictError:
            self.destroy_node()
            raise
        self.add_on_set_parameters_callback(_refuse)

    @abstractmethod
    def configure(self, values: dict[str, Any]) -> None:
        """Read the parameters, as nested mappings. Raises ConfigError."""

    def publisher(self, kind: type, topic: str) -> Any:
        """Sensor-data publisher whose quality of service can be overridden by parameters."""
        qos = copy.copy(SENSOR_QOS)  # an override writes into the profile
        return self.create_publisher(kind, topic, qos, qos_overriding_options=OVERRIDABLE)

    def subscribe(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile = INPUT_QOS,
    ) -> None:
        """Subscribe to sensor data; the quality of service can be overridden by parameters."""
        qos = copy.copy(profile)
        self.create_subscription(kind, topic, callback, qos, qos_overriding_options=OVERRIDABLE)


class ConfiguredNode(ParameterNode):
    """A node whose parameters are the project's configuration."""

    config: Config

    def configure(self, values: dict[str, Any]) -> None:
        """Build the configuration."""
        self.config = build(values, self.get_name())

    def check_frame(self, header: Header) -> None:
        """Raise FrameError where a message is not in the configured frame."""
        if header.frame_id != self.config.frame:
            raise FrameError(f'frame_id {header.frame_id!r}, expected {self.config.frame!r}')


def _hidden(arguments: list[str], node: str, flat: dict[str, Any]) -> dict[str, Any]:
    """Parameters given to this node last, where rcl shows an earlier value of another type.

    rcl keeps a value of each type and rclpy takes that of the simplest: after `rows: 5` in a file,
    `-p model.rows:=three` would be ignored in silence.
    """
    given: dict[str, Any] = {}
    for flag, value in pairwise(arguments):
        if flag == '--params-file':
            document = parse_yaml(Path(value).read_text(encoding='utf-8')) or {}
            for name in ('/**', node, f'/{node}'):
                given |= flatten((document.get(name) or {}).get('ros__parameters') or {})
        elif flag in ('-p', '--param') and ':=' in value:
            name, _, text = value.partition(':=')
            target, _, name = name.rpartition(':')
            if target in ('', node):
                given[name] = parse_yaml(text)
    return {k: v for k, v in given.items() if k in flat and not _same(v, flat[k])}


def _same(given: Any, shown: Any) -> bool:
    values = [list(v) if isinstance(v, (list, array.array)) else v for v in (given, shown)]
    return bool(values[0] == values[1])


def _refuse(parameters: list[Parameter]) -> SetParametersResult:
    """The configuration is checked as a whole, at the start only."""
    changed = [p.name for p in parameters if p.name.split('.')[0] not in ROS_PARAMETERS]
    reason = f'{changed[0]} is read at the start only' if changed else ''
    return SetParametersResult(successful=not changed, reason=reason)


def run(make: Callable[[], ParameterNode], args: list[str] | None = None) -> int:
    """Spin a node until Ctrl-C, SIGTERM or its own end; returns the exit code.

    A configuration that cannot be used is one line on standard error and exit code 1.
    """
    try:
        rclpy.init(args=args)
    except RuntimeError as error:  # such as a parameter file that rcl cannot parse
        return _fatal(error)
    leaving = threading.Event()
    threading.Thread(target=_last_resort, args=(leaving,), daemon=True).start()
    node = None
    try:
        with one_core():
            node = make()
            # a collection that looks through all of the libraries stops a node for some ten ms
            gc.collect()
            gc.freeze()
            spin(node, lambda: not getattr(node, 'finished', False))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ClothPredictError as error:
        return _fatal(error)
    except Exception as error:
        if node is None and rclpy.ok():  # such as an override of a policy that does not exist
            return _fatal(error)
        if rclpy.ok():  # else a signal took the context away in the middle of a call
            raise
    finally:
        leaving.set()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _last_resort(leaving: threading.Event) -> None:
    """End the process where it has not ended by itself some seconds after it had to.

    A long call, such as the reading of a large recording, does not notice a signal, and once in
    some hundred stops the middleware did not come back from its shutdown.
    """
    while rclpy.ok() and not leaving.wait(0.1):
        pass
    time.sleep(SHUTDOWN_LIMIT)
    os._exit(0)


def _fatal(error: Exception) -> int:
    name = (
        '' if isinstance(error, (ClothPredictError, RuntimeError)) else type(error).__name__ + ' '
    )
    print(f'[FATAL] {name}{" ".join(str(error).split())}', file=sys.stderr)
    return 1


def spin(node: Node, going: Callable[[], bool]) -> None:
    """Process callbacks while `going`; short time-outs, so that a signal is noticed at once."""
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        while node.context.ok() and going():
            executor.spin_once(timeout_sec=0.05)
    finally:
        executor.shutdown(timeout_sec=1.0)


def nanoseconds(stamp: Time) -> int:
    """Return a message's time as integer nanoseconds."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def to_time(stamp: int) -> Time:
    """Return integer nanoseconds as a message's time."""
    sec, nanosec = divmod(stamp, 10**9)
    return Time(sec=sec, nanosec=nanosec)


def cloud(stamp: int, frame_id: str, points: NDArray[np.void]) -> PointCloud2:
    """Build a PointCloud2 of structured points, shape (width,) or (height, width)."""
    grid = np.atleast_2d(points)
    height, width = grid.shape
    step = points.dtype.itemsize
    return PointCloud2(
        header=Header(stamp=to_time(stamp), frame_id=frame_id),
        height=height,
        width=width,
        fields=[
            PointField(name=name, offset=offset, datatype=datatype, count=count)
            for name, offset, datatype, count in fields_of(points.dtype)
        ],
        point_step=step,
        row_step=step * width,
        # an array.array is taken as it is; a numpy array would be copied number by number
        data=array.array('B', grid.tobytes()),
        is_dense=True,
    )
