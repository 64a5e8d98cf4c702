"""The configuration: what a file may say, and the one line that names what it may not."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cloth_predict.config import Config, build, dump, flatten, load, nest, parse_yaml
from cloth_predict.errors import ConfigError

ROOT = Path(__file__).parents[1]
SHIPPED = sorted(ROOT.glob('config/*.yaml'))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / 'some.yaml'


def body(file: Path, text: str) -> Path:
    """Write lines below the ROS header."""
    lines = ''.join(f'    {line}\n' for line in text.splitlines())
    file.write_text(f'/**:\n  ros__parameters:\n{lines}', encoding='utf-8')
    return file


def failure(call: Callable[[], Config], source: str) -> str:
    """Return what the error says behind its source; it has to be one line that begins with it."""
    with pytest.raises(ConfigError) as caught:
        call()
    message = str(caught.value)
    assert message.startswith(f'{source}: ')
    assert '\n' not in message
    return message.removeprefix(f'{source}: ')


def refused(file: Path, text: str) -> str:
    return failure(lambda: load(body(file, text)), str(file))


# --- what a file may say ---------------------------------------------------------------------


def test_no_parameters_are_the_defaults(file: Path) -> None:
    assert load(body(file, '')) == Config()
    assert build({}, 'x') == Config()


def test_every_kind_of_value(file: Path) -> None:
    text = """
    horizon: 0.25
    labels: [b, a, c, d, e, f]
    model: {rows: 2, cols: 3, gravity: [0.0, 0.0, -9.81]}
    anchors:
      nodes: [5, 0]
      motion: constant_velocity
    replay: {loop: true, clock: false, seed: 7}
    """
    config = load(body(file, text))
    assert (config.horizon, config.labels) == (0.25, tuple('bacdef'))
    assert (config.model.rows, config.model.cols) == (2, 3)
    assert config.model.gravity == (0.0, 0.0, -9.81)
    assert (config.anchors.nodes, config.anchors.motion) == ((5, 0), 'constant_velocity')
    assert (config.replay.loop, config.replay.clock, config.replay.seed) == (True, False, 7)
    unchanged = {'force', 'filter', 'baseline', 'projector', 'frame'}
    for name in unchanged:
        assert getattr(config, name) == getattr(Config(), name)
    assert config.model.mass == Config().model.mass


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1e-3', 0.001),
        ('1E-3', 0.001),
        ('5e-1', 0.5),
        ('1e0', 1.0),
        ('.5', 0.5),
        ('0.5', 0.5),
        ('1', 1.0),
        ('10', 10.0),
        ('0', 0.0),
    ],
)
def test_numbers_for_a_float(file: Path, text: str, value: float) -> None:
    horizon = load(body(file, f'horizon: {text}')).horizon
    assert horizon == value
    assert type(horizon) is float


def test_integers_in_a_list_of_floats(file: Path) -> None:
    gravity = load(body(file, 'model: {gravity: [0, -1e1, 0]}')).model.gravity
    assert gravity == (0.0, -10.0, 0.0)
    assert {type(value) for value in gravity} == {float}


def test_yes_is_a_word_as_in_yaml_1_2() -> None:
    assert parse_yaml('[1e-3, yes, on, 010]') == [0.001, 'yes', 'on', 10]


@pytest.mark.parametrize('shipped', SHIPPED, ids=lambda path: path.name)
def test_shipped_files_load(shipped: Path) -> None:
    config = load(shipped)
    assert config != Config()
    assert load(shipped) == config
    assert len(config.anchors.nodes) < config.model.count


def test_shipped_files_are_there() -> None:
    assert {'towel.yaml', 'rope.yaml'} <= {path.name for path in SHIPPED}
    towel, rope = (load(ROOT / 'config' / f'{name}.yaml') for name in ('towel', 'rope'))
    assert (towel.model.rows, towel.model.cols, towel.anchors.nodes) == (5, 4, (0, 1, 2, 3))
    assert (rope.model.rows, rope.model.cols, rope.anchors.nodes) == (1, 13, (0, 12))
    assert towel.horizon == rope.horizon == 0.1


def test_a_configuration_cannot_be_changed() -> None:
    config = Config()
    groups = [value for value in vars(config).values() if dataclasses.is_dataclass(value)]
    assert len(groups) == 13
    for part in (config, *groups):
        for field in dataclasses.fields(part):
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(part, field.name, getattr(part, field.name))
    assert hash(config) == hash(Config())  # there are no lists inside


# --- dump and load ---------------------------------------------------------------------------


@pytest.mark.parametrize('shipped', [None, *SHIPPED], ids=lambda p: p.name if p else 'default')
def test_what_dump_wrote_loads_as_the_same(file: Path, shipped: Path | None) -> None:
    config = Config() if shipped is None else load(shipped)
    file.write_text(dump(config), encoding='utf-8')
    assert load(file) == config
    assert dump(load(file)) == dump(config)


@pytest.mark.parametrize(
    'value', [1e-300, 1e-5, 1e16, 1e17, 123456789.125, 0.1 + 0.2, 5e-324, 1.7e308]
)
def test_floats_survive_to_the_last_digit(file: Path, value: float) -> None:
    config = build({'model': {'mass': value}, 'projector': {'gamma': -value}}, 'x')
    file.write_text(dump(config), encoding='utf-8')
    assert load(file).model.mass == value
    assert load(file).projector.gamma == -value


WORDS = 'a: b|1|1e-3|true|yes|null|~|2020-01-01|0x10|.nan|<<|=|&a|*b|- a|{|[|#x|"|\'|%|@|!t|\\'


@pytest.mark.parametrize(
    'label', [*WORDS.split('|'), '', ' ', 'a\nb', '\t', 'Größe', '\u2028', 'long word ' * 30]
)
def test_labels_survive_whatever_they_look_like(file: Path, label: str) -> None:
    two = {'rows': 1, 'cols': 2}
    config = build({'labels': [label, 'x'], 'frame': label, 'model': two}, 'x')
    file.write_text(dump(config), encoding='utf-8')
    assert load(file).labels == (label, 'x')
    assert load(file).frame == label


def test_empty_lists_are_left_out_of_the_file() -> None:
    text = dump(Config())
    assert '[]' not in text
    assert 'labels' not in parse_yaml(text)['/**']['ros__parameters']
    one = {'rows': 1, 'cols': 1}
    assert 'labels: [a]' in dump(build({'labels': ['a'], 'model': one}, 'x'))
    assert 'nodes' not in parse_yaml(text)['/**']['ros__parameters']['anchors']


# --- names with dots -------------------------------------------------------------------------


def test_nest() -> None:
    flat = {'a': 1, 'b.c': 2, 'b.d.e': [3], 'b.d.f': 4, 'g.h': None}
    assert nest(flat) == {'a': 1, 'b': {'c': 2, 'd': {'e': [3], 'f': 4}}, 'g': {'h': None}}
    assert flat == {'a': 1, 'b.c': 2, 'b.d.e': [3], 'b.d.f': 4, 'g.h': None}
    assert nest({}) == {}
    assert flatten(nest(flat)) == flat
    assert flatten({}) == {}


def test_nested_names_build_what_a_file_builds() -> None:
    flat = {'horizon': 0.2, 'model.rows': 2, 'model.cols': 2, 'anchors.nodes': [0, 1]}
    config = build(nest(flat), 'parameters')
    assert (config.horizon, config.model.rows, config.anchors.nodes) == (0.2, 2, (0, 1))


# --- what is refused -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        # unknown
        ('horizonn: 1.0', 'horizonn: unknown parameter (did you mean horizon?)'),
        ('model: {row: 3}', 'model.row: unknown parameter (did you mean model.rows?)'),
        ('filter: {max_steps: 1}', 'filter.max_steps: unknown parameter (did you mean '
         'filter.max_step?)'),
        ('gravity: [0, 0, 0]', 'gravity: unknown parameter'),
        ('use_sim_time: true', 'use_sim_time: unknown parameter'),
        ('7: 1', '7: unknown parameter'),
        # types
        ('horizon: "0.1"', "horizon: expected float, got '0.1'"),
        ('horizon: true', 'horizon: expected float, got True'),
        ('horizon:', 'horizon: expected float, got None'),
        ('horizon: [0.1]', 'horizon: expected float, got [0.1]'),
        ('horizon: {s: 1}', "horizon: expected float, got {'s': 1}"),
        ('model: {rows: 5.0}', 'model.rows: expected int, got 5.0'),
        ('model: {rows: 1e1}', 'model.rows: expected int, got 10.0'),
        ('model: {rows: true}', 'model.rows: expected int, got True'),
        ('model: {rows: "5"}', "model.rows: expected int, got '5'"),
        ('replay: {loop: 1}', 'replay.loop: expected bool, got 1'),
        ('replay: {loop: yes}', "replay.loop: expected bool, got 'yes'"),
        ('frame: 3', 'frame: expected str, got 3'),
        ('frame: false', 'frame: expected str, got False'),
        ('labels: a', "labels: expected a list, got 'a'"),
        ('labels: 1', 'labels: expected a list, got 1'),
        ('labels: [a, 1]', 'labels: expected str, got 1'),
        ('labels: [a, [b]]', "labels: expected str, got ['b']"),
        ('anchors: {nodes: [0, 1.0]}', 'anchors.nodes: expected int, got 1.0'),
        ('anchors: {nodes: [true]}', 'anchors.nodes: expected int, got True'),
        ('anchors: {nodes: {1: 2}}', 'anchors.nodes: expected a list, got {1: 2}'),
        ('anchors: {nodes: !!set {1}}', 'anchors.nodes: expected a list, got {1}'),
        # groups
        ('model: 3', 'model: expected a mapping'),
        ('model:', 'model: expected a mapping'),
        ('model: [1]', 'model: expected a mapping'),
        ('- 1', 'parameters: expected a mapping'),
        # ranges
        ('horizon: -0.1', 'horizon: -0.1 is out of range, must be at least 0'),
        ('horizon: 10.5', 'horizon: 10.5 is out of range, must be at most 10'),
        ('model: {rows: 0}', 'model.rows: 0 is out of range, must be at least 1'),
        ('model: {mass: 0}', 'model.mass: 0 is out of range, must be above 0'),
        ('model: {mass: -1e-9}', 'model.mass: -1e-09 is out of range, must be above 0'),
        ('anchors: {nodes: [-1]}', 'anchors.nodes: -1 is out of range, must be at least 0'),
        ('horizon: .nan', 'horizon: nan is not finite'),
        ('horizon: .inf', 'horizon: inf is not finite'),
        ('projector: {gamma: -.inf}', 'projector.gamma: -inf is not finite'),
        ('filter: {process_noise: 1e999}', 'filter.process_noise: inf is not finite'),
        ('model: {gravity: [0, .nan, 0]}', 'model.gravity: nan is not finite'),
        # choices and lengths
        ('anchors: {motion: ekf}', "anchors.motion: 'ekf' is not one of fixed, "
         'constant_velocity, constant_acceleration, swing'),
        ('model: {topology: "e\\nf"}', "model.topology: 'e\\nf' is not one of grid, edges, "
         'delaunay, closed'),
        ('model: {gravity: [0, -9.81]}', 'model.gravity: expected 3 values, got 2'),
        ('model: {gravity: []}', 'model.gravity: expected 3 values, got 0'),
        ('projector: {rotation: [1, 0, 0]}', 'projector.rotation: expected 9 values, got 3'),
        # together
        ('anchors: {nodes: [20]}', 'anchors.nodes: node 20 does not exist, model.rows x '
         'model.cols has 20 nodes'),
        ('model: {rows: 1, cols: 2}\nanchors: {nodes: [0, 2]}', 'anchors.nodes: node 2 does not '
         'exist, model.rows x model.cols has 2 nodes'),
        ('anchors: {nodes: [1, 0, 1]}', 'anchors.nodes: a node is listed twice'),
        ('model: {rows: 1, cols: 2}\nanchors: {nodes: [1, 0]}', 'anchors.nodes: every node is '
         'driven, nothing is left to predict'),
    ],
)  # fmt: skip
def test_a_wrong_parameter_is_one_line_that_names_it(file: Path, text: str, expected: str) -> None:
    assert refused(file, text) == expected


def test_labels_that_are_not_as_many_as_the_nodes(file: Path) -> None:
    expected = 'labels: 2 labels, but model.rows x model.cols has 20 nodes'
    assert refused(file, 'labels: [a, b]') == expected


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('nodes: 3', 'nodes: has no meaning with topology grid'),
        ('edges: [0, 1]', 'edges: has no meaning with topology grid'),
        ('topology: mesh', "topology: 'mesh' is not one of grid, edges, delaunay, closed"),
        ('topology: delaunay, nodes: 9, edges: [0, 1], rest_length: measured',
         'edges: has no meaning with topology delaunay'),
        ('topology: delaunay, rest_length: measured', 'nodes: topology delaunay needs a number of '
         'nodes of at least 3, here or by labels'),
        ('topology: edges, nodes: 1, rest_length: measured', 'nodes: topology edges needs a '
         'number of nodes of at least 2, here or by labels'),
        ('topology: delaunay, nodes: 9', 'rest_length: width and height tell nothing of topology '
         'delaunay; choose measured or calibrated'),
    ],
)  # fmt: skip
def test_topologies_that_do_not_fit(file: Path, text: str, expected: str) -> None:
    assert refused(file, f'model: {{{text}}}') == f'model.{expected}'


@pytest.mark.parametrize(
    ('edges', 'expected'),
    [
        ('', 'no edges lead from node 0 to node 4'),
        ('0, 1, 2', 'expected pairs of nodes, got 3 numbers'),
        ('0, 5', 'node 5 does not exist, model.nodes has 5 nodes'),
        ('0, 1, 2, 2', 'node 2 is joined with itself'),
        ('0, 1, 1, 2, 2, 1', 'the pair 2, 1 is listed twice'),
        ('0, 1, 1, 2, 3, 4', 'no edges lead from node 0 to node 3'),
        ('4, 3, 0, 2, 2, 4', 'no edges lead from node 0 to node 1'),
    ],
)
def test_edges_that_are_no_mesh(file: Path, edges: str, expected: str) -> None:
    text = f'{{topology: edges, nodes: 5, rest_length: measured, edges: [{edges}]}}'
    assert refused(file, f'model: {text}') == f'model.edges: {expected}'


def test_the_size_of_a_surface(file: Path) -> None:
    model = load(body(file, 'model: {rows: 2, cols: 3}')).model
    assert (model.count, model.shape, model.name) == (6, (2, 3), '2 x 3 = 6 nodes')
    text = '{topology: edges, rest_length: calibrated, edges: [0, 2, 2, 1]}'
    labelled = load(body(file, f'labels: [a, b, c]\nmodel: {text}'))
    model = labelled.model
    assert (model.count, model.shape, model.name) == (3, (1, 3), '3 nodes')
    file.write_text(dump(labelled), encoding='utf-8')
    assert load(file) == labelled
    expected = 'labels: 2 labels, but model.nodes has 4 nodes'
    text = 'labels: [a, b]\nmodel: {topology: delaunay, nodes: 4, rest_length: measured}'
    assert refused(file, text) == expected
    text = 'anchors: {nodes: [4]}\nmodel: {topology: delaunay, nodes: 4, rest_length: measured}'
    message = 'anchors.nodes: node 4 does not exist, model.nodes has 4 nodes'
    assert refused(file, text) == message


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('model: {kind: superquadric}', 'model.nodes: topology closed needs a number of nodes of '
         'at least 4, here or by labels'),
        ('model: {kind: superquadric, nodes: 9, topology: delaunay}', 'model.topology: delaunay '
         'has no meaning with kind superquadric'),
        ('model: {topology: closed, nodes: 9}', 'model.topology: closed has no meaning with kind '
         'mass_spring'),
        ('model: {kind: superquadric, nodes: 9}\nanchors: {nodes: [0]}', 'anchors.nodes: has no '
         'meaning with model.kind superquadric'),
        ('model: {kind: superquadric, nodes: 9}\nwind: {kind: normal}', 'wind.kind: has no '
         'meaning with model.kind superquadric'),
        ('model: {kind: superquadric, nodes: 9, masses: [1.0]}', 'model.masses: 1 values, but the '
         'model has 9 nodes'),
        ('model: {kind: superquadric, nodes: 9}\nbody: {nodes: 3}', 'body.nodes: a closed mesh '
         'has at least 4 nodes'),
        ('model: {kind: superquadric, nodes: 9}\nfilter: {kind: reduced_rank}', 'filter.kind '
         'reduced_rank does not work with model.kind superquadric'),
        ('filter: {kind: decoupled}', 'filter.kind decoupled does not work with model.kind '
         'mass_spring'),
        ('model: {kind: superquadric, nodes: 4}\nlabels: [a, b, c, d, e]', 'labels: 5 labels, but '
         'model.nodes has only 4 nodes'),
    ],
)  # fmt: skip
def test_bodies_that_do_not_fit(file: Path, text: str, expected: str) -> None:
    assert refused(file, text) == expected


def test_the_size_of_a_body(file: Path) -> None:
    config = load(body(file, 'model: {kind: superquadric, nodes: 30}\nlabels: [a, b]'))
    model = config.model
    assert (model.is_body, model.topology, model.count, model.shape) == (
        True, 'closed', 30, (1, 30)
    )  # fmt: skip
    assert not config.nodes_are_markers
    file.write_text(dump(config), encoding='utf-8')
    assert load(file) == config
    text = 'labels: [a, b, c, d]\nmodel: {kind: superquadric}\nbody: {mesh: markers}'
    assert load(body(file, text)).nodes_are_markers
    assert not load(body(file, f'{text[:-1]}, nodes: 4}}')).nodes_are_markers


def test_a_label_listed_twice(file: Path) -> None:
    assert refused(file, 'labels: [a, b, a]').startswith('labels: ')


def test_a_name_with_a_line_break_is_one_line(file: Path) -> None:
    assert 'unknown parameter' in refused(file, '"hori\\nzon": 1')


@pytest.mark.parametrize('digits', [309, 5000])
@pytest.mark.parametrize('name', ['horizon', 'model.rows', 'anchors.nodes'])
def test_an_integer_beyond_any_float(file: Path, name: str, digits: int) -> None:
    *group, last = name.split('.')
    number = '1' + '0' * digits
    value = f'[{number}]' if last == 'nodes' else number
    text = f'{group[0]}:\n  {last}: {value}' if group else f'{last}: {value}'
    assert len(refused(file, text)) > 0


def leaves(kind: type = Config, prefix: str = '') -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Yield the dotted name, type and limits of every parameter."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(hints[field.name]):
            yield from leaves(hints[field.name], f'{field.name}.')
        else:
            yield f'{prefix}{field.name}', hints[field.name], dict(field.metadata)


LEAVES = list(leaves())
every_parameter = pytest.mark.parametrize(
    ('name', 'kind', 'limits'), LEAVES, ids=[name for name, _, _ in LEAVES]
)


MESH = {'model.topology': 'edges', 'model.rest_length': 'measured'}
BESIDE = {'model.nodes': MESH, 'model.edges': {**MESH, 'model.nodes': 2}}
BESIDE |= {f'model.{name}': {} for name in ('springs', 'dampers', 'masses', 'loads')}
"""Parameters that mean nothing without others, whose values within the limits have tests apart."""


def refused_as(name: str, value: Any) -> str:
    return failure(lambda: build(nest({name: value}), 'here'), 'here')


def item_of(kind: Any) -> Any:
    return typing.get_args(kind)[0] if typing.get_origin(kind) is tuple else kind


def of_kind(kind: Any, value: Any, limits: dict[str, Any]) -> Any:
    """Make the value a list where the parameter is one."""
    if typing.get_origin(kind) is not tuple:
        return value
    return [value] * (limits['length'] or 1)


@every_parameter
def test_every_parameter_is_described(name: str, kind: Any, limits: dict[str, Any]) -> None:
    assert limits['doc'].strip()
    assert '\n' not in limits['doc'] + limits['unit']


@every_parameter
def test_every_parameter_checks_its_type(name: str, kind: Any, limits: dict[str, Any]) -> None:
    item = item_of(kind)
    fits = {float: (float, int), int: (int,), str: (str,), bool: (bool,)}[item]
    wrong = [v for v in (None, 'word', True, 3, 0.5, [[1]], {'x': 1}) if type(v) not in fits]
    assert len(wrong) >= 5
    in_list = item is not kind
    for value in wrong:
        assert refused_as(name, [value] if in_list else value) == (
            f'{name}: expected {item.__name__}, got {value!r}'
        )
        if in_list and not isinstance(value, (list, dict)):
            assert refused_as(name, value) == f'{name}: expected a list, got {value!r}'


@every_parameter
def test_every_parameter_checks_its_limits(name: str, kind: Any, limits: dict[str, Any]) -> None:
    def made(value: Any) -> Config:
        return build(nest({**BESIDE.get(name, {}), name: of_kind(kind, value, limits)}), 'here')

    step = 1 if item_of(kind) is int else 1e-6
    outside = {
        'low': lambda low: low - step,
        'high': lambda high: high + step,
        'above': lambda above: above,
    }
    checked = [key for key in outside if limits[key] is not None]
    for key in checked:
        bad = outside[key](limits[key])
        message = failure(lambda bad=bad: made(bad), 'here')
        assert message.startswith(f'{name}: {bad} is out of range, must be ')
    for key in ('low', 'high'):
        if limits[key] is not None and name not in BESIDE:
            assert made(limits[key]) != made(limits[key] + (step if key == 'low' else -step))
    if item_of(kind) is float:
        for value in (math.nan, math.inf, -math.inf):
            assert failure(lambda v=value: made(v), 'here') == f'{name}: {value} is not finite'
    if limits['length'] is not None:
        for count in (limits['length'] - 1, limits['length'] + 1):
            tree = nest({name: [0.5] * count})
            expected = f'{name}: expected {limits["length"]} values, got {count}'
            assert failure(lambda t=tree: build(t, 'here'), 'here') == expected


# --- files that are none ---------------------------------------------------------------------

NO_TOP = "no '/**: ros__parameters:' at the top"


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('', NO_TOP),
        ('# only a comment\n', NO_TOP),
        ('word', NO_TOP),
        ('[1, 2]', NO_TOP),
        ('horizon: 0.1', NO_TOP),
        ('/**:', NO_TOP),
        ('/**: [1]', NO_TOP),
        ('/**: {horizon: 0.1}', NO_TOP),
        ('ekf_node: {ros__parameters: {horizon: 0.1}}', NO_TOP),
        ('/**: {ros__parameters: 3}', 'parameters: expected a mapping'),
        ('/**: {ros__parameters: []}', 'parameters: expected a mapping'),
        ('{', 'not YAML: '),
        ('a: b: c', 'not YAML: '),
        ('a: "', 'not YAML: '),
        ('\t', 'not YAML: '),
        ('\0', 'not YAML: '),
        ('a: 1\n---\nb: 2\n', 'not YAML: '),
        ('a: *nowhere', 'not YAML: '),
        ('/**: {ros__parameters: {horizon: 1, horizon: 2}}', 'not YAML: '),
        ('a: !!python/object:os.system x', 'not YAML: '),
        # well-formed, but what it says cannot be made
        ('/**: {ros__parameters: {horizon: 2020-13-45}}', ''),
        ('/**: {ros__parameters: {horizon: !!int x}}', ''),
        ('/**: {ros__parameters: {horizon: !!float x}}', ''),
        ('{a: ' * 2000, ''),
    ],
)  # fmt: skip
def test_a_file_that_is_no_parameter_file(file: Path, text: str, expected: str) -> None:
    file.write_text(text, encoding='utf-8')
    assert failure(lambda: load(file), str(file)).startswith(expected)


def test_bytes_that_are_no_text(file: Path) -> None:
    file.write_bytes(b'/**:\n  ros__parameters:\n    frame: Gr\xf6\xdfe\n')
    assert failure(lambda: load(file), str(file)).startswith("not YAML: 'utf-8' codec can't")


def test_a_missing_file(tmp_path: Path) -> None:
    assert (
        failure(lambda: load(tmp_path / 'x'), f'{tmp_path / "x"}') == 'No such file or directory'
    )
    assert failure(lambda: load(tmp_path), f'{tmp_path}') == 'Is a directory'


def test_the_source_of_ros_parameters_is_named() -> None:
    message = failure(lambda: build({'horizon': 'soon'}, 'parameters of ekf_node'), 'parameters '
                      'of ekf_node')  # fmt: skip
    assert message == "horizon: expected float, got 'soon'"
