"""The layout of clouds: what is packed comes back, and a cloud of something else is refused."""

from __future__ import annotations

import struct
from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from cloth_predict.errors import FrameError
from cloth_predict.formats.pointcloud import (
    DATATYPES,
    MARKERS,
    SCANLINE,
    SURFACE,
    TRACKS,
    UNLABELLED,
    WARPED,
    decode,
    decode_markers,
    encode_markers,
    encode_surface,
    fields_of,
    xyz,
)
from cloth_predict.types import BoolArray, FloatArray, Surface

XYZ_ID = ('x', 'y', 'z', 'id')
THREE = [('x', 'f4'), ('y', 'f4'), ('z', 'f4')]


def message(points: Any, **changes: Any) -> Any:
    """Build a cloud of structured points, shape (width,) or (height, width), without padding."""
    grid = np.atleast_2d(points)
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=DATATYPES[kind.name], count=1)
        for name, (kind, offset) in grid.dtype.fields.items()
    ]
    height, width = grid.shape
    step = grid.dtype.itemsize
    values = {
        'fields': fields,
        'is_bigendian': False,
        'height': height,
        'width': width,
        'point_step': step,
        'row_step': step * width,
        'data': grid.tobytes(),
    }
    return SimpleNamespace(**{**values, **changes})


def markers(*rows: tuple[float, ...], kind: Any = MARKERS) -> Any:
    return np.array(list(rows), kind)


def unpacked(cloud: Any, nodes: int) -> tuple[list[list[float]], list[bool], list[list[float]]]:
    """Positions of the visible nodes, visibility, and the points without a label."""
    positions, visible, strangers = decode_markers(cloud, nodes)
    assert positions.shape == (nodes, 3)
    assert strangers.shape == (len(strangers), 3)
    assert np.isnan(positions[~visible]).all()
    return positions[visible].tolist(), visible.tolist(), strangers.tolist()


def refused(cloud: Any, nodes: int = 4) -> str:
    with pytest.raises(FrameError) as caught:
        decode_markers(cloud, nodes)
    assert '\n' not in str(caught.value)
    return str(caught.value)


ONE = markers((1, 2, 3, 0))
TWO = markers((1, 2, 3, 0), (4, 5, 6, 2))


# --- layout ----------------------------------------------------------------------------------


def test_datatypes_are_those_of_ros() -> None:
    field = get_typestore(Stores.ROS2_JAZZY).types['sensor_msgs/msg/PointField']
    assert {name: getattr(field, name.upper()) for name in DATATYPES} == DATATYPES
    assert len(DATATYPES) == 8


@pytest.mark.parametrize(
    ('kind', 'names'),
    [
        (MARKERS, 'x y z id'),
        (TRACKS, 'x y z id track'),
        (SURFACE, 'x y z vx vy vz ax ay az sigma'),
        (WARPED, 'u v s t x y z dt flags field'),
        (SCANLINE, 'u v dt line field'),
    ],
)
def test_layouts_have_their_fields_one_after_the_other(kind: Any, names: str) -> None:
    expected, offset = [], 0
    for name in names.split():
        number, size = {'id': (6, 4), 'track': (6, 4)}.get(name, (7, 4))
        if name in ('flags', 'line', 'field'):
            number, size = 4, 2  # uint16; two of them fill four bytes
        expected.append((name, offset, number, 1))
        offset += size
    assert fields_of(kind) == expected
    assert kind.itemsize == offset
    assert offset % 4 == 0


def test_the_bytes_of_markers() -> None:
    positions = np.array([[1.0, 2.0, 3.0], [np.nan] * 3, [-4.0, 0.5, 6.0]])
    visible = np.array([True, False, True])
    points = encode_markers(positions, visible, np.zeros(3, bool))
    assert points.tobytes() == struct.pack('<3fI3fI', 1, 2, 3, 0, -4, 0.5, 6, 2)


def test_the_bytes_of_markers_some_of_which_have_no_label() -> None:
    points = encode_markers(np.ones((3, 3)), np.array([True, True, True]), np.arange(3) == 1)
    parts = [(1, 1, 1, 0, 0), (1, 1, 1, 0xFFFFFFFF, 1), (1, 1, 1, 2, 2)]
    assert points.tobytes() == b''.join(struct.pack('<3f2I', *part) for part in parts)


def test_the_bytes_of_a_surface() -> None:
    position = np.arange(18.0).reshape(6, 3)
    covariance = np.square(np.arange(6.0) / 4)[:, None, None] * np.eye(3)
    surface = Surface(7, position, position + 100, position + 200, covariance)
    points = encode_surface(surface, 2, 3)
    assert points.shape == (2, 3)
    expected = b''.join(
        struct.pack('<10f', *position[k], *(position[k] + 100), *(position[k] + 200), k / 4)
        for k in range(6)
    )
    assert points.tobytes() == expected  # row by row
    decoded = decode(message(points), ('x', 'y', 'z', 'sigma'))
    assert decoded.shape == (2, 3)
    np.testing.assert_array_equal(xyz(decoded), position)


# --- there and back --------------------------------------------------------------------------


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.booleans(),
            st.booleans(),
        ),
        max_size=8,
    )
)  # fmt: skip
def test_markers_come_back(rows: list[tuple[float, float, float, bool, bool]]) -> None:
    positions = np.array([row[:3] for row in rows]).reshape(-1, 3)
    visible, unlabelled = (np.array([row[k] for row in rows], bool) for k in (3, 4))
    positions[~visible] = np.nan
    before = positions.copy()
    cloud = message(encode_markers(positions, visible, unlabelled))
    found, seen, strangers = decode_markers(cloud, len(rows))
    np.testing.assert_array_equal(positions, before)
    np.testing.assert_array_equal(seen, visible & ~unlabelled)
    # a float32 has 24 bits, so half its last is 2^-25 of the value; 1e-45 is the least of all
    close = {'rtol': 2**-24, 'atol': 1e-45}
    np.testing.assert_allclose(found[seen], positions[seen], **close)
    np.testing.assert_allclose(strangers, positions[visible & unlabelled], **close)


def test_no_marker_is_visible() -> None:
    points = encode_markers(np.full((3, 3), np.nan), np.zeros(3, bool), np.zeros(3, bool))
    assert unpacked(message(points), 3) == ([], [False] * 3, [])
    assert unpacked(message(points, height=0, width=0), 3) == ([], [False] * 3, [])
    assert unpacked(message(points, height=7), 3) == ([], [False] * 3, [])


def test_order_of_points_does_not_matter() -> None:
    cloud = message(markers((7, 8, 9, 3), (1, 2, 3, 1)))
    assert unpacked(cloud, 4) == ([[1, 2, 3], [7, 8, 9]], [False, True, False, True], [])


def test_a_cloud_of_points_without_labels_only() -> None:
    cloud = message(markers((7, 8, 9, UNLABELLED), (1, 2, 3, UNLABELLED)))
    assert unpacked(cloud, 2) == ([], [False, False], [[7, 8, 9], [1, 2, 3]])


def test_points_with_and_without_labels_may_be_mixed() -> None:
    cloud = message(markers((7, 8, 9, UNLABELLED), (4, 5, 6, 1), (1, 2, 3, UNLABELLED)))
    assert unpacked(cloud, 2) == ([[4, 5, 6]], [False, True], [[7, 8, 9], [1, 2, 3]])


# --- the layouts of others -------------------------------------------------------------------


@pytest.mark.parametrize(
    'kind',
    [
        [('id', 'u4'), *reversed(THREE)],
        [('intensity', 'f4'), *THREE, ('rgb', 'u4'), ('id', 'u4')],
        [*THREE, ('ring', 'u2'), ('id', 'u4'), ('t', 'f8')],  # not on multiples of 4
        [(axis, 'f8') for axis in 'xyz'] + [('id', 'u4')],
        [('x', 'f8'), ('y', 'f4'), ('z', 'f8'), ('id', 'u4')],
        [*THREE, ('id', 'u2')],
        [*THREE, ('id', 'u1')],
        {
            'names': ['x', 'y', 'z', 'id'],
            'formats': ['f4', 'f4', 'f4', 'u4'],
            'offsets': [0, 4, 8, 16],
            'itemsize': 32,
        },
    ],
)
@pytest.mark.parametrize('order', ['<', '>'])
def test_other_layouts_read_the_same(kind: Any, order: str) -> None:
    points = np.zeros(2, np.dtype(kind).newbyteorder(order))
    for name, values in zip(XYZ_ID, ([1.5, -4], [2, 5], [3, 6], [0, 2]), strict=True):
        points[name] = values
    cloud = message(points, is_bigendian=order == '>')
    expected = ([[1.5, 2, 3], [-4, 5, 6]], [True, False, True, False], [])
    assert unpacked(cloud, 4) == expected


def test_double_precision_is_kept() -> None:
    points = markers((0.1, 0.2, 0.3, 0), kind=[(axis, 'f8') for axis in 'xyz'] + [('id', 'u4')])
    assert unpacked(message(points), 1)[0] == [[0.1, 0.2, 0.3]]


@pytest.mark.parametrize('padding', [1, 3, 16, 100])
def test_rows_with_padding(padding: int) -> None:
    grid = markers(*((k, k, k, k) for k in range(6))).reshape(2, 3)
    data = b''.join(row.tobytes() + b'\xff' * padding for row in grid)
    cloud = message(grid, data=data, row_step=3 * 16 + padding)
    assert decode(cloud, XYZ_ID)['id'].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert unpacked(cloud, 6)[0] == [[k] * 3 for k in range(6)]
    cut = message(grid, data=data[:-1], row_step=3 * 16 + padding)
    assert refused(cut) == 'the sizes of the cloud do not fit its data'


@pytest.mark.parametrize(
    'hold',
    [bytes, bytearray, memoryview, lambda b: array('B', b), lambda b: np.frombuffer(b, np.uint8)],
)
def test_any_holder_of_bytes_will_do(hold: Any) -> None:
    cloud = message(TWO, data=hold(TWO.tobytes()))
    assert unpacked(cloud, 3)[0] == [[1, 2, 3], [4, 5, 6]]


def test_data_beyond_the_last_row_is_ignored() -> None:
    assert unpacked(message(ONE, data=ONE.tobytes() + b'abc'), 1)[0] == [[1, 2, 3]]


# --- what is refused -------------------------------------------------------------------------


@pytest.mark.parametrize('missing', XYZ_ID)
def test_a_missing_field_is_named(missing: str) -> None:
    kind = [(name, MARKERS[name]) for name in XYZ_ID if name != missing]
    others = ', '.join(name for name, _ in kind)
    cloud = message(np.zeros(2, [*kind, ('w', 'f4')]))
    assert refused(cloud) == f"the cloud has no field '{missing}' (fields: {others}, w)"


def test_no_fields_at_all() -> None:
    assert refused(message(ONE, fields=[])) == "the cloud has no field 'x' (fields: none)"


@pytest.mark.parametrize('change', [{'count': 3}, {'count': 0}, {'datatype': 0}, {'datatype': 9}])
@pytest.mark.parametrize('place', [0, 3])
def test_a_field_that_is_not_one_number(change: dict[str, int], place: int) -> None:
    cloud = message(ONE)
    vars(cloud.fields[place]).update(change)
    assert refused(cloud) == f"field '{XYZ_ID[place]}' of the cloud is not one number"


def test_a_field_that_is_not_wanted_may_be_anything() -> None:
    kind = [*MARKERS.descr, ('normal', 'f4')]
    cloud = message(np.ones(1, kind))
    cloud.fields[-1].count, cloud.fields[-1].datatype = 3, 99
    assert unpacked(cloud, 2)[0] == [[1, 1, 1]]


def test_a_field_that_is_there_twice() -> None:
    cloud = message(ONE)
    cloud.fields.append(cloud.fields[0])
    assert "'x'" in refused(cloud)


@pytest.mark.parametrize(
    'changes',
    [
        {'data': TWO.tobytes()[:-1]},
        {'data': b''},
        {'width': 3},
        {'height': 2},
        {'row_step': 31},
        {'row_step': 0},
        {'point_step': 15, 'row_step': 32},  # the field id ends at 16
        {'point_step': 0},
        {'height': 2**32 - 1},
        {'width': 2**32 - 1, 'row_step': 2**32 - 1},
    ],
)
def test_sizes_that_do_not_fit(changes: dict[str, Any]) -> None:
    assert refused(message(TWO, **changes)) == 'the sizes of the cloud do not fit its data'


def test_a_field_beyond_the_point() -> None:
    cloud = message(TWO)
    cloud.fields[3].offset = 13
    assert refused(cloud) == 'the sizes of the cloud do not fit its data'


@pytest.mark.parametrize('wrong', [4, 5, 2**31, UNLABELLED - 1])
def test_an_id_that_is_no_node(wrong: int) -> None:
    cloud = message(markers((1, 2, 3, 0), (1, 2, 3, wrong), (1, 2, 3, UNLABELLED)))
    words = f'2 markers with ids up to {wrong} do not fit a model of 4 nodes'
    assert refused(cloud) == words


def test_an_id_that_is_there_twice() -> None:
    cloud = message(markers((1, 2, 3, 1), (4, 5, 6, 3), (7, 8, 9, 1)))
    assert refused(cloud) == 'a marker id is there twice'


@pytest.mark.parametrize(
    ('kind', 'wrong'), [('i4', -2), ('i2', -1), ('i1', -128), ('f4', 0.5), ('f4', -1.0)]
)
def test_an_id_that_is_no_whole_number_from_zero(kind: str, wrong: float) -> None:
    cloud = message(markers((1, 2, 3, 1), (4, 5, 6, wrong), kind=[*THREE, ('id', kind)]))
    assert 'id' in refused(cloud)


def test_inputs_are_not_written_to() -> None:
    data = array('B', TWO.tobytes())
    positions: FloatArray
    visible: BoolArray
    positions, visible, _ = decode_markers(message(TWO, data=data), 3)
    positions[:], visible[:] = 0.0, False
    assert data.tobytes() == TWO.tobytes()
