"""Runs the live graph on a recording: three processes, a recorder, and a report."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from rclpy.context import Context

from cloth_predict import commands, config
from cloth_predict.config import Config
from cloth_predict.errors import ClothPredictError
from cloth_predict.evaluation import report
from cloth_predict.evaluation.bodies import methods_of, on_surface
from cloth_predict.evaluation.cases import Case, case_of
from cloth_predict.evaluation.compare import Evaluation, summed
from cloth_predict.evaluation.judging import judge
from cloth_predict.evaluation.predictors import Predicted
from cloth_predict.evaluation.runs import Run, aimed_at, follow
from cloth_predict.formats.bag import create_bag, read_clouds
from cloth_predict.formats.pointcloud import decode, xyz
from cloth_predict.formats.recording import read
from cloth_predict.models.closed_mesh import ClosedMesh
from cloth_predict.nodes._ros import spin
from cloth_predict.nodes.recorder import Recorder
from cloth_predict.surface.topology import NO_TRIANGLES
from cloth_predict.types import FloatArray

DISCOVERY = 20.0
"""Longest wait [s] for the nodes to find each other."""
DRAIN = 1.0
"""Wait [s] after the replay for the last messages."""


@dataclass(frozen=True)
class Demo:
    """What a run of the live graph gave.

    latency [ms], from the arrival of a frame of markers to that of its prediction, as a third
    process sees them; counts of messages by name.
    """

    evaluation: Evaluation
    latency: FloatArray
    counts: dict[str, int]
    output: Path

    def summary(self) -> dict[str, object]:
        """Return the numbers as `demo --json` prints them."""
        p50, p99 = np.percentile(self.latency, [50, 99])
        latency = {'p50': float(p50), 'p99': float(p99)}
        return {**self.evaluation.summary(), 'latency_ms': latency, **self.counts}

    def text(self) -> str:
        """Return the report."""
        p50, p99 = np.percentile(self.latency, [50, 99])
        counts = self.counts
        lost = counts['frames_published'] - counts['frames_predicted']
        return '\n'.join(
            [
                report.table(self.evaluation),
                f'latency from markers to prediction: p50 {p50:.1f} ms, p99 {p99:.1f} ms',
                f'{counts["frames_published"]} frames published, {counts["frames_predicted"]} '
                f'predicted, {lost} lost; {counts["scanline_messages"]} scanline messages',
                f'recording, table and figures: {self.output}',
            ]
        )


def demo(bag: Path, config_path: Path, output: Path, progress: Callable[[int, int], None]) -> Demo:
    """Replay a recording in real time through the three nodes, record, evaluate and draw.

    Raises ClothPredictError where the inputs do not fit or a node ends early.
    """
    commands.keep_source(bag, output)
    settings = config.load(config_path)
    source = read(bag)
    case = case_of(source, settings, str(bag))
    with _signals(), _domain(), create_bag(output, case.markers.labels) as writer:
        context = Context()
        rclpy.init(context=context)
        recorder = Recorder(writer, context=context)
        try:
            _run_graph(recorder, bag, config_path, len(source.markers), progress)
        finally:
            recorder.destroy_node()
            context.try_shutdown()
    kind, ahead = settings.filter.kind, [settings.horizon]
    made = methods_of(settings, [kind])
    runs = {name: follow(make(settings), case, ahead)[0] for name, make in made.items()}
    arrivals = recorder.arrivals
    latency = _latencies(arrivals['markers'], arrivals['cloth/prediction'], settings.horizon)
    stamps = case.markers.stamps[case.ahead]
    seconds = float(np.mean(latency)) * len(stamps) / 1e3
    runs[f'{kind}_live'] = _live_run(output, case, settings, seconds)
    judged = judge(stamps, settings.horizon, case.reference, runs, str(bag))
    evaluation = summed(settings.horizon, judged, settings)
    counts = {
        'frames_published': len(source.markers),
        'frames_predicted': len(arrivals['cloth/prediction']),
        'scanline_messages': len(arrivals['projector/scanlines']),
    }
    report.report_one(evaluation, settings, output)
    return Demo(evaluation, latency, counts, output)


def _run_graph(
    recorder: Recorder,
    bag: Path,
    config_path: Path,
    frames: int,
    progress: Callable[[int, int], None],
) -> None:
    """Start the nodes, wait until they see each other, replay, and stop them."""
    with ExitStack() as stack:
        nodes = [
            # the comparison is at one horizon
            stack.enter_context(
                _Process(name, config_path, 'use_sim_time:=true', 'horizon_mode:=fixed')
            )
            for name in ('ekf_node', 'projector_node')
        ]

        def check(process: _Process) -> bool:
            process.check()
            return True

        give_up = time.monotonic() + DISCOVERY
        spin(recorder, lambda: all(map(check, nodes)) and not _connected(recorder, give_up))
        # a quoted string, so that no file name is taken for a number
        path = json.dumps(str(bag))
        replay = stack.enter_context(
            _Process(
                'mocap_replay_node',
                config_path,
                f'replay.path:={path}',
                'replay.loop:=false',
                'replay.subscribers:=2',
            )
        )
        seen = 0

        def running() -> bool:
            nonlocal seen
            arrived = len(recorder.arrivals['markers'])
            progress(arrived - seen, frames)
            seen = arrived
            return all(map(check, nodes)) and replay.running

        spin(recorder, running)
        replay.check()
        ends = time.monotonic() + DRAIN
        spin(recorder, lambda: time.monotonic() < ends)


def _connected(recorder: Recorder, give_up: float) -> bool:
    if time.monotonic() > give_up:
        raise ClothPredictError(f'the nodes did not find each other within {DISCOVERY:g} s')
    listened = recorder.count_subscribers('cloth/prediction') >= 2
    listened &= recorder.count_subscribers('markers') >= 2
    return listened and all(
        recorder.count_publishers(topic) for topic in ('cloth/prediction', 'projector/scanlines')
    )


class _Process:
    """A node in a process of its own, stopped at the end as by Ctrl-C."""

    def __init__(self, name: str, config_path: Path, *parameters: str) -> None:
        self._name = name
        self._errors = tempfile.TemporaryFile('w+')  # noqa: SIM115
        rules = [word for rule in parameters for word in ('-p', rule)]
        ros = ['--ros-args', '--params-file', str(config_path), *rules]
        self._process = subprocess.Popen(
            [sys.executable, '-m', f'cloth_predict.nodes.{name}', *ros],
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
        )

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def check(self) -> None:
        """Raise ClothPredictError with the node's last words where it has failed."""
        if self._process.poll():
            self._errors.seek(0)
            words = [line for line in self._errors.read().splitlines() if line.strip()]
            last = (
                words[-1].removeprefix('[FATAL] ')
                if words
                else f'exit code {self._process.returncode}'
            )
            raise ClothPredictError(f'{self._name} ended: {last}')


@contextmanager
def _signals() -> Iterator[None]:
    """Take SIGTERM and SIGHUP as Ctrl-C, so that no node is left behind."""
    taken = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, signal.default_int_handler) for number in taken]
    try:
        yield
    finally:
        for number, handler in zip(taken, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def _domain() -> Iterator[None]:
    """Keep to this machine, and to a ROS domain of our own unless one is given."""
    before = dict(os.environ)
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with tempfile.TemporaryDirectory() as logs:
        os.environ.setdefault('ROS_LOG_DIR', logs)
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)


def _live_run(output: Path, case: Case, settings: Config, seconds: float) -> Run:
    """Published predictions for the frames of a case; NaN where lost."""
    published, stamps = {}, case.markers.stamps[case.ahead]
    on_body = case.reference.surface
    triangles = ClosedMesh.even(settings.model.nodes).triangles if on_body else NO_TRIANGLES
    for stamp, message in read_clouds(output, 'cloth/prediction'):
        points = decode(message, ('x', 'y', 'z', 'sigma'))
        sigma = points['sigma'].ravel().astype(float)
        published[stamp] = Predicted(xyz(points), sigma, triangles)
    unknown = Predicted.unknown(settings.model.count)
    ahead = round(settings.horizon * 1e9)
    found = [published.get(stamp + ahead, unknown) for stamp in stamps.tolist()]
    if on_body:
        aims = aimed_at(case.reference, stamps, settings.horizon)
        found = [on_surface(one, aim) for one, aim in zip(found, aims, strict=True)]
    positions = np.array([one.position for one in found])
    sigmas = np.array([one.sigma for one in found])
    unknown_nis, unknown_nees = np.full(len(stamps), np.nan), np.full(sigmas.shape, np.nan)
    return Run(positions, sigmas, unknown_nis, unknown_nees, seconds)


def _latencies(
    markers: list[tuple[int, float]], predictions: list[tuple[int, float]], horizon: float
) -> FloatArray:
    """Milliseconds from the arrival of each frame to that of its prediction, shape (frames,)."""
    arrived = {stamp + round(horizon * 1e9): at for stamp, at in markers}
    found = [1e3 * (at - arrived[stamp]) for stamp, at in predictions if stamp in arrived]
    if not found:
        raise ClothPredictError('no prediction was published for any frame')
    return np.array(found)
