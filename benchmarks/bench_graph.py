"""The live graph under looped replay: frames lost, and the memory of each node over time.

`python benchmarks/bench_graph.py [minutes]`; 10 minutes by default.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import PointCloud2

ROOT = Path(__file__).parents[1]
TOPICS = ('markers', 'cloth/prediction', 'projector/scanlines')
NODES = {
    'ekf_node': (),
    'projector_node': (),
    'mocap_replay_node': ('replay.loop:=true', 'replay.subscribers:=2'),
}


def start(name: str, rules: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """Start a node on the shipped recording."""
    words = [word for rule in rules for word in ('-p', rule)]
    command = [sys.executable, '-m', f'cloth_predict.nodes.{name}', '--ros-args']
    return subprocess.Popen([*command, '--params-file', 'config/towel.yaml', *words], cwd=ROOT)


def main(minutes: float) -> None:
    """Run the graph and print a line per minute, then the totals."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rclpy.init()
    probe = Node('probe')
    counts = dict.fromkeys(TOPICS, 0)
    for topic in TOPICS:
        listen(probe, topic, counts)
    running = {name: start(name, rules) for name, rules in NODES.items()}
    try:
        memory = watch(probe, running, counts, minutes)
    finally:
        for process in reversed(running.values()):
            process.send_signal(signal.SIGINT)
            process.wait()
        rclpy.shutdown()
    for name, values in memory.items():
        slope = np.polyfit(np.arange(len(values)) / 6, values, 1)[0] if len(values) > 1 else 0.0
        print(f'{name}: largest {max(values):.1f} MiB, slope {slope:+.3f} MiB per minute')
    lost = counts['markers'] - counts['projector/scanlines']
    print(f'{counts["markers"]} frames published, {lost} without their scanlines')


def listen(probe: Node, topic: str, counts: dict[str, int]) -> None:
    """Count the messages of a topic."""

    def heard(_: bytes) -> None:
        counts[topic] += 1

    deep = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
    probe.create_subscription(PointCloud2, topic, heard, deep, raw=True)


def watch(
    probe: Node,
    running: dict[str, subprocess.Popen[bytes]],
    counts: dict[str, int],
    minutes: float,
) -> dict[str, list[float]]:
    """Resident memory [MiB] of each node every 10 s."""
    memory: dict[str, list[float]] = {name: [] for name in running}
    begin = time.monotonic()
    for sample in range(1, int(6 * minutes) + 1):
        while time.monotonic() < begin + 10 * sample:
            rclpy.spin_once(probe, timeout_sec=0.05)
        for name, process in running.items():
            memory[name].append(psutil.Process(process.pid).memory_info().rss / 2**20)
        if sample % 6 == 0:
            sizes = ', '.join(f'{name} {values[-1]:.1f}' for name, values in memory.items())
            print(f'{sample // 6:3d} min: MiB: {sizes}; messages: {counts}', flush=True)
    return memory


if __name__ == '__main__':
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
