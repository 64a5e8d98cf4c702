"""The nodes over real DDS: what comes through, what is refused, and how they end."""

import array
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from live_graph import (
    DEADLINE,
    DOMAINS,
    RELIABLE,
    ROOT,
    TOWEL,
    Graph,
    flat,
    frame,
    stamps,
    values,
)
from rclpy.parameter import Parameter
from recordings import beginning
from sensor_msgs.msg import PointCloud2, PointField
from std_srvs.srv import SetBool

from cloth_predict.config import load
from cloth_predict.errors import ConfigError
from cloth_predict.formats.bag import Recording, create_bag, read_recording, write_recording
from cloth_predict.formats.pointcloud import (
    SURFACE,
    UNLABELLED,
    decode,
    encode_markers,
    encode_surface,
    xyz,
)
from cloth_predict.nodes._ros import cloud, nanoseconds
from cloth_predict.nodes.ekf_node import EkfNode
from cloth_predict.nodes.mocap_replay_node import MocapReplayNode
from cloth_predict.nodes.projector_node import ProjectorNode
from cloth_predict.nodes.recorder import TOPICS
from cloth_predict.projection.pinhole import Pinhole
from cloth_predict.surface.topology import grid_triangles
from cloth_predict.tracker import Tracker
from cloth_predict.types import MarkerSequence


@pytest.fixture(scope='module')
def towel():
    """The first 0.6 s of the shipped recording."""
    return beginning(61).markers


@pytest.fixture(scope='module')
def towel_bag(towel, tmp_path_factory):
    path = tmp_path_factory.mktemp('bag') / 'towel'
    write_recording(path, Recording(towel))
    return path


# --- the whole graph

OF_FRAMES = TOPICS.keys() - {'diagnostics'}


@pytest.fixture(scope='module')
def run(towel, towel_bag):
    """All topics of one replay through the three nodes."""
    graph = Graph()
    try:
        for topic, kind in TOPICS.items():
            graph.listen(topic, kind)
        graph.start(EkfNode, **flat())
        graph.start(ProjectorNode, **flat())
        graph.until(lambda: graph.probe.count_publishers('projector/scanlines'))
        slowly = {'replay.rate': 0.5, 'replay.subscribers': 2}  # one thread does everything
        path = {'replay.path': str(towel_bag)}
        replay = graph.start(MocapReplayNode, **flat(**path, **slowly))
        graph.until(lambda: replay.finished)
        graph.until(lambda: all(len(graph.heard[topic]) >= len(towel) for topic in OF_FRAMES))
        graph.until(lambda: len(graph.heard['diagnostics']) >= 3)
        yield {topic: list(messages) for topic, messages in graph.heard.items()}
    finally:
        graph.close()


@pytest.mark.parametrize(
    ('topic', 'ahead'),
    [
        ('markers', 0),
        ('cloth/estimate', 0),
        ('cloth/prediction', 100_000_000),
        ('cloth/mesh', 100_000_000),
        ('projector/vertices', 100_000_000),
        ('projector/scanlines', 100_000_000),
    ],
)
def test_every_frame_comes_through_with_its_stamp(run, towel, topic, ahead):
    assert stamps(run[topic]) == (towel.stamps + ahead).tolist()


def test_clock_follows_the_stamps(run, towel):
    assert [nanoseconds(m.clock) for m in run['/clock']] == towel.stamps.tolist()


def test_replayed_markers_are_the_recorded_ones(run, towel):
    for k, message in enumerate(run['markers']):
        points = decode(message, ('x', 'y', 'z', 'id')).ravel()
        assert points['id'].tolist() == np.flatnonzero(towel.visible[k]).tolist()
        np.testing.assert_array_equal(xyz(points), towel.positions[k, towel.visible[k]])


def test_predictions_are_those_of_the_tracker(run, towel):
    tracker = Tracker(load(TOWEL))
    for k, stamp in enumerate(towel.stamps.tolist()):
        tracker.step(stamp, towel.positions[k], towel.visible[k])
        for topic, surface in (
            ('cloth/estimate', tracker.estimate()),
            ('cloth/prediction', tracker.predict(0.1)),
        ):
            expected = encode_surface(surface, 5, 4)
            np.testing.assert_array_equal(decode(run[topic][k], expected.dtype.names), expected)


def test_mesh_has_two_triangles_per_cell(run):
    mesh, points = run['cloth/mesh'][-1], decode(run['cloth/prediction'][-1], ('x', 'y', 'z'))
    corners = xyz(points)[grid_triangles(5, 4).ravel()]
    assert len(mesh.points) == 2 * 3 * 4 * 3
    found = [(p.x, p.y, p.z) for p in mesh.points]
    np.testing.assert_allclose(found, corners, atol=1e-6)  # float32 in the cloud, double here


def test_vertices_are_projected_where_their_line_is_lit(run):
    names = ('u', 'v', 's', 't', 'x', 'y', 'z', 'dt', 'flags', 'field')
    surface = decode(run['cloth/prediction'][-1], SURFACE.names)
    vertices = decode(run['projector/vertices'][-1], names)
    dt = vertices['dt'].astype(float)
    p, v, a = (
        np.stack([surface[f'{prefix}{axis}'] for axis in 'xyz'], -1).astype(float)
        for prefix in ('', 'v', 'a')
    )
    drawn = p + v * dt[..., None] + a * dt[..., None] ** 2 / 2
    np.testing.assert_allclose(xyz(vertices).reshape(5, 4, 3), drawn, atol=1e-6)  # float32
    pixels = Pinhole.from_config(load(TOWEL).projector).project(drawn)
    # 0.01 px: float32 at 1000 px resolves 6e-5, and 1e-6 m is 1e-3 px at 2 m
    np.testing.assert_allclose(vertices['u'], pixels[..., 0], atol=0.01)
    np.testing.assert_allclose(vertices['v'], pixels[..., 1], atol=0.01)
    # 1080 lines in 1/60 s, and the time of 0.01 line more
    np.testing.assert_allclose(dt, vertices['v'] / (60 * 1080), atol=2e-7)
    assert vertices['s'][0].tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert vertices['t'][:, 0].tolist() == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert not vertices['flags'].any()
    assert not vertices['field'].any()


def test_vertices_lie_on_the_line_between_the_key_lines_round_them(run):
    vertices = decode(run['projector/vertices'][-1], ('u', 'v')).ravel()
    scanlines = decode(run['projector/scanlines'][-1], ('u', 'v', 'dt', 'line'))
    lines = scanlines['line'][:, 0].astype(float)
    assert (lines[0], lines[-1]) == (0, 1079)
    for node in range(20):
        for axis in 'uv':
            there = np.interp(vertices['v'][node], lines, scanlines[axis][:, node])
            assert abs(there - vertices[axis][node]) < 0.1  # projector.max_row_error_px


def test_diagnostics_come_from_every_node(run):
    statuses = {m.status[0].name: m.status[0] for m in run['diagnostics']}
    assert set(statuses) == {'/ekf_node', '/projector_node', '/mocap_replay_node'}
    keys = {v.key for v in statuses['/ekf_node'].values}
    assert {'rate_hz', 'visible_markers', 'nis'} <= keys


# --- what the EKF node does with bad frames


@pytest.fixture
def ekf(graph):
    graph.listen('cloth/estimate', PointCloud2)
    graph.listen('diagnostics', DiagnosticArray)
    graph.start(EkfNode, **flat())
    publisher = graph.probe.create_publisher(PointCloud2, 'markers', RELIABLE)
    graph.until(lambda: publisher.get_subscription_count() == 1)
    return publisher


def messages(graph):
    return [message.status[0].message for message in graph.heard['diagnostics']]


def bad_frames(good):
    nan, huge = good.copy(), good.copy()
    nan[3, 1] = np.nan
    huge[3, 1] = np.inf
    other = frame(10**7, good)
    other.fields = [PointField(name='intensity', offset=0, datatype=7, count=1)]
    short = frame(10**7, good)
    short.data = array.array('B', bytes(10))
    return {
        'nan': frame(10**7, nan),
        'infinite': frame(10**7, huge),
        'wrong frame_id': frame(10**7, good, frame_id='map'),
        'id of no node': frame(10**7, good, ids=np.arange(5, 25)),
        'id twice': frame(10**7, good, ids=np.zeros(20)),
        'other fields': other,
        'too little data': short,
    }


def test_bad_frames_are_dropped_and_counted_and_the_next_good_one_is_used(graph, ekf, towel):
    good = towel.positions[0]
    bad = bad_frames(good)
    ekf.publish(frame(0, good))
    graph.until(lambda: len(graph.heard['cloth/estimate']) == 1)
    for message in bad.values():
        ekf.publish(message)
    ekf.publish(frame(2 * 10**7, good))
    graph.until(lambda: len(graph.heard['cloth/estimate']) == 2)
    graph.until(lambda: values(graph).get('bad_frames') == str(len(bad)))
    assert stamps(graph.heard['cloth/estimate']) == [0, 2 * 10**7]


def test_markers_beyond_the_model_are_one_line_that_names_both_sizes(graph, ekf, towel):
    for k in range(3):
        ekf.publish(frame(k, towel.positions[0], ids=np.arange(5, 25)))
    line = '3 bad (20 markers with ids up to 24 do not fit a model of 20 nodes)'
    graph.until(lambda: f'frames dropped: {line}' in messages(graph))


def test_repeated_and_late_stamps_are_dropped_a_jump_back_restarts(graph, ekf, towel):
    good, ms = towel.positions[0], 10**6
    sent = [1000, 1010, 1010, 1000, 1300, 1005, 0, 10]
    for stamp in sent:
        ekf.publish(frame(stamp * ms, good))
    used = [stamp * ms for stamp in (1000, 1010, 1300, 0, 10)]
    graph.until(lambda: len(graph.heard['cloth/estimate']) == len(used))
    graph.until(lambda: values(graph).get('late_frames') == '1')
    assert stamps(graph.heard['cloth/estimate']) == used
    found = values(graph)
    assert (found['duplicate_frames'], found['restarted_steps']) == ('2', '1')


def test_a_frame_that_is_a_little_late_is_put_in_its_place(graph, ekf, towel):
    for k in (0, 1, 3, 2, 4):
        seen = np.flatnonzero(towel.visible[k])
        ekf.publish(frame(int(towel.stamps[k]), towel.positions[k, seen], ids=seen))
    graph.until(lambda: values(graph).get('rewound_steps') == '1')
    tracker = Tracker(load(TOWEL))
    for k in range(5):
        tracker.step(int(towel.stamps[k]), towel.positions[k], towel.visible[k])
    heard = graph.heard['cloth/estimate']
    assert stamps(heard) == towel.stamps[[0, 1, 3, 3, 4]].tolist()
    expected = encode_surface(tracker.estimate(), 5, 4)
    np.testing.assert_array_equal(decode(heard[-1], expected.dtype.names), expected)


def test_diagnostics_warn_while_there_are_too_few_markers(graph, ekf, towel):
    ekf.publish(frame(0, towel.positions[0, 4:], ids=np.arange(4, 20)))  # no driven node
    graph.until(lambda: any('no surface yet' in message for message in messages(graph)))
    assert any('16 of 5 x 4' in message for message in messages(graph))
    assert graph.heard['cloth/estimate'] == []


def test_projector_drops_a_surface_of_another_size(graph, towel):
    graph.listen('projector/vertices', PointCloud2)
    graph.listen('diagnostics', DiagnosticArray)
    graph.start(ProjectorNode, **flat())
    publisher = graph.probe.create_publisher(PointCloud2, 'cloth/prediction', RELIABLE)
    graph.until(lambda: publisher.get_subscription_count() == 1)
    tracker = Tracker(load(TOWEL))
    tracker.step(0, towel.positions[0], towel.visible[0])
    points = encode_surface(tracker.estimate(), 5, 4)
    broken = points.copy()
    broken['vx'][2, 2] = np.nan
    for bad in (points.reshape(4, 5), points.ravel(), broken):
        publisher.publish(cloud(1, 'mocap', bad))
    publisher.publish(cloud(1, 'world', points))
    publisher.publish(cloud(2, 'mocap', points))
    graph.until(lambda: values(graph, '/projector_node').get('bad_frames') == '4')
    assert stamps(graph.heard['projector/vertices']) == [2]


# --- the replay node


def replay(graph, path, **parameters):
    graph.listen('markers', PointCloud2)
    return graph.start(
        MocapReplayNode, **flat(**{'replay.path': str(path), 'replay.rate': 5.0, **parameters})
    )


def test_replay_loops_and_its_stamps_jump_back(graph, towel, towel_bag):
    replay(graph, towel_bag, **{'replay.loop': True})
    graph.until(lambda: len(graph.heard['markers']) >= 130)
    expected = np.tile(towel.stamps, 3)[:130]
    assert stamps(graph.heard['markers'])[:130] == expected.tolist()


def test_replay_starts_at_an_offset(graph, towel, towel_bag):
    node = replay(graph, towel_bag, **{'replay.start': 0.25})
    graph.until(lambda: node.finished)
    assert stamps(graph.heard['markers']) == towel.stamps[25:].tolist()


def test_replay_drops_a_share_of_the_markers_and_delays_frames_in_order(graph, towel, towel_bag):
    node = replay(graph, towel_bag, **{'replay.drop': 0.5, 'replay.jitter': 0.004})
    graph.until(lambda: node.finished)
    assert stamps(graph.heard['markers']) == towel.stamps.tolist()
    share = sum(m.width for m in graph.heard['markers']) / towel.visible.sum()
    assert abs(share - 0.5) < 0.06  # 4 standard deviations of 1200 drops


def test_replay_pauses_and_resumes(graph, towel, towel_bag):
    node = replay(graph, towel_bag, **{'replay.rate': 0.5})
    client = graph.probe.create_client(SetBool, 'pause')
    graph.until(client.service_is_ready)
    graph.until(lambda: len(graph.heard['markers']) > 5)

    def call(pause):
        future = client.call_async(SetBool.Request(data=pause))
        graph.until(future.done)
        return future.result()

    assert call(True).message == 'paused'
    ends = time.monotonic() + 0.5
    graph.until(lambda: time.monotonic() > ends - 0.3)  # what was under way arrives
    at = len(graph.heard['markers'])
    graph.until(lambda: time.monotonic() > ends)
    assert len(graph.heard['markers']) == at < len(towel)
    assert call(False).message == 'running'
    graph.until(lambda: node.finished)
    assert stamps(graph.heard['markers']) == towel.stamps.tolist()


def test_replay_chooses_and_orders_markers_by_label(graph, towel, towel_bag):
    two = {'model.rows': 1, 'model.cols': 2, 'anchors.nodes': [0], 'wind.kind': 'none'}
    node = replay(graph, towel_bag, labels=['cloth:9', 'cloth:2'], **two)
    graph.until(lambda: node.finished)
    points = decode(graph.heard['markers'][0], ('x', 'y', 'z', 'id')).ravel()
    assert points['id'].tolist() == [0, 1]
    np.testing.assert_array_equal(xyz(points), towel.positions[0, [9, 2]])


def test_replay_marks_what_the_mocap_system_did_not_identify(graph, towel, tmp_path):
    labels = ('Unlabeled 7', *towel.labels[1:])
    mixed = MarkerSequence(towel.stamps[:5], labels, towel.positions[:5], towel.visible[:5])
    write_recording(tmp_path / 'mixed', Recording(mixed))
    node = replay(graph, tmp_path / 'mixed')
    graph.until(lambda: node.finished)
    points = decode(graph.heard['markers'][0], ('x', 'y', 'z', 'id')).ravel()
    assert points['id'].tolist() == [UNLABELLED, *range(1, 20)]


def test_replay_sends_what_was_not_identified_beside_the_nodes(graph, towel, tmp_path):
    labels = ('Unlabeled 7', *towel.labels[1:], 'Unlabeled 8', 'cloth:0')
    columns = [0, *range(1, 20), 3, 0]
    mixed = MarkerSequence(
        towel.stamps[:2], labels, towel.positions[:2, columns], towel.visible[:2, columns]
    )
    write_recording(tmp_path / 'mixed', Recording(mixed))
    node = replay(graph, tmp_path / 'mixed')
    graph.until(lambda: node.finished)
    points = decode(graph.heard['markers'][0], ('x', 'y', 'z', 'id')).ravel()
    # without the parameter labels the labelled markers are the nodes, in their order
    assert points['id'].tolist() == [*range(20), UNLABELLED, UNLABELLED]
    places = [*range(1, 20), 0, 0, 3]
    np.testing.assert_array_equal(xyz(points), towel.positions[0, places])


@pytest.mark.parametrize(
    ('parameters', 'words'),
    [
        ({'replay.path': 'nowhere'}, 'nowhere: no such file or folder'),
        ({'replay.start': 99.0}, 'replay.start'),
        ({'labels': [f'cloth:{k}' for k in range(1, 21)]}, "no marker 'cloth:20'"),
        ({'labels': ['cloth:1']}, 'labels: 1 labels, but .* 20 nodes'),
        ({'model.rows': 4}, '20 markers .* do not fit .* 4 x 4'),
        ({'frame': 'world'}, "in the frame 'mocap', but the parameter frame is 'world'"),
    ],
)
def test_replay_of_what_is_not_there_ends_at_the_start(graph, towel_bag, parameters, words):
    with pytest.raises(ValueError, match=words):
        replay(graph, towel_bag, **parameters)


def test_a_wrong_parameter_is_an_error_that_names_it(graph):
    with pytest.raises(ConfigError, match=r'model\.rws: unknown .*model\.rows'):
        graph.start(EkfNode, **{'model.rws': 4})
    with pytest.raises(ConfigError, match=r'filter\.process_noise: expected float'):
        graph.start(EkfNode, **{'filter.process_noise': 'much'})


# --- nodes as processes


def process(node, *parameters, config=TOWEL, domain=None):
    rules = [word for rule in parameters for word in ('-p', rule)]
    return subprocess.Popen(
        [sys.executable, '-m', f'cloth_predict.nodes.{node}', '--ros-args', '--params-file',
         str(config), *rules],
        cwd=ROOT,
        env=os.environ | {'ROS_DOMAIN_ID': str(domain or next(DOMAINS))},
        stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ('node', 'rule', 'words'),
    [
        ('ekf_node', 'model.colums:=4', 'model.colums: unknown parameter'),
        ('ekf_node', 'model.rows:=three', "model.rows: expected int, got 'three'"),
        ('ekf_node', 'ekf_node:model.rows:=2.5', 'model.rows: expected int, got 2.5'),
        ('ekf_node', 'anchors.nodes:=[a]', "anchors.nodes: expected int, got 'a'"),
        ('ekf_node', 'filter.max_step:=0.0', 'filter.max_step: 0.0 is out of range'),
        ('projector_node', 'projector.alpha:=-1.0', 'projector.alpha: -1.0 is out of range'),
        ('mocap_replay_node', 'replay.path:=nowhere.csv', 'nowhere.csv: no such file'),
    ],
)
def test_a_bad_configuration_stops_the_node_with_one_line(node, rule, words):
    _, errors = (running := process(node, rule)).communicate(timeout=DEADLINE)
    assert running.returncode == 1
    lines = errors.strip().splitlines()
    assert len(lines) == 1, errors
    assert words in lines[0]


def test_the_last_value_given_to_this_node_counts(graph):
    rules = ('model.rows:=0', 'projector_node:model.rows:=0', 'model.rows:=5')
    running = process('ekf_node', *rules, domain=graph.domain)
    try:
        graph.listen('diagnostics', DiagnosticArray)
        graph.until(lambda: values(graph))  # once it spins; before, rclpy is not quiet
        assert running.poll() is None
    finally:
        running.terminate()
        _, errors = running.communicate(timeout=DEADLINE)
    assert (running.returncode, errors) == (0, '')


def test_parameters_cannot_change_while_the_node_runs(graph):
    node = graph.start(EkfNode, **flat())
    (result,) = node.set_parameters([Parameter('horizon', value=-5.0)])
    assert not result.successful
    assert 'horizon' in result.reason


def test_a_parameter_file_that_is_not_there_stops_the_node():
    _, errors = (running := process('ekf_node', config='no.yaml')).communicate(timeout=DEADLINE)
    assert running.returncode == 1
    assert 'no.yaml' in errors
    assert 'Traceback' not in errors


@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_nodes_end_cleanly_on_a_signal(graph, sent):
    names = ('ekf_node', 'projector_node', 'mocap_replay_node')
    waiting = ('replay.subscribers:=9', 'replay.timeout:=99.0')
    running = [process(name, *waiting, domain=graph.domain) for name in names]
    graph.listen('diagnostics', DiagnosticArray)
    try:
        graph.until(lambda: all(values(graph, f'/{name}') for name in names))  # they spin
        for one in running:
            one.send_signal(sent)
        for one in running:
            _, errors = one.communicate(timeout=DEADLINE)
            assert one.returncode == 0, errors
            assert 'Traceback' not in errors
    finally:
        for one in running:
            one.kill()


def python(code):
    return subprocess.Popen(
        [sys.executable, '-c', code], cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.PIPE,
        env=os.environ | {'ROS_DOMAIN_ID': str(next(DOMAINS))}, text=True,
    )  # fmt: skip


def test_an_interrupt_while_a_node_is_imported_is_quiet():
    running = python('from cloth_predict.nodes.start import ekf_node; ekf_node()')
    maps = Path(f'/proc/{running.pid}/maps')
    deadline = time.monotonic() + DEADLINE
    # numpy comes before rclpy; where the node is faster than this loop it ends as by any Ctrl-C
    while 'numpy' not in maps.read_text():
        assert time.monotonic() < deadline
    running.send_signal(signal.SIGINT)
    _, errors = running.communicate(timeout=DEADLINE)
    assert running.returncode in (-signal.SIGINT, 0)
    assert errors == ''


def test_a_node_ends_on_a_signal_in_the_middle_of_a_long_call():
    code = """
import time
from cloth_predict.nodes import _ros
_ros.SHUTDOWN_LIMIT = 0.5
def forever():
    print('running', flush=True)
    while True:
        time.sleep(60)
_ros.run(forever)
"""
    running = python(code)
    try:
        assert running.stdout.readline() == 'running\n'
        running.terminate()
        _, errors = running.communicate(timeout=DEADLINE)
        assert (running.returncode, errors) == (0, '')
    finally:
        running.kill()


def test_markers_can_be_sent_from_a_bag_written_by_hand(tmp_path, towel):
    """The codec that the replay uses writes what the EKF node reads."""
    with create_bag(tmp_path / 'bag') as bag:
        points = encode_markers(towel.positions[0], towel.visible[0], towel.unlabelled)
        bag.cloud('/markers', 5, 'mocap', points)
    again = read_recording(tmp_path / 'bag').markers
    np.testing.assert_array_equal(again.positions[0], towel.positions[0])
