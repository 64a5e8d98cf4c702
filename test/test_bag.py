"""Bags: others read what is written, what others wrote is read, a broken bag is one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cloth_predict.config import parse_yaml
from cloth_predict.errors import FormatError
from cloth_predict.formats.bag import (
    CLOUD,
    Recording,
    Truth,
    cloud_message,
    create_bag,
    read_clouds,
    read_recording,
    write_recording,
)
from cloth_predict.formats.pointcloud import MARKERS, TRACKS, UNLABELLED
from cloth_predict.formats.recording import read
from cloth_predict.types import MarkerSequence

TYPES = get_typestore(Stores.ROS2_JAZZY)
LABELS = ('a', 'Unlabeled 7', 'b', 'c', 'unlabelled:2', 'd')
STAMPS = (0, 10_000_000, 20_000_001, 1_700_000_000_123_456_789)


def sequence(
    stamps: tuple[int, ...] = STAMPS,
    labels: tuple[str, ...] = LABELS,
    seed: int = 0,
    missing: float = 0.3,
) -> MarkerSequence:
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(len(stamps), len(labels), 3))
    visible = rng.random(positions.shape[:2]) >= missing
    visible[0] = True
    positions[~visible] = np.nan
    return MarkerSequence(np.array(stamps, np.int64), labels, positions, visible, 'world')


def with_truth(markers: MarkerSequence) -> Recording:
    """Put the markers, in reverse, on every second node of one row more than they need."""
    count = len(markers.labels)
    ids = np.full((2, count), -1)
    ids[0] = np.arange(count)[::-1]
    surface = np.random.default_rng(9).normal(size=(len(markers), *ids.shape, 3))
    return Recording(markers, Truth(markers.stamps, surface, ids))


def write(path: Path, markers: MarkerSequence | None = None) -> Path:
    write_recording(path, Recording(markers or sequence()))
    return path


def same(found: MarkerSequence, expected: MarkerSequence) -> None:
    """Compare exactly, but for the positions being float32 in a bag."""
    assert found.stamps.tolist() == expected.stamps.tolist()
    assert found.frame_id == expected.frame_id
    np.testing.assert_array_equal(found.visible, expected.visible)
    np.testing.assert_array_equal(found.positions, np.float32(expected.positions))


def foreign(
    path: Path,
    messages: list[tuple[int, Any]],
    topic: str = '/markers',
    msgtype: str = CLOUD,
    plugin: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """Write a bag as another program would: no compression, no labels, the times as given."""
    with Writer(path, version=8, storage_plugin=plugin) as writer:
        connection = writer.add_connection(topic, msgtype, typestore=TYPES)
        for time, message in messages:
            writer.write(connection, time, TYPES.serialize_cdr(message, msgtype))
    return path


def cloud(*rows: tuple[float, ...], stamp: int = 0, kind: Any = MARKERS) -> Any:
    return cloud_message(stamp, 'camera', np.array(list(rows), kind))


def failure(path: Path, call: Callable[[Path], object] = read_recording) -> str:
    """Return what the error says behind the path; it has to be one line that begins with it."""
    with pytest.raises(FormatError) as caught:
        call(path)
    message = str(caught.value)
    assert message.startswith(f'{path}: ')
    assert '\n' not in message
    return message.removeprefix(f'{path}: ')


# --- there and back --------------------------------------------------------------------------


@pytest.mark.parametrize(
    'labels', [LABELS, ('a',), ('x', 'y'), ('Unlabeled 1',), ('ä b', '', '"')]
)
@pytest.mark.parametrize('missing', [0.0, 0.5])
def test_markers_come_back(tmp_path: Path, labels: tuple[str, ...], missing: float) -> None:
    markers = sequence(labels=labels, missing=missing)
    recording = read_recording(write(tmp_path / 'x', markers))
    assert recording.truth is None
    assert recording.markers.labels == labels
    same(recording.markers, markers)


def test_a_marker_that_is_never_seen_keeps_its_column(tmp_path: Path) -> None:
    markers = sequence(missing=1.0, labels=('a', 'b', 'c'))
    visible = markers.visible.copy()
    visible[0] = [False, True, False]
    hidden = MarkerSequence(markers.stamps, markers.labels, markers.positions, visible)
    found = read_recording(write(tmp_path / 'x', hidden)).markers
    assert found.labels == ('a', 'b', 'c')
    np.testing.assert_array_equal(found.visible, visible)
    assert np.isnan(found.positions[~visible]).all()
    np.testing.assert_array_equal(found.positions[0, 1], np.float32(markers.positions[0, 1]))


def test_truth_comes_back(tmp_path: Path) -> None:
    recording = with_truth(sequence())
    write_recording(tmp_path / 'x', recording)
    found = read_recording(tmp_path / 'x')
    same(found.markers, recording.markers)
    assert found.truth is not None
    assert recording.truth is not None
    assert found.truth.stamps.tolist() == list(STAMPS)
    np.testing.assert_array_equal(found.truth.ids, recording.truth.ids)
    np.testing.assert_array_equal(found.truth.surface, np.float32(recording.truth.surface))


def test_true_markers_are_those_of_the_ids() -> None:
    recording = with_truth(sequence())
    assert recording.truth is not None
    true = recording.truth.markers(recording.markers)
    assert true.labels == LABELS
    assert true.visible.all()
    np.testing.assert_array_equal(true.positions, recording.truth.surface[:, 0, ::-1])


def test_stamps_that_repeat(tmp_path: Path) -> None:
    markers = sequence(stamps=(5, 5, 5, 7, 7))
    same(read_recording(write(tmp_path / 'x', markers)).markers, markers)


def test_stamps_that_run_backwards_are_stored_in_order_of_time(tmp_path: Path) -> None:
    markers = sequence(stamps=(30, 10, 20, 20))
    order = [1, 2, 3, 0]
    expected = MarkerSequence(
        markers.stamps[order], LABELS, markers.positions[order], markers.visible[order], 'world'
    )
    same(read_recording(write(tmp_path / 'x', markers)).markers, expected)


def test_many_chunks(tmp_path: Path) -> None:
    stamps = tuple(range(0, 30_000, 10))
    markers = sequence(stamps, tuple(f'm{i}' for i in range(40)))
    write(tmp_path / 'x', markers)
    with (tmp_path / 'x' / 'bag.mcap').open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) > 1
    same(read_recording(tmp_path / 'x').markers, markers)


def test_the_file_alone_has_all_but_the_labels(tmp_path: Path) -> None:
    markers = sequence()
    found = read_recording(write(tmp_path / 'x', markers) / 'bag.mcap').markers
    same(found, markers)
    assert len(set(found.labels)) == len(LABELS)


# --- others read what is written -------------------------------------------------------------


def decoded(path: Path) -> list[tuple[Any, Any, Any, Any]]:
    """Schema, channel, message and decoded message of every message, in order of the file."""
    with path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return list(reader.iter_decoded_messages(log_time_order=False))


def test_mcap_reads_it(tmp_path: Path) -> None:
    recording = with_truth(sequence())
    write_recording(tmp_path / 'x', recording)
    messages = decoded(tmp_path / 'x' / 'bag.mcap')
    assert [channel.topic for _, channel, _, _ in messages] == ['/markers'] * 4 + ['/truth'] * 4
    for k, (schema, channel, message, content) in enumerate(messages):
        assert (schema.name, schema.encoding) == (CLOUD, 'ros2msg')
        assert channel.message_encoding == 'cdr'
        stamp = content.header.stamp.sec * 10**9 + content.header.stamp.nanosec
        assert message.log_time == message.publish_time == stamp == STAMPS[k % 4]
        assert content.header.frame_id == 'world'
        assert content.is_bigendian is False
        assert content.is_dense is True
        layout = TRACKS if channel.topic == '/markers' else MARKERS
        assert tuple(field.name for field in content.fields) == layout.names
    for k, (_, _, _, content) in enumerate(messages[:4]):
        points = np.frombuffer(content.data, TRACKS)
        seen = np.flatnonzero(recording.markers.visible[k])
        assert (content.height, content.width) == (1, len(seen))
        assert points['track'].tolist() == seen.tolist()
        assert points['id'].tolist() == [UNLABELLED if i in (1, 4) else i for i in seen]
        np.testing.assert_array_equal(
            points['x'], np.float32(recording.markers.positions[k, seen, 0])
        )
    assert (messages[4][3].height, messages[4][3].width) == (2, 6)


def test_the_file_is_of_profile_ros2_in_zstd_chunks(tmp_path: Path) -> None:
    with (write(tmp_path / 'x') / 'bag.mcap').open('rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert {index.compression for index in summary.chunk_indexes} == {'zstd'}
    assert summary.statistics.message_count == 4
    assert summary.statistics.message_start_time == STAMPS[0]
    assert summary.statistics.message_end_time == STAMPS[-1]


def test_clouds_without_unlabelled_columns_have_no_track(tmp_path: Path) -> None:
    write(tmp_path / 'x', sequence(labels=('a', 'b')))
    content = decoded(tmp_path / 'x' / 'bag.mcap')[0][3]
    assert [field.name for field in content.fields] == ['x', 'y', 'z', 'id']
    assert (content.point_step, content.row_step, len(content.data)) == (16, 32, 32)


def test_metadata_is_that_of_rosbag2(tmp_path: Path) -> None:
    write(tmp_path / 'x')
    information = parse_yaml((tmp_path / 'x' / 'metadata.yaml').read_text())
    bag = information['rosbag2_bagfile_information']
    assert bag['version'] == 9
    assert bag['storage_identifier'] == 'mcap'
    assert bag['relative_file_paths'] == ['bag.mcap']
    assert bag['message_count'] == 4
    assert bag['starting_time'] == {'nanoseconds_since_epoch': 0}
    assert bag['duration'] == {'nanoseconds': STAMPS[-1]}
    assert json.loads(bag['custom_data']['cloth_predict']) == {'labels': list(LABELS)}
    (topic,) = bag['topics_with_message_count']
    assert topic['message_count'] == 4
    assert topic['topic_metadata']['type'] == CLOUD
    assert topic['topic_metadata']['type_description_hash'].startswith('RIHS01_9198cabf7da3796a')
    assert sorted(file.name for file in (tmp_path / 'x').iterdir()) == [
        'bag.mcap',
        'metadata.yaml',
    ]


def test_rosbags_reads_it(tmp_path: Path) -> None:
    write(tmp_path / 'x')
    with Reader(tmp_path / 'x') as reader:
        assert [c.topic for c in reader.connections] == ['/markers']
        assert (reader.start_time, reader.end_time) == (STAMPS[0], STAMPS[-1] + 1)
        assert reader.message_count == 4
    with AnyReader([tmp_path / 'x']) as any_reader:
        for k, (connection, time, data) in enumerate(any_reader.messages()):
            message = any_reader.deserialize(data, connection.msgtype)
            assert time == STAMPS[k]
            assert message.header.frame_id == 'world'
            assert message.width == np.count_nonzero(sequence().visible[k])


def test_the_same_content_is_the_same_bytes(tmp_path: Path) -> None:
    for name in ('one', 'another/place'):
        write_recording(tmp_path / name, with_truth(sequence()))
    write(tmp_path / 'third', sequence(seed=1))
    one, two, other = (tmp_path / name for name in ('one', 'another/place', 'third'))
    for file in ('bag.mcap', 'metadata.yaml'):
        assert (one / file).read_bytes() == (two / file).read_bytes()
    assert (one / 'bag.mcap').read_bytes() != (other / 'bag.mcap').read_bytes()


def test_raw_messages_are_stored_as_they_came(tmp_path: Path) -> None:
    data = bytes(TYPES.serialize_cdr(cloud((1, 2, 3, 0), stamp=7), CLOUD))
    with create_bag(tmp_path / 'x') as bag:
        bag.raw('/somewhere', CLOUD, 99, data)
    with Reader(tmp_path / 'x') as reader:
        assert [(time, bytes(found)) for _, time, found in reader.messages()] == [(99, data)]
    ((stamp, message),) = read_clouds(tmp_path / 'x', 'somewhere')
    assert (stamp, message.header.frame_id) == (7, 'camera')


# --- what others wrote is read ---------------------------------------------------------------


@pytest.mark.parametrize('plugin', list(StoragePlugin))
def test_a_foreign_bag_gets_labels_by_number(tmp_path: Path, plugin: StoragePlugin) -> None:
    first = cloud((1, 1, 1, 2), (3, 3, 3, 0), stamp=10**9)
    second = cloud((2, 2, 2, 3), (4, 4, 4, 2), stamp=2 * 10**9)
    path = foreign(tmp_path / 'x', [(10, first), (20, second)], plugin=plugin)
    markers = read_recording(path).markers
    assert markers.labels == ('marker0', 'marker1', 'marker2', 'marker3')
    assert markers.stamps.tolist() == [10**9, 2 * 10**9]  # of the header, not of the recorder
    assert markers.visible.tolist() == [[True, False, True, False], [False, False, True, True]]
    assert markers.positions[0, 0].tolist() == [3, 3, 3]
    assert markers.positions[1, 2].tolist() == [4, 4, 4]
    assert markers.frame_id == 'camera'
    file = path / {StoragePlugin.MCAP: 'x.mcap', StoragePlugin.SQLITE3: 'x.db3'}[plugin]
    same(read_recording(file).markers, markers)


def test_foreign_points_without_labels_get_columns_of_their_own(tmp_path: Path) -> None:
    first = cloud((1, 1, 1, 0), (5, 5, 5, UNLABELLED))
    second = cloud((7, 7, 7, UNLABELLED), (2, 2, 2, 1), (8, 8, 8, UNLABELLED), stamp=1)
    markers = read_recording(foreign(tmp_path / 'x', [(0, first), (1, second)])).markers
    assert markers.labels == ('marker0', 'marker1', 'Unlabeled 0', 'Unlabeled 1')
    assert markers.unlabelled.tolist() == [False, False, True, True]
    assert markers.visible.tolist() == [[True, False, True, False], [False, True, True, True]]
    assert markers.positions[:, 2, 0].tolist() == [5, 7]
    assert markers.positions[1, 3].tolist() == [8, 8, 8]


def test_stamps_of_the_header_stay_as_recorded(tmp_path: Path) -> None:
    stamps = [50, 50, 30, 3 * 10**9, 40]
    messages = [(k, cloud((k, 0, 0, 0), stamp=stamp)) for k, stamp in enumerate(stamps)]
    markers = read_recording(foreign(tmp_path / 'x', messages)).markers
    assert markers.stamps.tolist() == stamps
    assert markers.positions[:, 0, 0].tolist() == [0, 1, 2, 3, 4]


def test_foreign_fields_and_precision(tmp_path: Path) -> None:
    kind = [('t', 'u2'), ('id', 'u4'), ('z', 'f8'), ('y', 'f8'), ('x', 'f8')]
    path = foreign(tmp_path / 'x', [(0, cloud((9, 0, 0.3, 0.2, 0.1), kind=kind))])
    assert read_recording(path).markers.positions.tolist() == [[[0.1, 0.2, 0.3]]]


def test_a_cloud_without_points_is_a_frame(tmp_path: Path) -> None:
    nothing = cloud_message(5, 'camera', np.zeros(0, MARKERS))
    path = foreign(tmp_path / 'x', [(0, cloud((1, 2, 3, 0))), (1, nothing)])
    markers = read_recording(path).markers
    assert markers.stamps.tolist() == [0, 5]
    assert markers.visible.tolist() == [[True], [False]]


def test_another_topic(tmp_path: Path) -> None:
    path = foreign(tmp_path / 'x', [(0, cloud((1, 2, 3, 0)))], topic='/mocap/points')
    assert read_recording(path, 'mocap/points').markers.positions.tolist() == [[[1, 2, 3]]]
    assert failure(path) == 'no topic markers (topics: /mocap/points)'


# --- what is refused -------------------------------------------------------------------------


def test_nothing_is_there(tmp_path: Path) -> None:
    assert failure(tmp_path / 'x') == 'no bag is there'
    assert failure(tmp_path / 'x', read) == 'no such file or folder'
    assert failure(tmp_path / 'x.mcap') == 'no bag is there'
    assert failure(tmp_path / 'x.mcap', read) == 'no such file or folder'
    assert failure(tmp_path) == failure(tmp_path, read) == 'no bag is there'


def test_a_name_too_long_for_any_file(tmp_path: Path) -> None:
    for call in (read_recording, read, write):
        assert failure(tmp_path / ('x' * 300), call)


@pytest.mark.parametrize('name', ['x.txt', 'x', 'x.MCAP', 'x.bag', 'x.yaml'])
def test_a_file_of_an_unknown_kind(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b'abc')
    assert failure(tmp_path / name)
    assert failure(tmp_path / name, read).startswith('neither a bag (folder, .mcap, .db3) nor')


@pytest.mark.parametrize(
    'content', [b'', b'\n', b'Format Version,1.23\n', b'\x89MCAP0\r\n', b'\0' * 99]
)
@pytest.mark.parametrize('suffix', ['.mcap', '.db3'])
def test_a_file_with_another_content(tmp_path: Path, content: bytes, suffix: str) -> None:
    file = tmp_path / f'x{suffix}'
    file.write_bytes(content)
    for call in (read_recording, read):
        assert failure(file, call).startswith('not a readable rosbag2 recording: ')


@pytest.fixture(scope='module')
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small bag of both topics, whose files are damaged in copies only."""
    path = tmp_path_factory.mktemp('good') / 'x'
    write_recording(path, with_truth(sequence()))
    return path


@pytest.fixture(scope='module')
def damaged(tmp_path_factory: pytest.TempPathFactory, good: Path) -> Path:
    """A copy of the good bag to write into."""
    path = tmp_path_factory.mktemp('damaged') / 'x'
    shutil.copytree(good, path)
    return path


@pytest.mark.parametrize(
    'keep', [0, 1, 7, 8, 9, 20, 36, 37, 0.1, 0.3, 0.5, 0.7, 0.9, -37, -9, -8, -1]
)
def test_a_file_cut_short(good: Path, damaged: Path, keep: float) -> None:
    content = (good / 'bag.mcap').read_bytes()
    count = int(keep * len(content)) if isinstance(keep, float) else keep
    (damaged / 'bag.mcap').write_bytes(content[:count])
    for path in (damaged, damaged / 'bag.mcap'):
        assert failure(path).startswith('not a readable rosbag2 recording: ')


def outcome(path: Path) -> str:
    """Read a file that may be damaged: its error, or the path; another exception is a failure."""
    try:
        read_recording(path)
    except FormatError as error:
        return str(error)
    return f'{path}: '


def readable_or_one_line(path: Path) -> None:
    message = outcome(path)
    assert message.startswith(f'{path}: ')
    assert '\n' not in message


fuzzed = settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    database=None,
)
changes = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=6)


def changed(content: bytes, at: list[tuple[float, int]]) -> bytes:
    data = bytearray(content)
    for place, value in at:
        data[int(place * len(data))] = value
    return bytes(data)


@fuzzed
@given(at=changes)
def test_bytes_of_the_file_that_changed(
    good: Path, damaged: Path, at: list[tuple[float, int]]
) -> None:
    (damaged / 'bag.mcap').write_bytes(changed((good / 'bag.mcap').read_bytes(), at))
    readable_or_one_line(damaged)
    readable_or_one_line(damaged / 'bag.mcap')


@fuzzed
@given(at=changes)
def test_bytes_that_changed_in_a_file_without_compression(
    plain: Path, damaged: Path, at: list[tuple[float, int]]
) -> None:
    (damaged / 'bag.mcap').write_bytes(changed((plain / 'x.mcap').read_bytes(), at))
    readable_or_one_line(damaged / 'bag.mcap')


@pytest.fixture(scope='module')
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    messages = [(k, cloud((k, 2, 3, 0), (4, 5, 6, 1), stamp=k)) for k in range(3)]
    return foreign(tmp_path_factory.mktemp('plain') / 'x', messages)


@fuzzed
@given(at=changes)
def test_bytes_of_the_metadata_that_changed(good: Path, at: list[tuple[float, int]]) -> None:
    path = good.parent / 'metadata'
    shutil.copytree(good, path, dirs_exist_ok=True)
    (path / 'metadata.yaml').write_bytes(changed((good / 'metadata.yaml').read_bytes(), at))
    readable_or_one_line(path)


@pytest.mark.parametrize(
    'text', ['', '{', 'word', '[]', '\t', 'rosbag2_bagfile_information: 3', 'a: 1', '\0']
)
def test_metadata_of_something_else(tmp_path: Path, text: str) -> None:
    write(tmp_path / 'x')
    (tmp_path / 'x' / 'metadata.yaml').write_text(text)
    assert failure(tmp_path / 'x').startswith('not a readable rosbag2 recording: ')


def test_parts_of_a_bag_that_are_missing(tmp_path: Path) -> None:
    write(tmp_path / 'x')
    (tmp_path / 'x' / 'bag.mcap').rename(tmp_path / 'bag.mcap')
    assert failure(tmp_path / 'x').startswith('not a readable rosbag2 recording: ')
    (tmp_path / 'bag.mcap').rename(tmp_path / 'x' / 'bag.mcap')
    (tmp_path / 'x' / 'metadata.yaml').unlink()
    assert failure(tmp_path / 'x') == 'no bag is there'


@pytest.mark.parametrize('key', ['version', 'storage_identifier', 'relative_file_paths'])
def test_metadata_without_a_key(tmp_path: Path, key: str) -> None:
    file = write(tmp_path / 'x') / 'metadata.yaml'
    file.write_text(file.read_text().replace(f'{key}:', 'other:'))
    assert failure(tmp_path / 'x').startswith('not a readable rosbag2 recording: ')


@pytest.mark.parametrize(
    'labels',
    [
        'soon',
        '{"labels": 3}',
        '{"labels": [1, 2]}',
        '{"labels": [["a"]]}',
        '{"labels": ["a", "a"]}',
    ],
)
def test_metadata_whose_labels_are_none(tmp_path: Path, labels: str) -> None:
    with Writer(tmp_path / 'x', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.set_custom_data('cloth_predict', labels)
        connection = writer.add_connection('/markers', CLOUD, typestore=TYPES)
        writer.write(connection, 0, TYPES.serialize_cdr(cloud((1, 2, 3, 0)), CLOUD))
    assert failure(tmp_path / 'x')


def test_no_topic_of_markers(tmp_path: Path) -> None:
    with create_bag(tmp_path / 'none'):
        pass
    assert failure(tmp_path / 'none') == 'no topic markers (topics: none)'
    with create_bag(tmp_path / 'two') as bag:
        bag.cloud('/b', 0, 'f', np.zeros(1, MARKERS))
        bag.cloud('/a', 0, 'f', np.zeros(1, MARKERS))
    assert failure(tmp_path / 'two') == 'no topic markers (topics: /a, /b)'
    assert failure(tmp_path / 'two', lambda path: read_clouds(path, 'c')).startswith('no topic c ')


def test_a_topic_without_messages(tmp_path: Path) -> None:
    assert failure(foreign(tmp_path / 'x', [])) == 'the topic markers has no messages'


def test_a_topic_of_another_type(tmp_path: Path) -> None:
    text = TYPES.types['std_msgs/msg/String']('hello')
    path = foreign(tmp_path / 'x', [(0, text)], msgtype='std_msgs/msg/String')
    assert failure(path) == f'topic /markers holds std_msgs/msg/String, expected {CLOUD}'


@pytest.mark.parametrize('wrong', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('axis', [0, 1, 2])
def test_a_coordinate_that_is_not_finite(tmp_path: Path, wrong: float, axis: int) -> None:
    bad = [1.0, 2.0, 3.0]
    bad[axis] = wrong
    with create_bag(tmp_path / 'x', ('a', 'b', 'c')) as bag:
        bag.message('/markers', CLOUD, 0, cloud((1, 2, 3, 0), (1, 2, 3, 2)))
        bag.message('/markers', CLOUD, 1, cloud((1, 2, 3, 0), (*bad, 2)))
    expected = 'markers: message 1: c has a coordinate that is not finite'
    assert failure(tmp_path / 'x') == expected
    assert failure(foreign(tmp_path / 'y', [(0, cloud((*bad, 7)))])) == (
        'markers: message 0: marker7 has a coordinate that is not finite'
    )


THREE = [('x', 'f4'), ('y', 'f4'), ('z', 'f4')]


@pytest.mark.parametrize(
    ('rows', 'kind', 'expected'),
    [
        ([(1, 2, 3)], THREE, "the cloud has no field 'id' (fields: x, y, z)"),
        ([(1, 2)], [('x', 'f4'), ('id', 'u4')], "the cloud has no field 'y' (fields: x, id)"),
        ([(1, 2, 3, 4097)], MARKERS, 'marker id 4097 is above 4096'),
        ([(1, 2, 3, 2**32 - 2)], MARKERS, 'marker id 4294967294 is above 4096'),
        ([(1, 2, 3, 5), (4, 5, 6, 5)], MARKERS, 'a marker id is there twice'),
        ([(1, 2, 3, UNLABELLED, 5)] * 2, TRACKS, 'a marker id is there twice'),
        ([(1, 2, 3, -2)], [*THREE, ('id', 'i4')], ''),
        ([(1, 2, 3, -300), (1, 2, 3, 0)], [*THREE, ('id', 'i2')], ''),
        ([(1, 2, 3, 0.5)], [*THREE, ('id', 'f4')], ''),
    ],
)
def test_a_cloud_of_something_else(
    tmp_path: Path, rows: list[tuple[float, ...]], kind: Any, expected: str
) -> None:
    path = foreign(tmp_path / 'x', [(0, cloud((1, 2, 3, 0))), (1, cloud(*rows, kind=kind))])
    assert failure(path).startswith(f'markers: message 1: {expected}')


def test_a_cloud_whose_sizes_lie(tmp_path: Path) -> None:
    for name, value in (('width', 10**6), ('row_step', 4), ('height', 10**9), ('point_step', 3)):
        lie = cloud((1, 2, 3, 0))
        setattr(lie, name, value)
        expected = 'markers: message 0: the sizes of the cloud do not fit its data'
        assert failure(foreign(tmp_path / name, [(0, lie)])) == expected


def test_a_field_that_is_there_twice(tmp_path: Path) -> None:
    double = cloud((1, 2, 3, 0))
    double.fields.append(double.fields[1])
    assert failure(foreign(tmp_path / 'x', [(0, double)])).startswith('markers: message 0: ')


def test_no_markers_in_any_message(tmp_path: Path) -> None:
    nothing = cloud_message(0, 'camera', np.zeros(0, MARKERS))
    path = foreign(tmp_path / 'x', [(0, nothing), (1, nothing)])
    assert failure(path) == 'markers: no markers in any message'


@pytest.mark.parametrize(
    ('grids', 'expected'),
    [
        ([np.zeros((2, 2), THREE)], "the cloud has no field 'id' (fields: x, y, z)"),
        ([np.zeros((2, 2), MARKERS), np.zeros((2, 3), MARKERS)], 'the surface changes its size'),
        ([np.zeros((2, 2), MARKERS)], 'not every marker is on the surface'),
    ],
)
def test_a_truth_that_does_not_fit(tmp_path: Path, grids: list[Any], expected: str) -> None:
    with create_bag(tmp_path / 'x', ('a', 'b')) as bag:
        bag.message('/markers', CLOUD, 0, cloud((1, 2, 3, 0), (1, 2, 3, 1)))
        for k, grid in enumerate(grids):
            bag.cloud('/truth', k, 'f', grid)
    assert failure(tmp_path / 'x') == f'truth: {expected}'


# --- writing ---------------------------------------------------------------------------------


def content_of(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob('*') if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_an_own_bag_is_replaced(tmp_path: Path) -> None:
    write_recording(tmp_path / 'x', with_truth(sequence()))
    write(tmp_path / 'x', sequence(labels=('p', 'q'), seed=3))
    write(tmp_path / 'y', sequence(labels=('p', 'q'), seed=3))
    assert content_of(tmp_path / 'x') == content_of(tmp_path / 'y')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['x', 'y']


@pytest.mark.parametrize('kind', ['folder', 'foreign bag', 'file', 'mcap'])
def test_what_others_made_is_not_overwritten(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ('x.mcap' if kind == 'mcap' else 'x')
    if kind == 'foreign bag':
        foreign(path, [(0, cloud((1, 2, 3, 0)))])
    elif kind == 'mcap':
        shutil.copy(write(tmp_path / 'own') / 'bag.mcap', path)
    elif kind == 'file':
        path.write_text('precious')
    else:
        path.mkdir()
        (path / 'notes.txt').write_text('precious')
        (path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {}')
    before = content_of(tmp_path)
    expected = 'exists and was not made by cloth-predict; not overwritten'
    assert failure(path, write) == expected
    assert content_of(tmp_path) == before
    assert path.is_dir() == (kind in ('folder', 'foreign bag'))


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / 'x').mkdir()
    write(tmp_path / 'x', sequence())
    write(tmp_path / 'y', sequence())
    assert content_of(tmp_path / 'x') == content_of(tmp_path / 'y')


def test_one_message_in_another_frame(tmp_path: Path) -> None:
    other = cloud((1, 2, 3, 0), stamp=1)
    other.header.frame_id = 'world'
    foreign(tmp_path / 'x', [(0, cloud((1, 2, 3, 0))), (1, other)])
    expected = "markers: message 1 is in the frame 'world', those before in 'camera'"
    assert failure(tmp_path / 'x') == expected


@pytest.mark.parametrize('reason', [RuntimeError, KeyboardInterrupt, FormatError])
@pytest.mark.parametrize('before', [True, False])
def test_a_failed_write_leaves_what_was_there(
    tmp_path: Path, reason: type[BaseException], before: bool
) -> None:
    if before:
        write(tmp_path / 'x')
    old = content_of(tmp_path)

    def fail() -> None:
        with create_bag(tmp_path / 'x') as bag:
            bag.cloud('/markers', 0, 'f', np.zeros(1, MARKERS))
            raise reason('stop')

    with pytest.raises(reason, match='stop'):
        fail()
    assert content_of(tmp_path) == old
    assert [path.name for path in tmp_path.iterdir()] == (['x'] if before else [])


def test_a_bag_appears_when_it_is_complete(tmp_path: Path) -> None:
    with create_bag(tmp_path / 'x') as bag:
        bag.cloud('/markers', 0, 'f', np.zeros(1, MARKERS))
        assert not (tmp_path / 'x').exists()
    assert len(read_recording(tmp_path / 'x').markers) == 1
    assert [path.name for path in tmp_path.iterdir()] == ['x']


def test_what_a_killed_writer_left_is_no_obstacle(tmp_path: Path) -> None:
    with create_bag(tmp_path / 'x'):
        (partial,) = tmp_path.iterdir()
        shutil.copytree(partial, tmp_path / 'kept')
    (tmp_path / 'kept').rename(partial)
    write(tmp_path / 'x')
    assert [path.name for path in tmp_path.iterdir()] == ['x']
    same(read_recording(tmp_path / 'x').markers, sequence())


def test_folders_on_the_way_are_made(tmp_path: Path) -> None:
    same(read_recording(write(tmp_path / 'a' / 'b' / 'x')).markers, sequence())
    assert [path.name for path in (tmp_path / 'a' / 'b').iterdir()] == ['x']


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('precious')
    path = tmp_path / 'file' / 'x'
    assert failure(path, write) == 'cannot be written: Not a directory'
    assert content_of(tmp_path) == {'file': b'precious'}


@pytest.mark.parametrize('stamp', [-1, -(10**9), 2**31 * 10**9, 2**62])
def test_a_stamp_that_ros_cannot_hold(tmp_path: Path, stamp: int) -> None:
    markers = sequence(stamps=(stamp,))
    assert failure(tmp_path / 'x', lambda path: write(path, markers))
    assert list(tmp_path.iterdir()) == []


def test_the_last_stamp_that_ros_can_hold(tmp_path: Path) -> None:
    markers = sequence(stamps=(0, 2**31 * 10**9 - 1))
    same(read_recording(write(tmp_path / 'x', markers)).markers, markers)
