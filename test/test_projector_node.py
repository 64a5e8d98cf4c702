"""The projector in the live graph: vsyncs, what is asked for, guards, maps, and what is told.

Nothing here depends on how fast the machine is: frames that were not made in time are missed.
"""

import time

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from live_graph import DEADLINE, RELIABLE, TOWEL, flat, frame, stamps, values
from recordings import BAG, shipped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from cloth_predict.config import build, load, nest
from cloth_predict.errors import ConfigError
from cloth_predict.formats.pointcloud import SURFACE, decode, encode_surface, xyz
from cloth_predict.nodes._ros import cloud, nanoseconds, to_time
from cloth_predict.nodes.ekf_node import EkfNode
from cloth_predict.nodes.mocap_replay_node import MocapReplayNode
from cloth_predict.nodes.projector_node import ProjectorNode
from cloth_predict.projection.field_maps import field_maps
from cloth_predict.projection.motion import Motion
from cloth_predict.projection.vsync import Vsync
from cloth_predict.projection.warp import Warper
from cloth_predict.tracker import Tracker

MS = 10**6
VERTICES, SCANLINES = 'projector/vertices', 'projector/scanlines'
NEXT, PREDICTION = 'projector/next_frame', 'cloth/prediction'
ERROR, WARN = DiagnosticStatus.ERROR, DiagnosticStatus.WARN
NODE = '/projector_node'


@pytest.fixture(scope='module')
def towel():
    return shipped().markers


@pytest.fixture(scope='module')
def surface(towel):
    """The towel as it is predicted from its first frame, packed."""
    tracker = Tracker(load(TOWEL))
    tracker.step(0, towel.positions[0], towel.visible[0])
    return encode_surface(tracker.predict(0.1), 5, 4)


class Projector:
    """A projector node that is given predictions one by one."""

    def __init__(self, graph, **parameters):
        self._graph = graph
        for topic in (VERTICES, SCANLINES):
            graph.listen(topic, PointCloud2)
        graph.listen(NEXT, Header)
        graph.listen('diagnostics', DiagnosticArray)
        self.publisher = graph.probe.create_publisher(PointCloud2, PREDICTION, RELIABLE)
        self.node = graph.start(ProjectorNode, **flat(**parameters))
        graph.until(
            lambda: (
                self.publisher.get_subscription_count() == 1
                and all(graph.probe.count_publishers(t) for t in (VERTICES, SCANLINES))
                and graph.probe.count_publishers('diagnostics')
            )
        )

    def send(self, stamp, points):
        self.publisher.publish(cloud(stamp, 'mocap', points))

    def show(self, points, ahead=50 * MS):
        """Send predictions for frames to come until one is shown; returns the last stamp sent."""
        shown, start = self._graph.heard[VERTICES], 0
        count = len(shown)
        while len(shown) == count:  # one may come too late on a machine that is busy
            start = self.asked(start)
            self.send(start + ahead, points)
        return start + ahead

    def asked(self, after=0):
        """Wait for a request for a frame later than this, and return its start."""
        self._graph.until(lambda: max(stamps_of(self._graph.heard[NEXT]), default=0) > after)
        return max(stamps_of(self._graph.heard[NEXT]))

    def heard(self, count, topic=VERTICES):
        self._graph.until(lambda: len(self._graph.heard[topic]) >= count)
        return self._graph.heard[topic]

    def told(self, level, words, again=lambda: None):
        """Wait until the node's diagnostics say this, at this level or a higher one."""

        def found():
            again()
            given = [m.status[0] for m in self._graph.heard['diagnostics']]
            return [s for s in given if s.name == NODE and s.level >= level and words in s.message]

        self._graph.until(found)


def stamps_of(headers):
    return [nanoseconds(header.stamp) for header in headers]


def moved(points, across, **fields):
    found = points.copy()
    found['x'] += across
    for name, value in fields.items():
        found[name] = value
    return found


# --- the vsync


def test_a_frame_is_asked_for_and_made_at_each_vsync(graph, surface):
    fps, phase, delay = 59.94, 0.0042, 0.02
    projector = Projector(
        graph,
        horizon_mode='vsync',
        **{'projector.fps': fps, 'projector.vsync_phase': phase, 'projector.delay': delay},
    )
    start = 0
    for _ in range(12):
        start = projector.asked(start)
        projector.send(start, surface)
    made = stamps(projector.heard(12))
    assert made == stamps(projector.heard(12, SCANLINES))[: len(made)]
    assert set(made) <= set(stamps_of(graph.heard[NEXT]))
    assert np.diff(made).min() > 0
    vsync = Vsync(round(1e9 * phase), fps)
    for stamp in made:
        assert vsync.after(stamp - 20 * MS - 1) == stamp - 20 * MS


def test_a_late_prediction_is_counted_and_not_shown(graph, surface):
    projector = Projector(graph, horizon_mode='vsync')
    projector.send(projector.asked() - 200 * MS, moved(surface, 0.1))
    graph.until(lambda: values(graph, NODE).get('late_predictions') == '1')
    assert graph.heard[VERTICES] == []
    projector.told(WARN, '1 of 1 predictions were too late for their frame')
    projector.show(surface)  # for a frame to come: it serves, moved back
    shown = graph.heard[VERTICES][0]
    assert decode(shown, ('x',))['x'][0, 0] == pytest.approx(surface['x'][0, 0], abs=0.02)


def test_the_phase_is_that_of_the_vsync_topic_and_its_end_is_told(graph, surface):
    projector = Projector(graph, horizon_mode='vsync', **{'projector.vsync': 'topic'})
    publisher = graph.probe.create_publisher(Time, '/vsync', RELIABLE)
    graph.until(lambda: publisher.get_subscription_count() == 1)
    phase = graph.probe.get_clock().now().nanoseconds + 5 * MS
    vsync = Vsync(phase, 60.0)
    for k in range(20):
        publisher.publish(to_time(vsync.after(phase + k * 33 * MS)))
    projector.told(WARN, 'no /vsync for')
    start = projector.asked()
    # the median phase of vsyncs that are rounded to a nanosecond, over some 300 frames
    assert abs(vsync.after(start - 20 * MS - 1000) - (start - 20 * MS)) <= 1000
    projector.show(surface)


def test_frames_follow_a_clock_in_steps_and_go_back_with_it(graph, surface):
    projector = Projector(graph, horizon_mode='vsync', use_sim_time=True)
    clock = graph.probe.create_publisher(Clock, '/clock', RELIABLE)
    graph.until(lambda: clock.get_subscription_count() >= 1)
    for origin in (1000 * 10**9, 5 * 10**9):
        real = time.monotonic()

        def made(origin=origin):
            """Frames by the clock as it is now set; others may still be on their way."""
            return [s for s in stamps(graph.heard[VERTICES]) if origin < s < origin + 20e9]

        while len(made()) < 5:
            now = origin + round(1e9 * (time.monotonic() - real)) // (10 * MS) * 10 * MS
            clock.publish(Clock(clock=to_time(now)))
            for _ in range(3):
                graph.executor.spin_once(timeout_sec=0.003)
            for start in stamps_of(graph.heard[NEXT])[-1:]:
                projector.send(start, surface)
            assert time.monotonic() - real < DEADLINE
        assert stamps(graph.heard[VERTICES])[-1] == made()[-1]
        assert np.diff(made()).min() > 0


# --- the prediction that is asked for


@pytest.mark.parametrize('motion', ['constant_acceleration', 'model'])
def test_the_prediction_is_for_the_frame_that_was_asked_for(graph, towel, motion):
    for topic in (PREDICTION, 'cloth/estimate'):
        graph.listen(topic, PointCloud2)
    parameters = {'projector.motion': motion, 'projector.fps': 50.0}
    graph.start(EkfNode, **flat(horizon_mode='vsync', **parameters))
    markers = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
    requests = graph.probe.create_publisher(Header, NEXT, RELIABLE)
    graph.until(
        lambda: (
            markers.get_subscription_count() == requests.get_subscription_count() == 1
            and graph.probe.count_publishers(PREDICTION)
        )
    )
    tracker, ahead = Tracker(load(TOWEL)), [None, 47_000_001, 27_000_001, 7_000_001, 7_000_001]
    for k, off in enumerate(ahead):
        if k == 1:
            requests.publish(Header(stamp=to_time(int(towel.stamps[k]) + off)))
        end = time.monotonic() + 0.2
        graph.until(lambda end=end: time.monotonic() > end)  # the request is there first
        capture = int(towel.stamps[k])
        seen = np.flatnonzero(towel.visible[k])
        markers.publish(frame(capture, towel.positions[k, seen], ids=seen))
        graph.until(lambda k=k: len(graph.heard[PREDICTION]) == k + 1)
    # recorded stamps have nothing in common with the clock: the first frame after the capture
    expected = [100_000_000]
    first = int(towel.stamps[1]) + 47_000_001
    for k in range(1, 5):
        expected.append(first - int(towel.stamps[k]))
    assert np.subtract(stamps(graph.heard[PREDICTION]), towel.stamps[:5]).tolist() == expected
    for k, shown in enumerate(graph.heard[PREDICTION]):
        tracker.step(int(towel.stamps[k]), towel.positions[k], towel.visible[k])
        horizon = 1e-9 * expected[k]
        names = [f'{p}{axis}_end' for p in ('', 'v') for axis in 'xyz']
        given = [field.name for field in shown.fields]
        assert set(names) & set(given) == (set(names) if motion == 'model' else set())
        points = decode(shown, (*SURFACE.names, 'horizon', 'received', 'filtered'))
        np.testing.assert_allclose(points['horizon'], horizon, rtol=1e-6)  # float32
        assert (points['filtered'] >= points['received']).all()
        wanted = encode_surface(tracker.predict(horizon), 5, 4)
        # the tracker repeats the call, but for a horizon that is a float
        np.testing.assert_allclose(xyz(points), xyz(wanted), atol=1e-6)
        if motion == 'model':
            after = tracker.predict(horizon + 0.02)
            points = decode(shown, tuple(names))
            found = np.column_stack([points[name].ravel() for name in names])
            both = np.column_stack([after.position, after.velocity])
            np.testing.assert_allclose(found, both, atol=1e-5)  # float32 of some m/s


def test_the_whole_graph_meets_its_frames_and_accounts_for_the_time(graph, towel):
    for topic in (PREDICTION, VERTICES):
        graph.listen(topic, PointCloud2)
    graph.listen(NEXT, Header)
    graph.listen('diagnostics', DiagnosticArray)
    parameters = {
        'horizon_mode': 'vsync', 'projector.max_age': 20.0, 'projector.fps': 5.0,
        # one thread has to come round to it in time: each frame starts anew, which takes little
        'projector.lead': 0.1, 'filter.max_gap': 0.001, 'limits.sigma_error': 9.0,
        'projector.max_sigma': 9.0,
    }  # fmt: skip
    coarse = flat(TOWEL.with_name('towel_coarse.yaml'), **parameters)
    graph.start(EkfNode, **coarse)
    graph.start(ProjectorNode, **coarse)
    markers = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
    graph.until(lambda: markers.get_subscription_count() == 1 and len(graph.heard[NEXT]) > 2)
    seen, begin = np.flatnonzero(towel.visible[0]), time.monotonic()
    while values(graph, NODE).get('total_ms', 'unknown') == 'unknown':
        asked = len(graph.heard[NEXT])
        markers.publish(frame(time.time_ns() - 2 * MS, towel.positions[0, seen], ids=seen))
        graph.until(lambda asked=asked: len(graph.heard[NEXT]) > asked)
        assert time.monotonic() - begin < DEADLINE
    vsync = Vsync(20 * MS, 5.0)
    for stamp in stamps(graph.heard[PREDICTION]):
        # each is for a frame; 1 ns: the one asked for and those after it are rounded twice
        assert vsync.after(stamp - 10) - stamp in (-1, 0, 1)
    assert set(stamps(graph.heard[VERTICES])) <= set(stamps_of(graph.heard[NEXT]))
    found = values(graph, NODE)
    stages = ('capture_to_receive', 'receive_to_filter', 'filter_to_publish', 'publish_to_vsync')
    for name in (*stages, 'vsync_to_row', 'total'):
        assert float(found[f'{name}_ms']) <= float(found[f'{name}_p99_ms'])
    # the delay of 20 ms, and half a frame: the towel is in the middle of the picture
    assert float(found['vsync_to_row_ms']) == pytest.approx(20 + 100, abs=6)


# --- guards


def unsafe(surface):
    return {
        'nan': (moved(surface, np.nan), 'is not finite'),
        'sigma': (moved(surface, 0.0, sigma=0.06), 'sigma of vertex 0 is 60 mm'),
    }


@pytest.mark.parametrize('kind', ['nan', 'sigma'])
@pytest.mark.parametrize('fallback', ['hold', 'blank'])
@pytest.mark.parametrize('mode', ['fixed', 'vsync'])
def test_what_is_not_safe_is_not_shown(graph, surface, kind, fallback, mode):
    projector = Projector(
        graph, horizon_mode=mode, **{'projector.fallback': fallback, 'projector.max_age': 9.0}
    )
    bad, words = unsafe(surface)[kind]
    if mode == 'vsync':
        projector.show(surface)
        projector.told(ERROR, words, lambda: projector.send(projector.asked() + 100 * MS, bad))
    else:
        projector.send(10**9, surface)
        projector.send(2 * 10**9, bad)
        projector.told(ERROR, words)
        assert stamps(graph.heard[VERTICES]) == [10**9, 2 * 10**9]
    last = graph.heard[VERTICES][-1]
    points = decode(last, ('u', 'v'))
    if fallback == 'blank':
        assert (last.width, len(last.data)) == (0, 0)
        assert [field.name for field in last.fields][:2] == ['u', 'v']
    else:
        assert points.shape == (5, 4)
        assert np.isfinite(points['u']).all()
    key = 'held_frames' if fallback == 'hold' else 'blanked_frames'
    assert int(values(graph, NODE)[key]) >= 1


@pytest.mark.parametrize('fallback', ['hold', 'blank'])
def test_a_frame_for_each_prediction_ends_with_the_predictions(graph, surface, fallback):
    projector = Projector(graph, **{'projector.fallback': fallback, 'projector.max_age': 0.1})
    projector.send(10**9, surface)
    projector.told(ERROR, 'no prediction for more than projector.max_age (0.1 s)')
    shown = graph.heard[VERTICES]
    assert [message.width for message in shown] == ([4] if fallback == 'hold' else [4, 0])
    projector.send(2 * 10**9, moved(surface, 0.2))
    count = len(shown) + 1
    last = projector.heard(count)[-1]
    step = decode(last, ('u',))['u'] - decode(shown[0], ('u',))['u']
    # 0.2 m are 250 px, of which a hold lets 5000 px/s in 1/60 s through; float32 of 1000 px
    expected = 5000 / 60 if fallback == 'hold' else 0.2 * 2775 / 2.2
    assert step.max() == pytest.approx(expected, rel=1e-3 if fallback == 'hold' else 0.1)


def test_nothing_is_told_before_the_first_prediction(graph):
    projector = Projector(graph, **{'projector.max_age': 0.05})
    graph.until(lambda: 'rate_hz' in values(graph, NODE))
    projector.told(DiagnosticStatus.STALE, 'no frames')
    assert graph.heard[VERTICES] == []
    messages = [m.status[0].message for m in graph.heard['diagnostics']]
    assert set(messages) == {'no frames'}


def test_a_surface_outside_the_view_is_empty_and_told(graph, surface):
    projector = Projector(graph, **{'projector.max_age': 9.0})
    projector.send(10**9, moved(surface, 9.0))
    for topic in (VERTICES, SCANLINES):
        found = projector.heard(1, topic)[0]
        assert (found.width, found.row_step, len(found.data)) == (0, 0, 0)
        assert found.point_step > 0
    projector.told(WARN, 'outside the frame of the projector')
    assert values(graph, NODE)['vertices_outside'] == '20'
    assert values(graph, NODE)['empty_frames'] == '1'


def test_a_prediction_before_the_last_frame_is_not_shown_unless_time_jumps_back(graph, surface):
    projector = Projector(graph)
    for stamp in (1000, 1010, 1000, 1010, 400):
        projector.send(stamp * MS, surface)
    graph.until(lambda: values(graph, NODE).get('late_predictions') == '1')
    assert stamps(projector.heard(4)) == [stamp * MS for stamp in (1000, 1010, 1010, 400)]


# --- the map


@pytest.mark.parametrize('scan', ['interlaced', 'colour_sequential'])
def test_the_map_is_that_of_the_frame(graph, surface, scan):
    parameters = {
        'projector.warp_map': True, 'projector.scan': scan, 'projector.colours': 2,
        'projector.width': 96, 'projector.height': 64, 'projector.alpha': 140.0,
        'projector.beta': 140.0, 'projector.u0': 48.0, 'projector.v0': 32.0,
    }  # fmt: skip
    graph.listen('projector/warp_map', Image)
    projector = Projector(graph, **parameters)
    graph.until(lambda: graph.probe.count_publishers('projector/warp_map'))
    count, heard = 1 if scan == 'interlaced' else 2, graph.heard['projector/warp_map']
    stamp = 10**9
    while len(heard) < count:  # the process skips what comes before it is ready
        stamp += 10 * MS
        projector.send(stamp, surface)
        end = time.monotonic() + 0.1
        graph.until(lambda end=end: time.monotonic() > end)
    config = build(nest(flat(**parameters)), 'test')
    vectors = (
        np.column_stack([surface[f'{p}{axis}'].ravel() for axis in 'xyz']).astype(float)
        for p in ('', 'v', 'a')
    )
    motion = Motion.constant_acceleration(*vectors)
    warper = Warper.of(config, motion.at(0.0))
    for found, (begin, expected) in zip(
        heard, field_maps(warper, warper.warp(motion).keys), strict=False
    ):
        assert (found.encoding, found.is_bigendian) == ('32FC2', 0)
        assert (found.height, found.width, found.step) == (64, 96, 96 * 8)
        assert found.header.frame_id == 'mocap'
        picture = np.frombuffer(found.data, np.float32).reshape(64, 96, 2)
        np.testing.assert_array_equal(picture, expected)
        assert np.isfinite(picture).any()
        assert (nanoseconds(found.header.stamp) - round(1e9 * begin)) % (10 * MS) == 0


# --- the rest


def test_what_is_no_projector_ends_the_node_at_its_start(graph):
    mirrored = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]
    with pytest.raises(ConfigError, match=r'projector\.rotation'):
        graph.start(ProjectorNode, **flat(**{'projector.rotation': mirrored}))
    with pytest.raises(ConfigError, match=r'projector\.lead'):
        graph.start(ProjectorNode, **flat(horizon_mode='vsync', **{'projector.lead': 0.05}))


def test_a_live_replay_stamps_by_the_clock_and_goes_on_at_its_end(graph, towel):
    graph.listen('markers', PointCloud2)
    graph.listen('/clock', Clock)
    before = time.time_ns()
    node = graph.start(
        MocapReplayNode,
        **flat(
            **{'replay.path': str(BAG), 'replay.live': True, 'replay.loop': True,
               'replay.start': 10.7, 'replay.rate': 5.0}
        ),
    )  # fmt: skip
    graph.until(lambda: len(graph.heard['markers']) >= 70)
    found = stamps(graph.heard['markers'])
    assert before < found[0] < time.time_ns()
    # 0.3 s of the recording at 5 times its rate, twice; a stamp is rounded to 1 ns, and the time
    # that it is made of to the 256 ns of a float
    np.testing.assert_allclose(np.diff(found), 2 * MS, atol=600)
    assert graph.heard['/clock'] == []
    assert not node.finished
