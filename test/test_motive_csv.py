"""Motive CSV exports: every layout gives back what was planted, every broken file one line."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from cloth_predict.errors import FormatError
from cloth_predict.formats.motive_csv import read_motive_csv
from cloth_predict.types import FloatArray, MarkerSequence

DATA = Path(os.environ.get('CLOTH_PREDICT_DATA', Path(__file__).parents[2] / 'shared' / 'data'))
SCALES = {'Meters': 1.0, 'Centimeters': 100.0, 'Millimeters': 1000.0}
FULL = {'Format Version': '1.23', 'Export Frame Rate': '100.000000', 'Length Units': 'Meters'}

Column = tuple[str, str, str, str]


def marker(name: str, kind: str = 'Marker') -> list[Column]:
    return [(kind, name, 'Position', axis) for axis in 'XYZ']


def solved(name: str, kind: str = 'Rigid Body Marker') -> list[Column]:
    return [*marker(name, kind), (kind, name, 'Marker Quality', '')]


def pose(name: str, kind: str = 'Rigid Body') -> list[Column]:
    rotation = [(kind, name, 'Rotation', axis) for axis in 'XYZW']
    return [*rotation, *marker(name, kind), (kind, name, 'Mean Marker Error', '')]


def header_rows(
    columns: list[Column], titles: str = 'Type Name ID', time: str = 'Time (Seconds)'
) -> list[list[str]]:
    """Build the rows from the types to the axes; a title of - stands for an ID without one."""
    kinds, names, properties, axes = map(list, zip(*columns, strict=True))
    by_title = {'Type': kinds, 'Name': names}
    rows = [['', title, *by_title.get(title, ['1A2A8F'] * len(kinds))] for title in titles.split()]
    return [*rows, ['', '', *properties], ['Frame', time, *axes]]


def text_of(
    header: list[list[str]], data: list[list[str]], first: dict[str, str] = FULL, eol: str = '\n'
) -> str:
    begin = ','.join(cell for pair in first.items() for cell in pair)
    return eol.join([begin, '', *(','.join(row) for row in header + data), ''])


def data_rows(columns: list[Column], positions: FloatArray, scale: float) -> list[list[str]]:
    """Build rows at 100 Hz with the positions [m] of the markers, and 0.5 in other columns."""
    rows = []
    for frame, of_frame in enumerate(positions):
        cells = iter((of_frame * scale).ravel().tolist())
        wanted = [kind.endswith('Marker') and what == 'Position' for kind, _, what, _ in columns]
        values = [repr(next(cells)) if want else '0.5' for want in wanted]
        rows.append([str(frame), f'{frame / 100:.6f}', *values])
    return rows


def simple(*cells: str, frames: int = 1, first: dict[str, str] = FULL) -> str:
    """Build a file with markers A and B; the cells are those of its last frame."""
    rows = data_rows([*marker('A'), *marker('B')], np.ones((frames, 2, 3)), 1.0)
    rows[-1][2:] = cells or rows[-1][2:]
    return text_of(header_rows([*marker('A'), *marker('B')]), rows, first)


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.fixture
def take(tmp_path: Path) -> Path:
    return tmp_path / 'take.csv'


def read(take: Path, text: str | bytes) -> MarkerSequence:
    """Read a file in which nothing is to be warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        return read_motive_csv(write(take, text))


def failure(path: Path) -> str:
    """Return what the error says behind the path; it has to be one line that begins with it."""
    with pytest.raises(FormatError) as caught:
        read_motive_csv(path)
    message = str(caught.value)
    assert message.startswith(f'{path}:')
    assert '\n' not in message
    return message.removeprefix(f'{path}:').strip()


# --- layouts ---------------------------------------------------------------------------------

MARKERS = [*marker('A'), *marker('Unlabeled 1036'), *marker('C')]
BODIES = [*pose('B'), *solved('B:1'), *solved('B:2'), *marker('A'), *marker('D')]
BONES = [*pose('Hip', 'Bone'), *marker('Hip:1', 'Bone Marker'), *marker('A')]
TIMECODE: list[Column] = [('', '', '', 'TimeCode')]


@pytest.mark.parametrize('unit', [*SCALES, 'millimeters', ''])
@pytest.mark.parametrize('eol', ['\n', '\r\n'])
@pytest.mark.parametrize(
    ('columns', 'titles', 'time', 'labels'),
    [
        (MARKERS, 'Type Name ID', 'Time (Seconds)', ('A', 'Unlabeled 1036', 'C')),
        (MARKERS, 'Type Name', 'Time', ('A', 'Unlabeled 1036', 'C')),
        (MARKERS, 'Type Name ID Parent', 'Time (Seconds)', ('A', 'Unlabeled 1036', 'C')),
        (MARKERS, 'Type Parent Name ID', 'Time (Seconds)', ('A', 'Unlabeled 1036', 'C')),
        (BODIES, 'Type Name ID', 'Time', ('B:1', 'B:2', 'A', 'D')),
        (BONES, 'Type Name ID Parent', 'Time (Seconds)', ('Hip:1', 'A')),
        ([*TIMECODE, *MARKERS], 'Type Name ID', 'Time', ('A', 'Unlabeled 1036', 'C')),
    ],
)
def test_planted_positions_come_back_in_metres(
    take: Path,
    columns: list[Column],
    titles: str,
    time: str,
    labels: tuple[str, ...],
    eol: str,
    unit: str,
) -> None:
    rng = np.random.default_rng(7)
    positions = rng.uniform(-5, 5, (6, len(labels), 3))
    first = {'Format Version': '1.2', **({'Length Units': unit} if unit else {})}
    rows = data_rows(columns, positions, SCALES.get(unit.capitalize(), 1.0))
    sequence = read(take, text_of(header_rows(columns, titles, time), rows, first, eol))
    assert sequence.labels == labels
    assert sequence.stamps.tolist() == [0, 10**7, 2 * 10**7, 3 * 10**7, 4 * 10**7, 5 * 10**7]
    assert sequence.visible.all()
    # A few roundings of numbers up to 5 m in double precision.
    np.testing.assert_allclose(sequence.positions, positions, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ('old', 'new'),
    [
        ('Format Version', '\ufeffFormat Version'),
        (',Type,', ',,'),  # format 1.21: rows without their labels
        (',Name,', ',,'),
        (',ID,', ',,'),
        ('\n\n', '\n,\n'),
        ('1.23,', '1.23,Take Notes,slow, then fast,'),  # a comma that shifts all later pairs
        ('1.23,', '1.23,Total Exported Frames,2,'),
        ('X,Y,Z\n', 'X,Y,Z,\n'),
        ('\n1,0.010000', '\n\n1,0.010000'),
        ('1.0,1.0,1.0\n1,', '1.0,1.0,1.0,,\n1,'),
        ('\n1,0.010000,1.0', '\n1,0.010000,"1.0"'),
        ('\n1,0.010000,1.0', '\n1,0.010000, 1e0 '),
    ],
)
def test_variants_of_a_layout_read_the_same(take: Path, old: str, new: str) -> None:
    text = simple(frames=2)
    assert old in text
    text = text.replace(old, new, 1)
    for unit, metres in (('Meters', 1.0), ('Millimeters', 0.001)):
        sequence = read(take, text.replace('Meters', unit))
        assert sequence.labels == ('A', 'B')
        assert sequence.stamps.tolist() == [0, 10**7]
        assert (sequence.positions == metres).all()


def test_header_without_any_row_label(take: Path) -> None:
    header = header_rows(BODIES, 'Type Name ID')
    for row in header[:3]:
        row[1] = ''
    rows = data_rows(BODIES, np.full((2, 4, 3), 0.25), 1.0)
    sequence = read(take, text_of(header, rows))
    assert sequence.labels == ('B:1', 'B:2', 'A', 'D')
    assert (sequence.positions == 0.25).all()


def test_header_rows_trimmed_at_their_end(take: Path) -> None:
    columns = [*marker('A'), *solved('B:1')]
    header = header_rows(columns, 'Type Name ID Parent')
    header[3] = ['', 'Parent']
    assert header[-1].pop() == ''  # the axis of the quality, so data rows are longer
    sequence = read(take, text_of(header, data_rows(columns, np.full((2, 2, 3), 0.25), 1.0)))
    assert sequence.labels == ('A', 'B:1')
    assert (sequence.positions == 0.25).all()


def test_names_in_the_code_page_of_windows(take: Path) -> None:
    text = simple().replace('A', 'Gr\u00f6\u00dfe')
    for encoding in ('cp1252', 'utf-8', 'utf-8-sig'):
        assert read(take, text.encode(encoding)).labels == ('Gr\u00f6\u00dfe', 'B')
    # 0x81 is no letter in either encoding; the rest of the file is still good.
    assert read(take, text.encode('cp1252').replace(b'\xf6', b'\x81')).labels[1] == 'B'


RIGID, BONE = 'Rigid Body Marker', 'Bone Marker'


@pytest.mark.parametrize(
    ('markers', 'labels'),
    [
        ([('Marker', 'A'), (RIGID, 'A')], ['A', 'A (Rigid Body Marker)']),
        ([(RIGID, 'A'), ('Marker', 'A')], ['A (Rigid Body Marker)', 'A']),
        ([(BONE, 'A'), ('Marker', 'A')], ['A (Bone Marker)', 'A']),
        ([(RIGID, 'A'), ('Marker', 'B')], ['A', 'B']),
        ([('Marker', 'A')] * 3, ['A', 'A #2', 'A #3']),
        ([(RIGID, 'A'), (BONE, 'A')], ['A', 'A #2']),
        (
            [(RIGID, 'A'), (RIGID, 'A'), ('Marker', 'A')],
            ['A (Rigid Body Marker)', 'A (Rigid Body Marker) #2', 'A'],
        ),
        ([('Marker', 'A'), ('Marker', 'A'), ('Marker', 'A #2')], ['A', 'A #3', 'A #2']),
        ([('Marker', 'Unlabeled:8'), ('Marker', 'Unlabeled 9')], ['Unlabeled:8', 'Unlabeled 9']),
    ],
)
def test_labels_are_unique_and_in_order(
    take: Path, markers: list[tuple[str, str]], labels: list[str]
) -> None:
    columns = [column for kind, name in markers for column in marker(name, kind)]
    positions = np.arange(3.0 * len(markers)).reshape(1, -1, 3)
    sequence = read(take, text_of(header_rows(columns), data_rows(columns, positions, 1.0)))
    assert list(sequence.labels) == labels
    assert sequence.positions.tolist() == positions.tolist()


# --- gaps and time ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('cells', 'visible'),
    [
        ('1,2,3,4,5,6', [True, True]),
        (',,,4,5,6', [False, True]),
        ('1,2,3,,,', [True, False]),
        ('1,,3,4,5,6', [False, True]),
        ('1,2,3,,5,6', [True, False]),
        ('1,2,3,4,5,', [True, False]),
        (' ,1,2,4,5,6', [False, True]),
        ('1,2,3', [True, False]),  # trimmed by an editor at the end of a marker
        ('', [False, False]),
        (',,,,,', [False, False]),
    ],
)
def test_a_marker_is_visible_with_all_three_cells(
    take: Path, cells: str, visible: list[bool]
) -> None:
    row = f'2,0.02,{cells}' if cells else '2,0.02'
    sequence = read(take, simple(frames=2) + row + '\n3,0.03,9,9,9,8,8,8\n')
    assert sequence.visible.tolist() == [[True, True]] * 2 + [visible] + [[True, True]]
    expected = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    expected[~np.array(visible)] = np.nan
    np.testing.assert_array_equal(sequence.positions[2], expected)
    assert sequence.positions[3].tolist() == [[9.0] * 3, [8.0] * 3]


def test_a_marker_never_seen_keeps_its_column(take: Path) -> None:
    sequence = read(take, simple().replace('1.0,1.0,1.0\n', ',,\n'))
    assert sequence.labels == ('A', 'B')
    assert sequence.visible.tolist() == [[True, False]]


@pytest.mark.parametrize(
    ('rate', 'times', 'stamps'),
    [
        # The column rounds 1/360 s to milliseconds, the number of the frame does not.
        ('360.000000', '0 0.000,1 0.003,2 0.006,3 0.008', [0, 2777778, 5555556, 8333333]),
        ('120.000000', '0 0.000000,1 0.008333,2 0.016667', [0, 8333333, 16666667]),
        # Missing rows.
        ('100.000000', '0 0.000,1 0.010,5 0.050', [0, 10_000_000, 50_000_000]),
        # A part of a take, on the take's clock.
        ('100.000000', '700 7.000,701 7.010', [7_000_000_000, 7_010_000_000]),
        # 1.4 ms off is rounding, 1.6 ms off is another clock.
        ('100.000000', '0 0.0,1 0.0114', [0, 10_000_000]),
        ('100.000000', '0 0.0,1 0.0116', [0, 11_600_000]),
        ('100.000000', '700 0.0,701 0.010001', [0, 10_001_000]),
        # No rate, or none that makes sense.
        ('', '0 0.000000,1 0.008333', [0, 8_333_000]),
        ('0.000000', '0 0.0,1 0.008333', [0, 8_333_000]),
        ('auto', '0 0.0,1 0.008333', [0, 8_333_000]),
        # More than 9 million frames: nine hours at 360 Hz stay exact.
        ('360.000000', '11664001 32400.003', [32_400_002_777_778]),
    ],
)
def test_stamps(take: Path, rate: str, times: str, stamps: list[int]) -> None:
    first = {'Format Version': '1.23', **({'Export Frame Rate': rate} if rate else {})}
    rows = [[*pair.split(), '1', '2', '3'] for pair in times.split(',')]
    sequence = read(take, text_of(header_rows(marker('A')), rows, first))
    assert sequence.stamps.tolist() == stamps
    assert sequence.stamps.dtype == np.int64


# --- what is refused -------------------------------------------------------------------------

ANNOUNCED = {**FULL, 'Total Exported Frames': '4'}


@pytest.mark.parametrize(
    ('old', 'new', 'expected'),
    [
        ('Meters', 'Inches', 'unknown Length Units "Inches"'),
        ('Format Version', 'Time', "begins with 'Time,1.23,Export Frame Rate,100.000000,L'"),
        ('Format Version,1.23,', 'Format Version;1.23;', "begins with 'Format Version;1.23"),
        ('Frame,Time', 'Number,Time', 'no header row that begins with "Frame"'),
        ('Frame,Time (Seconds)', 'Frame,X', 'no "Time" column beside "Frame"'),
        (',Marker' * 6, ',Bone' * 6, 'no marker columns'),
        (',Position' * 6, ',Rotation' * 6, 'no marker columns'),
        ('X,Y,Z,X,Y,Z', 'X,Y,Z,X,Y,W', 'marker "B" does not have the columns X, Y, Z'),
        (',A,A,A,', ',A,A,C,', 'marker "A" does not have the columns X, Y, Z'),
        (',Position,Position\n', ',Position,Quality\n', 'marker "B" does not have the columns'),
        ('1,0.010000,', '1,0.000000,', '9: frame 1 at 0.000000 s is not later than'),
        ('1,0.010000,', '1,-0.010000,', '9: frame 1 at -0.010000 s is not later than'),
        ('1,0.010000,', '0,0.000000,', '9: frame 0 at 0.000000 s is not later than'),
        ('1,0.010000,', '1,,', '9: frame or time is missing or too large'),
        ('1,0.010000,', ',0.010000,', '9: frame or time is missing or too large'),
        ('1,0.010000,', '1,1e10,', '9: frame or time is missing or too large'),
        ('1,0.010000,', 'one,0.010000,', "9: frame: 'one' is no number"),
        ('1,0.010000,', '1,soon,', "9: time: 'soon' is no number"),
        ('1,0.010000,1.0', '1,0.010000,x' + 'y' * 99, '9: marker "A": \'x' + 'y' * 39 + "' is"),
        ('1,0.010000,1.0', '1,0.010000,1_0', '9: marker "A": \'1_0\' is no number'),
        ('1,0.010000,1.0', '1,0.010000,1.0,2.0', 'line 9 has 9 cells of 8: decimal commas?'),
        ('1,0.010000,1.0', '1,0.010000,"1.0', 'line 9 has 3 cells of 8: file truncated?'),
        ('1,0.010000,1.0', '1,0.010000,"' + 'y' * 200_000, '9: field larger than field limit'),
        ('1,0.010000,1.0,', '1,0.010000,', 'line 9 has 7 cells of 8: file truncated?'),
        ('1,0.010000' + ',1.0' * 6, '1', 'line 9 has 1 cells of 8: file truncated?'),
    ],
)
def test_a_broken_file_is_one_line(take: Path, old: str, new: str, expected: str) -> None:
    text = simple(frames=2)
    assert old in text
    assert failure(write(take, text.replace(old, new, 1))).startswith(expected)


@pytest.mark.parametrize('word', ['abc', 'nan', 'NaN', '-inf', 'Infinity', '1;5'])
@pytest.mark.parametrize(('column', 'label'), [(0, 'A'), (2, 'A'), (3, 'B'), (5, 'B')])
def test_a_bad_cell_is_named(take: Path, word: str, column: int, label: str) -> None:
    cells = ['1', '2', '3', '4', '5', '6']
    cells[column] = word
    text = simple(*cells, frames=3)
    assert failure(write(take, text)) == f'10: marker "{label}": \'{word}\' is no number'


@pytest.mark.parametrize('count', [3, 4, 6, 7])
def test_a_line_cut_inside_a_marker(take: Path, count: int) -> None:
    text = simple(*['1.0'] * (count - 2), frames=2) + '2,0.02,1,1,1,1,1,1\n'
    assert failure(write(take, text)) == f'line 9 has {count} cells of 8: file truncated?'


@pytest.mark.parametrize('lines', [6, 5, 4])
def test_a_header_alone(take: Path, lines: int) -> None:
    text = ''.join(simple().splitlines(keepends=True)[: lines + 1])
    expected = 'no frames below the header' if lines == 6 else 'no header row that begins with'
    assert failure(write(take, text)).startswith(expected)


@pytest.mark.parametrize(
    ('content', 'expected'),
    [
        (b'', 'empty file'),
        (b'\xef\xbb\xbf\r\n', 'empty file'),
        (b'Format Version,1.23\0', 'not a text file'),
        ('Format Version,1.23'.encode('utf-16'), 'not a text file'),
        (b'\x89PNG\r\n\x1a\n', "begins with '\u2030PNG': not a Motive CSV export"),
        (b'0,0.000000,1.0,2.0,3.0\n', "begins with '0,0.000000,1.0,2.0,3.0': not a Motive"),
        (b'Format Version,1.23\n,Type,Marker\nFrame\n', 'no "Time" column'),
        (b'Format Version,1.23\nFrame,Time\n', 'no marker columns'),
    ],
)
def test_not_a_motive_file(take: Path, content: bytes, expected: str) -> None:
    assert failure(write(take, content)).startswith(expected)


def test_no_file(tmp_path: Path) -> None:
    assert failure(tmp_path / 'none.csv') == 'cannot be read: No such file or directory'
    assert failure(tmp_path) == 'cannot be read: Is a directory'


# --- files that stop early -------------------------------------------------------------------


@pytest.mark.parametrize(
    ('cells', 'expected'),
    [
        (['1', '2', '3'], 'line 11 has 5 cells of 8: file truncated?'),  # at the end of a marker
        (['1', '2', '3', '4'], 'line 11 has 6 cells of 8: file truncated?'),
    ],
)
@pytest.mark.parametrize('eol', ['\n', '\r\n'])
def test_a_last_line_cut_short(take: Path, cells: list[str], expected: str, eol: str) -> None:
    text = simple(*cells, frames=4, first=ANNOUNCED).replace('\n', eol).removesuffix(eol)
    assert failure(write(take, text)) == expected


def test_no_end_of_line_with_frames_missing(take: Path) -> None:
    text = simple(frames=3, first=ANNOUNCED).removesuffix('\n')
    expected = '3 frames, but the header announces 4 and line 10 has no end: file truncated?'
    assert failure(write(take, text)) == expected


@pytest.mark.parametrize('first', [FULL, ANNOUNCED])
def test_no_end_of_line_with_all_frames_is_fine(take: Path, first: dict[str, str]) -> None:
    assert len(read(take, simple(frames=4, first=first).removesuffix('\n'))) == 4


def test_frames_missing_in_between_are_fine(take: Path) -> None:
    text = simple(frames=4, first=ANNOUNCED).replace('1,0.010000' + ',1.0' * 6 + '\n', '')
    assert read(take, text).stamps.tolist() == [0, 20_000_000, 30_000_000]


def test_frames_missing_at_the_end_are_reported(take: Path) -> None:
    write(take, simple(frames=3, first=ANNOUNCED))
    with pytest.warns(UserWarning, match='3 frames, but the header announces 4') as caught:
        assert len(read_motive_csv(take)) == 3
    assert [str(w.message) for w in caught] == [f'{take}: 3 frames, but the header announces 4']
    assert caught[0].filename == __file__


# --- real exports ----------------------------------------------------------------------------


def real(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f'no recording {path}')
    return path


@pytest.mark.parametrize('take_number', range(1, 7))
def test_rope(take_number: int) -> None:
    sequence = read_motive_csv(real(f'rope/rope_take{take_number}.csv'))
    assert sequence.positions.shape == (500, 13, 3)
    assert sequence.labels[::12] == ('Rope:Marker1', 'Rope:Marker13')
    assert sequence.visible.all()
    assert sequence.stamps[0] == 0
    assert (np.diff(sequence.stamps) == 10_000_000).all()
    gaps = np.linalg.norm(np.diff(sequence.positions, axis=1), axis=2)
    assert 0.01 < gaps.min() < gaps.max() < 0.2  # m between neighbours on a rope of about 1 m


def test_millimetres_at_360_hz() -> None:
    sequence = read_motive_csv(real('motive/ha5dzs_v1.23_markers.csv'))
    assert sequence.positions.shape == (1353, 18, 3)
    assert sequence.unlabelled.all()
    assert 100 * (1 - sequence.visible.mean()) == pytest.approx(8.4, abs=0.05)
    assert set(np.diff(sequence.stamps).tolist()) == {2_777_777, 2_777_778}
    expected = [2.659741943, -0.830793884, -2.862191650]
    np.testing.assert_allclose(sequence.positions[0, 0], expected, atol=1e-12)  # 1 rounding
    assert np.nanmax(np.abs(sequence.positions)) < 5.0


def test_rigid_body_and_columns_never_seen() -> None:
    sequence = read_motive_csv(real('motive/hmv_s16_v1.21.csv'))
    assert sequence.positions.shape == (250, 12, 3)
    assert sequence.labels[:3] == ('Rigid Body 1_1', 'Rigid Body 1_2', 'Rigid Body 1_3')
    assert sequence.labels[3:7:3] == ('Unlabeled:108', 'Rigid Body 1:Marker1')
    assert np.flatnonzero(~sequence.visible.any(axis=0)).tolist() == [9, 10, 11]
    assert sequence.stamps[-1] == 2_075_000_000
    assert sequence.positions[0, 0].tolist() == [0.009986, 0.019136, 0.009807]
    assert sequence.positions[0, 8].tolist() == [0.160012, 0.019159, 0.009836]


def test_export_without_markers() -> None:
    assert failure(real('motive/ha5dzs_v1.23_default.csv')).startswith('no marker columns')
