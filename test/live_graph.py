"""A live graph over real DDS for tests: nodes in one process with a context of their own."""

import os
import time
from collections import defaultdict
from pathlib import Path

import domains
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from cloth_predict.config import load
from cloth_predict.formats.pointcloud import MARKERS
from cloth_predict.nodes._ros import cloud, nanoseconds

ROOT = Path(__file__).parents[1]
TOWEL = ROOT / 'config' / 'towel.yaml'
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
DOMAINS = domains.of_graphs()
DEADLINE = 60.0  # s; discovery may take some of it on a loaded machine
RELIABLE = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)


class Graph:
    """A context, an executor, and a probe that keeps what it hears."""

    def __init__(self):
        self.context, self.domain = Context(), next(DOMAINS)
        rclpy.init(context=self.context, domain_id=self.domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.probe = self.add(Node('probe', context=self.context))
        self.heard = defaultdict(list)

    def add(self, node):
        self.executor.add_node(node)
        return node

    def start(self, kind, **parameters):
        settings = {'model.rows': 5, 'model.cols': 4, **parameters}
        overrides = [Parameter(name, value=value) for name, value in settings.items()]
        return self.add(
            kind(context=self.context, use_global_arguments=False, parameter_overrides=overrides)
        )

    def listen(self, topic, kind):
        self.probe.create_subscription(kind, topic, self.heard[topic].append, BEST_EFFORT)

    def until(self, condition):
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, (
                f'heard { ({k: len(v) for k, v in self.heard.items()}) }'
            )
            self.executor.spin_once(timeout_sec=0.05)

    def close(self):
        for node in list(self.executor.get_nodes()):
            node.destroy_node()
        self.executor.shutdown()
        self.context.try_shutdown()


def flat(config_path=TOWEL, **changes):
    """Parameters of a shipped configuration, as ROS names them."""
    config = load(config_path)
    found = {}

    def walk(prefix, value):
        if hasattr(value, '__dataclass_fields__'):
            for name in value.__dataclass_fields__:
                walk(f'{prefix}.{name}' if prefix else name, getattr(value, name))
        elif value not in ((), ''):
            found[prefix] = list(value) if isinstance(value, tuple) else value

    walk('', config)
    return found | changes


def frame(stamp, positions, ids=None, frame_id='mocap'):
    points = np.zeros(len(positions), MARKERS)
    for k, axis in enumerate('xyz'):
        points[axis] = np.asarray(positions, float)[:, k]
    points['id'] = np.arange(len(positions)) if ids is None else ids
    return cloud(stamp, frame_id, points)


def stamps(messages):
    return [nanoseconds(m.header.stamp) for m in messages]


def values(graph, node='/ekf_node'):
    """Latest diagnostics of a node."""
    found = {}
    for message in graph.heard['diagnostics']:
        if message.status[0].name == node:
            found = {v.key: v.value for v in message.status[0].values}
    return found
