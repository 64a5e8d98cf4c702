"""Encoded recordings: the bound, the file, other machines, faults, and both commands."""

import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_smoothing import SHEET, swinging

from cloth_predict.cli import main
from cloth_predict.config import build, load
from cloth_predict.encoding import container
from cloth_predict.encoding.container import ENCODING, FRAMES, create_encoded, read_encoded
from cloth_predict.encoding.decode import read_markers
from cloth_predict.encoding.encode import BLOCK, step_of, write_encoded
from cloth_predict.encoding.numbers import (
    packed,
    packed_residual,
    packed_stamps,
    unpacked,
    unpacked_residual,
    unpacked_stamps,
)
from cloth_predict.encoding.recordings import bag_size
from cloth_predict.encoding.rounding import MARGIN, REACH, cheapest, offset_for, rounded
from cloth_predict.errors import FormatError
from cloth_predict.evaluation.cases import frames_of
from cloth_predict.formats.bag import Recording, read_clouds, write_recording
from cloth_predict.formats.pointcloud import encode_surface
from cloth_predict.formats.recording import read
from cloth_predict.tracker import Tracker
from cloth_predict.types import MarkerSequence

ROOT = Path(__file__).parents[1]
CONFIG = build(SHEET, 'x')


@pytest.fixture(scope='module')
def towel():
    return frames_of(read(ROOT / 'bags/towel_fan').markers, np.arange(150))


@pytest.fixture(scope='module')
def sheet():
    """Frames of a small sheet that fill one block, and part of a second."""
    _, markers, _ = swinging(CONFIG, np.random.default_rng(20), 1.3, every=1)
    return markers


@pytest.fixture(scope='module')
def small(sheet, tmp_path_factory):
    path = tmp_path_factory.mktemp('encoded') / 'small.mcap'
    write_encoded(path, sheet, CONFIG, 1e-3, 'sheet')
    return path


def farthest(rebuilt, recorded):
    """Largest distance [m] of a rebuilt marker; missing ones are missing in both."""
    np.testing.assert_array_equal(rebuilt.stamps, recorded.stamps)
    np.testing.assert_array_equal(rebuilt.visible, recorded.visible)
    assert rebuilt.labels == recorded.labels
    error = np.linalg.norm(rebuilt.positions - recorded.positions, axis=-1)
    return error[recorded.visible].max(initial=0.0)


# --- the bound


def test_every_marker_of_the_towel_is_rebuilt_within_the_bound(towel, tmp_path):
    config, bound = load(ROOT / 'config/towel.yaml'), 5e-4
    write_encoded(tmp_path / 'small.mcap', towel, config, bound, 'towel')
    found = read_markers(tmp_path / 'small.mcap')
    write_recording(tmp_path / 'rebuilt', Recording(found.markers))
    worst = farthest(read(tmp_path / 'rebuilt').markers, towel)
    assert 0.8 * bound < worst <= bound
    assert found.max_error == bound
    assert (tmp_path / 'small.mcap').stat().st_size <= 0.25 * bag_size(towel)


def test_the_wider_the_bound_the_smaller_the_file(sheet, tmp_path):
    sizes = []
    for bound in (1e-5, 1e-3, 1e-2):
        write_encoded(tmp_path / 'a.mcap', sheet, CONFIG, bound, 'sheet')
        assert farthest(read_markers(tmp_path / 'a.mcap').markers, sheet) <= bound
        sizes.append((tmp_path / 'a.mcap').stat().st_size)
    assert sizes == sorted(sizes, reverse=True)


def test_a_motive_take_is_rebuilt_within_the_bound(real, tmp_path):
    markers = frames_of(read(real('rope/rope_take4.csv')).markers, np.arange(200))
    write_encoded(tmp_path / 'a', markers, load(ROOT / 'config/rope.yaml'), 1e-4, 'rope')
    assert farthest(read_markers(tmp_path / 'a').markers, markers) <= 1e-4
    assert (tmp_path / 'a').stat().st_size <= 0.25 * bag_size(markers)


def test_markers_that_are_no_nodes_and_frames_that_cannot_be_used_are_kept(tmp_path):
    rng = np.random.default_rng(21)
    labels = ('Unlabeled 1', *(f'n{k}' for k in range(9)), 'Unlabeled 2')
    positions = rng.normal(0, 0.3, (60, 11, 3)).astype(np.float32).astype(float)
    positions[30, 4] = 5e4  # no volume is that large
    stamps = 10_000_000 * np.arange(60)
    stamps[[10, 11, 40]] = stamps[[11, 10, 39]]  # late, and twice
    stamps[50:] += 3_000_000_007
    visible = rng.random((60, 11)) < 0.7
    visible[20:23] = False
    positions[~visible] = np.nan
    markers = MarkerSequence(stamps, labels, positions, visible, 'mocap')
    config = build(SHEET | {'labels': list(labels[1:-1]), 'frame': 'mocap'}, 'x')
    write_encoded(tmp_path / 'a', markers, config, 0.02, 'x')
    found = read_markers(tmp_path / 'a')
    assert farthest(found.markers, markers) <= 0.02
    assert found.markers.frame_id == 'mocap'


def test_a_bound_below_what_a_bag_resolves_is_refused(towel):
    assert step_of(towel, 1e-6, 'x') > 0
    with pytest.raises(FormatError, match=r'towel: an error of 1e-05 mm is not above'):
        step_of(towel, 1e-8, 'towel')
    bound = 5e-7  # some spacings of float32
    step = step_of(towel, bound, 'x')
    exact = towel.positions[towel.visible]
    rebuilt = (np.rint(exact / step) * step).astype(np.float32).astype(float)
    assert np.linalg.norm(rebuilt - exact, axis=1).max() <= bound


@given(
    st.integers(0, 2**32),
    st.floats(0.1, 100.0),
)
@settings(max_examples=50)
def test_the_cheapest_is_within_reach_and_no_dearer_than_the_nearest(seed, spread):
    rng = np.random.default_rng(seed)
    found = rng.normal(0, spread, (40, 3))
    expected = np.rint(found + rng.normal(0, 1, (40, 3))).astype(int)
    chosen = cheapest(found, expected)
    assert np.linalg.norm(found - chosen, axis=1).max() <= REACH * (1 + 1e-12)
    nearest = np.rint(found).astype(int)
    bits = [np.log2(1 + np.abs(p - expected)).sum(axis=1) for p in (chosen, nearest)]
    assert (bits[0] <= bits[1]).all()
    near = np.linalg.norm(found - expected, axis=1) <= REACH
    np.testing.assert_array_equal(chosen[near], expected[near])


# --- other machines


NEAR = st.builds(
    lambda whole, part, beside: whole + part + beside * MARGIN,
    st.integers(-1000, 1000),
    st.sampled_from([0.0, 0.25, 0.5, 0.75]),
    st.floats(-2.0, 2.0),
)


@given(arrays.arrays(float, 4, elements=NEAR | st.floats(-1e5, 1e5)))
@settings(max_examples=50)
def test_what_another_machine_expects_is_rounded_alike(expected):
    offset = offset_for(expected)
    other = expected + 0.99 * MARGIN * np.sign(np.sin(1e3 * expected))
    np.testing.assert_array_equal(rounded(expected, offset), rounded(other, offset))


def test_numbers_between_two_whole_ones_take_another_offset():
    assert offset_for(np.array([0.1, 7.2])) == 0
    assert offset_for(np.array([0.5 + 1e-7])) == 1
    assert offset_for(np.array([0.5, 0.75])) == 2
    hopeless = np.array([0.5, 0.75, 0.25])
    np.testing.assert_array_equal(rounded(hopeless, offset_for(hopeless)), 0)


def other_machine(monkeypatch, size):
    """Predictions that differ as those of another linear algebra would."""
    rng, predict = np.random.default_rng(22), Tracker.predict

    def differently(self, horizon):
        found = predict(self, horizon)
        return replace(found, position=found.position + rng.uniform(-size, size, (9, 3)))

    monkeypatch.setattr(Tracker, 'predict', differently)


def test_a_machine_that_rounds_otherwise_rebuilds_the_same(small, monkeypatch):
    here = read_markers(small).markers
    other_machine(monkeypatch, 1e-8)
    found = read_markers(small)
    assert found.fault == ''
    np.testing.assert_array_equal(found.markers.positions, here.positions)


def test_a_machine_that_predicts_otherwise_says_so(small, monkeypatch):
    other_machine(monkeypatch, 1e-3)
    with pytest.raises(FormatError, match='does so otherwise'):
        read_markers(small)


def test_the_same_recording_gives_the_same_bytes(sheet, small, tmp_path):
    write_encoded(tmp_path / 'again.mcap', sheet, CONFIG, 1e-3, 'sheet')
    assert (tmp_path / 'again.mcap').read_bytes() == small.read_bytes()
    first, second = (read_markers(small).markers.positions for _ in range(2))
    np.testing.assert_array_equal(first, second)


# --- numbers as bytes


@given(st.lists(st.integers(-(2**62), 2**62) | st.integers(-3, 3)))
def test_residuals_come_back(values):
    residual = np.array(values, np.int64)
    back = unpacked_residual(*packed_residual(residual), len(residual))
    np.testing.assert_array_equal(back, residual)


@given(st.lists(st.integers(0, 2**61)))
def test_stamps_come_back(values):
    stamps = np.array(values, np.int64)
    np.testing.assert_array_equal(unpacked_stamps(packed_stamps(stamps), len(stamps)), stamps)


def test_a_stream_of_another_length_is_an_error():
    with pytest.raises(ValueError, match='3 numbers in place of 4'):
        unpacked(packed(np.arange(3)), 'i8', 4)


def test_small_numbers_at_random_take_little_more_than_their_entropy():
    residual = np.rint(np.random.default_rng(23).normal(0, 1.0, 20000)).astype(np.int64)
    small, _ = packed_residual(residual)
    _, counts = np.unique(residual, return_counts=True)
    share = counts / len(residual)
    entropy = -(share * np.log2(share)).sum() * len(residual) / 8
    assert entropy < len(small) < 1.08 * entropy  # Huffman spends whole bits


def test_markers_of_a_body_are_rebuilt_within_the_bound(tmp_path):
    config, bound = load(ROOT / 'config/balloon.yaml'), 5e-4
    markers = frames_of(read(ROOT / 'bags/balloon').markers, np.arange(60))
    write_encoded(tmp_path / 'small.mcap', markers, config, bound, 'balloon')
    found = read_markers(tmp_path / 'small.mcap', states=True)
    assert farthest(found.markers, markers) <= bound
    assert sum(state is not None for state in found.states) > 50
    assert (tmp_path / 'small.mcap').stat().st_size < 0.5 * bag_size(markers)


# --- the file


def test_any_reader_of_mcap_reads_the_file_by_the_schemas_it_holds(sheet, small):
    with small.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        found = [(c.topic, m) for _, c, _, m in reader.iter_decoded_messages()]
        assert reader.get_header().profile == 'ros2'
    assert {c.topic for c in summary.channels.values()} == {ENCODING, FRAMES}
    assert summary.statistics.message_count == len(found) == 1 + -(-len(sheet) // BLOCK)
    assert [topic for topic, _ in found] == [ENCODING] + [FRAMES] * (len(found) - 1)
    header = found[0][1]
    assert (header.version, header.frames, tuple(header.labels)) == (
        container.VERSION, len(sheet), sheet.labels,
    )  # fmt: skip
    assert 'stiffness_structural: 60' in header.parameters
    # by the comments of the schema alone, with nothing of this project
    message = found[1][1]
    stamps = np.frombuffer(zlib.decompress(bytes(message.stamps)), '<i8').cumsum().cumsum()
    np.testing.assert_array_equal(stamps, sheet.stamps[:BLOCK])
    bits = np.unpackbits(np.frombuffer(zlib.decompress(bytes(message.visible)), np.uint8))
    seen = bits[: BLOCK * 9].reshape(BLOCK, 9).astype(bool)
    np.testing.assert_array_equal(seen, sheet.visible[:BLOCK])
    residual = np.frombuffer(zlib.decompress(bytes(message.residual)), np.int8)
    assert len(residual) == 3 * seen.sum()


def test_the_parameters_are_those_of_the_encoder(small):
    assert read_markers(small).config == CONFIG


def test_a_newer_version_is_named(small, tmp_path):
    with create_encoded(tmp_path / 'new.mcap') as file:
        for topic, message in read_encoded(small):
            fields = {name: getattr(message, name) for name in vars(message) if name[0] != '_'}
            if topic == ENCODING:
                fields['version'] = container.VERSION + 1
            file.write(topic, 0, **fields)
    with pytest.raises(FormatError, match=r'new.mcap: version 2 .* reads version 1'):
        read_markers(tmp_path / 'new.mcap')


def test_a_newer_version_is_named_whatever_is_in_its_message(tmp_path, monkeypatch):
    newer = 'uint32 version\nuint8[] other\n'
    kind = 'cloth_predict/msg/Encoding'
    with monkeypatch.context() as patched:
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(newer, kind))
        patched.setattr(container, 'TYPES', types)
        with create_encoded(tmp_path / 'new.mcap') as file:
            file.write(ENCODING, 0, version=container.VERSION + 1, other=np.zeros(3, np.uint8))
    with pytest.raises(FormatError, match=r'new.mcap: version 2 of the format, .* version 1$'):
        read_markers(tmp_path / 'new.mcap')


def same_up_to_a_fault(path, sound):
    """Decode a damaged file: what is told is one line, and what is rebuilt is right."""
    told = ''
    try:
        found = read_markers(path)
    except FormatError as error:
        told = str(error)
    if told:
        assert str(path) in told
        assert '\n' not in told
        return 0
    kept = len(found.markers)
    np.testing.assert_array_equal(found.markers.positions, sound.positions[:kept])
    np.testing.assert_array_equal(found.markers.stamps, sound.stamps[:kept])
    assert (kept == len(sound)) == (found.fault == '')
    assert str(path) in (found.fault or str(path))
    return kept


def test_a_truncated_file_gives_all_before_its_end(small, tmp_path):
    sound, data = read_markers(small).markers, small.read_bytes()
    kept = []
    for share in (0.0, 0.001, 0.1, 0.4, 0.5, 0.6, 0.7, 0.99):
        (tmp_path / 'cut.mcap').write_bytes(data[: int(share * len(data))])
        kept.append(same_up_to_a_fault(tmp_path / 'cut.mcap', sound))
    assert kept[0] == kept[1] == 0
    assert kept == sorted(kept)
    assert BLOCK in kept
    assert kept[-1] == len(sound)  # all that is missing is an index


def test_no_flipped_byte_goes_unseen(small, tmp_path):
    sound, data = read_markers(small).markers, small.read_bytes()
    rng = np.random.default_rng(24)
    kept = []
    for at in np.linspace(0, len(data) - 1, 16).astype(int).tolist():
        damaged = bytearray(data)
        damaged[at] ^= int(rng.integers(1, 256))
        (tmp_path / 'flipped.mcap').write_bytes(damaged)
        kept.append(same_up_to_a_fault(tmp_path / 'flipped.mcap', sound))
    assert {0, BLOCK, len(sound)} <= set(kept)


def test_a_missing_message_is_a_fault(small, tmp_path):
    messages = list(read_encoded(small))
    with create_encoded(tmp_path / 'gap.mcap') as file:
        for topic, message in messages[:1] + messages[2:]:
            fields = {name: getattr(message, name) for name in vars(message) if name[0] != '_'}
            file.write(topic, 0, **fields)
    with pytest.raises(FormatError, match='not those that were encoded'):
        read_markers(tmp_path / 'gap.mcap')


# --- the commands


@pytest.fixture
def files(sheet, parameters, tmp_path):
    write_recording(tmp_path / 'bag', Recording(sheet))
    return tmp_path / 'bag', parameters(**SHEET | {'frame': 'mocap'}), tmp_path / 'small.mcap'


def test_encode_and_decode_for_programs(files, sheet, capsys, tmp_path):
    bag, config, file = files
    bound = ['--max-error-mm', '0.5']
    assert main(['encode', str(bag), '-c', str(config), '-o', str(file), *bound, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == {
        'frames': len(sheet), 'markers': 9, 'max_error_mm': 0.5, 'bytes': file.stat().st_size,
        'bag_bytes': (bag / 'bag.mcap').stat().st_size,
        'ratio': file.stat().st_size / (bag / 'bag.mcap').stat().st_size,
        'faults': [],
    }  # fmt: skip
    assert main(['decode', str(file), '-o', str(tmp_path / 'out'), '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == {
        'recorded': len(sheet), 'frames': len(sheet), 'max_error_mm': 0.5, 'rate_hz': None,
        'missing': pytest.approx(1 - sheet.visible.mean()), 'fault': None,
    }  # fmt: skip
    assert farthest(read(tmp_path / 'out').markers, read(bag).markers) <= 5e-4


def test_the_bound_suits_the_noise_where_none_is_asked_for(files, capsys):
    bag, config, file = files
    assert main(['encode', str(bag), '-c', str(config), '-o', str(file)]) == 0
    assert 'to within 3 mm' in capsys.readouterr().out  # 3 x 1 mm


def test_decode_at_a_rate(files, sheet, capsys, tmp_path):
    bag, config, file = files
    main(['encode', str(bag), '-c', str(config), '-o', str(file)])
    command = ['decode', str(file), '-o', str(tmp_path / 'out'), '--rate', '40']
    assert main(command) == 0
    assert f'frames at 40 Hz from {len(sheet)}' in capsys.readouterr().out
    found = read(tmp_path / 'out').markers
    np.testing.assert_array_equal(np.diff(found.stamps), 25_000_000)
    assert found.stamps[0] == sheet.stamps[0]
    assert found.visible[20:].all()
    recorded = np.flatnonzero(np.isin(sheet.stamps, found.stamps))
    error = (found.positions[np.isin(found.stamps, sheet.stamps)] - sheet.positions[recorded])[10:]
    assert np.sqrt(np.nanmean(error**2)) < 1.5e-3  # noise of 1 mm, and rounding
    assert main([*command, '-c', str(config)]) == 0


def test_decode_with_the_states_of_the_filter(files, tmp_path):
    bag, config, file = files
    main(['encode', str(bag), '-c', str(config), '-o', str(file)])
    assert main(['decode', str(file), '-o', str(tmp_path / 'out'), '--states']) == 0
    markers = read(tmp_path / 'out').markers
    states = read_clouds(tmp_path / 'out', 'cloth/estimate')
    tracker, expected = Tracker(load(config)), {}
    exact = read_markers(file).markers
    for k, stamp in enumerate(markers.stamps.tolist()):
        tracker.step(stamp, exact.positions[k], exact.visible[k])
        if tracker.started:
            expected[stamp] = tracker.estimate()
    assert [stamp for stamp, _ in states] == list(expected)
    for stamp, cloud in states:
        np.testing.assert_array_equal(
            cloud.data.tobytes(), encode_surface(expected[stamp], 3, 3).tobytes()
        )


def test_a_damaged_file_is_decoded_up_to_the_fault(files, capsys, tmp_path):
    bag, config, file = files
    main(['encode', str(bag), '-c', str(config), '-o', str(file)])
    data = file.read_bytes()
    file.write_bytes(data[: int(0.6 * len(data))])
    capsys.readouterr()
    assert main(['decode', str(file), '-o', str(tmp_path / 'out')]) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    kept = len(read(tmp_path / 'out').markers)
    assert str(file) in error
    assert f'the {kept} frames before are rebuilt' in error
    assert kept % BLOCK == 0


@pytest.mark.parametrize(
    ('arguments', 'says'),
    [
        (['decode', '{bag}/bag.mcap', '-o', '{out}'], 'not a recording made by `encode`'),
        (['decode', '{out}.mcap', '-o', '{out}'], 'no such file'),
        (['encode', '{bag}', '-c', '{config}', '-o', '{bag}/bag.mcap'], 'not overwritten'),
        (['encode', '{bag}', '-c', '{towel}', '-o', '{out}'], 'do not fit'),
        (['encode', '{bag}', '-c', '{config}', '-o', '{out}', '--max-error-mm', '1e-6'], 'resolv'),
    ],
)
def test_known_errors_are_one_line(files, capsys, tmp_path, arguments, says):
    bag, config, _ = files
    towel = ROOT / 'config/towel.yaml'
    names = {'bag': bag, 'config': config, 'out': tmp_path / 'out', 'towel': towel}
    assert main([argument.format(**names) for argument in arguments]) == 1
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert says in error
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    'arguments',
    [
        ['decode', 'a', '-o', 'b', '-c', 'c'],
        ['decode', 'a', '-o', 'b', '--rate', '0'],
        ['encode', 'a', '-c', 'c', '-o', 'b', '--max-error-mm', '-1'],
    ],
)
def test_wrong_usage(arguments):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
