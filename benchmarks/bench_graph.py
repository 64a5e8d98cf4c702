"""The live graph under looped replay: frames lost or late, and the memory of each node over time.

`python benchmarks/bench_graph.py [minutes] [--vsync]`; 10 minutes by default. With `--vsync` the
markers come as from a mocap system, and the projector has a vsync at its 60 Hz: told are also the
frames that were due, published, and heard by another process after their vsync.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from cloth_predict.config import load
from cloth_predict.nodes._ros import nanoseconds

ROOT = Path(__file__).parents[1]
CONFIG = 'config/towel.yaml'
TOPICS = ('markers', 'cloth/prediction', 'projector/scanlines')
NODES = {
    'ekf_node': (),
    'projector_node': (),
    'mocap_replay_node': ('replay.loop:=true', 'replay.subscribers:=2'),
}
VSYNC = ('horizon_mode:=vsync', 'replay.live:=true')
WARM = 2.0
"""Seconds of frames that are not counted: nodes and filter start."""
DEEP = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)


class Vertices:
    """When each frame of the projector arrived, and the stages of the latency budget."""

    def __init__(self, probe: Node) -> None:
        self._delay = load(ROOT / CONFIG).projector.delay
        self.late_ms: list[float] = []
        self._stamps: list[int] = []
        self.budget: dict[str, str] = {}
        probe.create_subscription(PointCloud2, 'projector/vertices', self._on_vertices, DEEP)
        probe.create_subscription(DiagnosticArray, 'diagnostics', self._on_diagnostics, 10)

    def _on_vertices(self, message: PointCloud2) -> None:
        stamp = nanoseconds(message.header.stamp)
        self._stamps.append(stamp)
        self.late_ms.append(1e-6 * (time.time_ns() - stamp) + 1e3 * self._delay)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        if message.status[0].name == '/projector_node':
            self.budget = {v.key: v.value for v in message.status[0].values}

    def report(self, fps: float) -> str:
        """Frames due, published and late, and by how much."""
        skipped = round(WARM * fps)
        late, stamps = np.array(self.late_ms[skipped:]), self._stamps[skipped:]
        due = round(1e-9 * (stamps[-1] - stamps[0]) * fps) + 1
        p50, p99 = np.percentile(late, [50, 99])
        told = ('late_frames', 'missed_frames', 'late_predictions', 'held_frames')
        stages = ', '.join(
            f'{k} {v}' for k, v in self.budget.items() if k.endswith('_ms') or k in told
        )
        return (
            f'{due} frames due, {len(late)} published, {(late > 0).sum()} heard after their '
            f'vsync; arrival by the vsync p50 {p50:+.2f} ms, p99 {p99:+.2f} ms, latest '
            f'{late.max():+.2f} ms\n{stages}'
        )


def start(name: str, rules: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """Start a node on the shipped recording."""
    words = [word for rule in rules for word in ('-p', rule)]
    command = [sys.executable, '-m', f'cloth_predict.nodes.{name}', '--ros-args']
    return subprocess.Popen([*command, '--params-file', CONFIG, *words], cwd=ROOT)


def main(minutes: float, vsync: bool) -> None:
    """Run the graph and print a line per minute, then the totals."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    rclpy.init()
    probe = Node('probe')
    counts = dict.fromkeys(TOPICS, 0)
    for topic in TOPICS:
        listen(probe, topic, counts)
    vertices = Vertices(probe) if vsync else None
    more = VSYNC if vsync else ()
    gc.collect()
    gc.freeze()  # as the nodes do
    running = {name: start(name, (*rules, *more)) for name, rules in NODES.items()}
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
    if vertices:
        print(f'{counts["markers"]} frames of markers, {counts["cloth/prediction"]} predictions')
        print(vertices.report(load(ROOT / CONFIG).projector.fps))
    else:
        lost = counts['markers'] - counts['projector/scanlines']
        print(f'{counts["markers"]} frames published, {lost} without their scanlines')


def listen(probe: Node, topic: str, counts: dict[str, int]) -> None:
    """Count the messages of a topic."""

    def heard(_: bytes) -> None:
        counts[topic] += 1

    probe.create_subscription(PointCloud2, topic, heard, DEEP, raw=True)


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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('minutes', type=float, nargs='?', default=10.0)
    parser.add_argument('--vsync', action='store_true', help='a projector with a vsync at 60 Hz')
    given = parser.parse_args()
    main(given.minutes, given.vsync)
