"""What the EKF node does with a surface as it goes along: predictions, their check, and health.

Frames are sent one by one, each after what came of the one before, so that none is lost.
"""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from live_graph import RELIABLE, TOWEL, Graph, flat, frame, stamps, values
from recordings import beginning
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from cloth_predict.config import load
from cloth_predict.evaluation import judging
from cloth_predict.evaluation.cases import labelled_case
from cloth_predict.evaluation.compare import compare
from cloth_predict.evaluation.predictors import METHODS
from cloth_predict.formats.pointcloud import UNLABELLED, decode, encode_surface
from cloth_predict.nodes._ros import nanoseconds, to_time
from cloth_predict.nodes.ekf_node import EkfNode
from cloth_predict.tracker import Tracker

MS = 10**6  # ns
NOTHING = np.zeros((0, 3))
AHEAD = {'': 0.1, '_37ms': 0.037}
"""Horizons [s] by the end of the names of what is of them."""
ERROR, OK, WARN = DiagnosticStatus.ERROR, DiagnosticStatus.OK, DiagnosticStatus.WARN


class Live:
    """An EKF node that is fed frame by frame."""

    def __init__(self, graph, *listened, **parameters):
        self._graph = graph
        for topic in ('cloth/prediction', 'cloth/estimate', *listened):
            graph.listen(topic, PointCloud2)
        graph.listen('diagnostics', DiagnosticArray)
        self._node = graph.start(EkfNode, **flat(**parameters))
        self._markers = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
        topics = ['cloth/prediction', 'cloth/estimate', 'diagnostics', *listened]
        graph.until(
            lambda: (
                self._markers.get_subscription_count() == 1
                and all(graph.probe.count_publishers(topic) for topic in topics)
            )
        )

    def take(self, message):
        """Send a frame and wait until the node has taken it."""
        before = self._taken()
        self._markers.publish(message)
        self._graph.until(lambda: self._taken() > before)

    def _taken(self):
        return self._node._tracker.counts.total() + self._node._diagnostics.counts.total()

    def heard(self, topic, count):
        """Wait for this many messages and return them."""
        self._graph.until(lambda: len(self._graph.heard[topic]) >= count)
        return self._graph.heard[topic]

    def told(self, level, words):
        """Wait for the next diagnostics of this level with these words and return the message."""
        seen = self._graph.heard['diagnostics']
        begin = len(seen)

        def new():
            found = [message.status[0] for message in seen[begin:]]
            return [s.message for s in found if s.level == level and words in s.message]

        self._graph.until(new)
        return new()[0]


@pytest.fixture(scope='module')
def towel():
    """1.2 s of the shipped recording; a bag has float32 as a message has, so nothing is lost."""
    return beginning(120).markers


def sent(markers, k, stamp=None, ids=None):
    """Frame k with the markers that it shows, by default under their own labels."""
    seen = np.flatnonzero(markers.visible[k])
    names = seen if ids is None else ids[seen]
    stamp = int(markers.stamps[k]) if stamp is None else stamp
    return frame(stamp, markers.positions[k, seen], ids=names)


# --- predictions and their check


@pytest.fixture(scope='module')
def watched(towel):
    """Messages and last values after 1.2 s with two horizons."""
    graph = Graph()
    try:
        live = Live(graph, 'cloth/prediction_37ms', horizons=[AHEAD['_37ms']])
        for k in range(len(towel)):
            live.take(sent(towel, k))
        for topic in ('cloth/prediction', 'cloth/prediction_37ms', 'cloth/estimate'):
            live.heard(topic, len(towel))
        graph.until(lambda: values(graph).get('realised_count') == '110')
        yield graph.heard, values(graph)
    finally:
        graph.close()


def test_every_horizon_is_published(watched, towel):
    tracker, topics = Tracker(load(TOWEL)), {f'cloth/prediction{e}': h for e, h in AHEAD.items()}
    for topic, horizon in topics.items():
        assert stamps(watched[0][topic]) == (towel.stamps + round(1e9 * horizon)).tolist()
    for k, stamp in enumerate(towel.stamps.tolist()):
        tracker.step(stamp, towel.positions[k], towel.visible[k])
        for topic, horizon in topics.items():
            heard, expected = watched[0][topic][k], encode_surface(tracker.predict(horizon), 5, 4)
            np.testing.assert_array_equal(decode(heard, expected.dtype.names), expected)


def test_the_live_check_agrees_with_the_evaluation(watched, towel, monkeypatch):
    monkeypatch.setattr(judging, 'WARM_UP', 0.0)
    case, found = labelled_case(towel, load(TOWEL), 'towel'), watched[1]
    methods = {name: METHODS[name] for name in ('hold', 'ekf')}
    evaluations = compare(case, load(TOWEL), list(AHEAD.values()), methods)
    for end, offline in zip(AHEAD, evaluations, strict=True):
        error, hold = offline.scores['ekf'].rmse_mm, offline.scores['hold'].rmse_mm
        assert found[f'realised_count{end}'] == str(len(offline.targets))
        assert found[f'realised_error_mm{end}'] == f'{error:.3f}'
        assert found[f'gain_over_hold{end}'] == f'{1 - error / hold:.4f}'
        for k, share in enumerate(offline.details['ekf'].coverage, 1):
            assert found[f'coverage_{k}_sigma{end}'] == f'{share:.4f}'


def test_the_live_check_takes_no_late_frame(graph, towel):
    live = Live(graph, horizon=0.05)
    for k in [*range(17), 18, 19, 17, *range(20, 25)]:
        live.take(sent(towel, k))
    # those of frames 0 to 19 without 17; that for frame 17 is compared between 16 and 18
    graph.until(lambda: values(graph).get('realised_count') == '19')
    assert values(graph)['rewound_steps'] == '1'


def test_a_prediction_worse_than_the_last_frame_is_told(graph, towel):
    live = Live(graph, **{'model.gravity': [0.0, -9.81, 300.0], 'filter.process_noise': 0.0})
    for k in range(120):
        live.take(sent(towel, k))
    told = live.told(WARN, 'cloth/prediction: predictions are worse than the last measurement')
    assert float(values(graph)['gain_over_hold']) < 0, told


# --- markers without labels


def test_points_without_labels_give_the_same_predictions(graph, towel):
    live, rng = Live(graph), np.random.default_rng(5)
    few = np.where(np.arange(20) < 4, np.arange(20), UNLABELLED)  # the bar has labels
    for k in range(30):
        points = sent(towel, k, ids=few)
        order = rng.permutation(points.width)
        mixed = np.frombuffer(points.data, np.uint8).reshape(points.width, -1)[order]
        points.data = mixed.tobytes()
        live.take(points)
    tracker = Tracker(load(TOWEL))
    heard = live.heard('cloth/prediction', 30)
    for k, stamp in enumerate(towel.stamps[:30].tolist()):
        tracker.step(stamp, towel.positions[k], towel.visible[k])
        expected = encode_surface(tracker.predict(0.1), 5, 4)
        np.testing.assert_array_equal(decode(heard[k], expected.dtype.names), expected)
    last = str(towel.visible[29, 4:].sum())
    graph.until(lambda: values(graph).get('unlabelled_markers') == last)
    assert int(values(graph)['matched_markers']) > 0


def test_a_grid_that_does_not_fit_the_points_is_told(graph, towel):
    live = Live(graph)
    live.take(frame(0, towel.positions[0, :15], ids=np.full(15, UNLABELLED)))
    told = live.told(WARN, 'no surface yet')
    assert '15 markers do not fit 5 x 4 = 20 nodes' in told


# --- the measured horizon


def horizon_of(graph):
    found = values(graph)
    return float(found['horizon_ms']), found['pipeline_delay_ms']


def test_auto_predicts_for_the_measured_delay(graph, towel):
    # where a machine is busy frames are far apart: then the surface starts anew, and is predicted
    busy = {'filter.max_gap': 0.1, 'limits.sigma_error': 9.0}
    live = Live(graph, horizon_mode='auto', **{'projector.delay': 0.02}, **busy)
    captured = []
    for _ in range(25):
        captured.append(graph.probe.get_clock().now().nanoseconds - 30 * MS)
        live.take(sent(towel, 0, captured[-1]))
    heard = live.heard('cloth/prediction', 25)
    ahead = np.subtract(stamps(heard), captured) / MS
    assert ahead[0] == 100.0  # not measured yet
    assert ahead[-1] >= 30 + 20  # the age of a frame and the projector; no less in any case
    graph.until(lambda: values(graph).get('pipeline_delay_ms', 'unknown') != 'unknown')
    horizon, delay = horizon_of(graph)
    assert horizon == pytest.approx(float(delay) + 20, abs=0.11)  # both are rounded to 0.1


def test_auto_under_a_clock_that_stands_still_between_frames(graph, towel):
    live = Live(graph, horizon_mode='auto', use_sim_time=True)
    clock = graph.probe.create_publisher(Clock, '/clock', RELIABLE)
    graph.until(lambda: clock.get_subscription_count() >= 1)
    for k in range(25):
        clock.publish(Clock(clock=to_time(int(towel.stamps[k]))))
        live.take(sent(towel, k))
    graph.until(lambda: values(graph).get('pipeline_delay_ms', 'unknown') != 'unknown')
    horizon, delay = horizon_of(graph)
    assert horizon == pytest.approx(float(delay) + 20, abs=0.11)  # both are rounded to 0.1
    assert float(delay) > 0


def test_auto_with_clocks_that_have_nothing_in_common_is_told(graph, towel):
    live = Live(graph, horizon_mode='auto')
    for k in range(12):
        live.take(sent(towel, k))
    heard = live.heard('cloth/prediction', 12)
    assert stamps(heard) == (towel.stamps[:12] + 100 * MS).tolist()
    assert 'stays at 100 ms' in live.told(WARN, 'horizon_mode auto')


# --- health


def test_a_blackout_warns_then_stops_the_prediction_and_ends_by_itself(graph, towel):
    live = Live(graph)
    for k in range(20):
        live.take(sent(towel, 0, 10 * MS * k))
    live.told(OK, 'running')
    for k in range(20, 23):
        live.take(frame(10 * MS * k, NOTHING))
    assert '0 of 20' in live.told(WARN, 'markers')
    for k in range(23, 150):
        live.take(frame(10 * MS * k, NOTHING))
    assert 'limits.sigma_error' in live.told(ERROR, 'no prediction')
    count = len(graph.heard['cloth/prediction'])
    live.take(frame(1500 * MS, NOTHING))
    live.told(ERROR, 'no prediction')
    assert len(graph.heard['cloth/prediction']) == count < 150
    assert len(graph.heard['cloth/estimate']) == count
    for k in range(151, 160):
        live.take(sent(towel, 0, 10 * MS * k))
    live.told(OK, 'running')
    last = live.heard('cloth/prediction', count + 9)[-1]
    assert nanoseconds(last.header.stamp) == 1690 * MS
