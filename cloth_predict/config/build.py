"""From YAML and ROS parameters to a configuration, and back.

`build` is strict: an unknown key, a wrong type or a value outside its range is an error that names
the parameter.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from array import array
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from cloth_predict.config.checks import check_together
from cloth_predict.config.schema import Config
from cloth_predict.errors import ConfigError

Group = typing.TypeVar('Group')


def build(values: dict[str, Any], source: str) -> Config:
    """Build the configuration from nested mappings; `source` names their origin in errors."""
    config = build_group(Config, values, source)
    model = config.model
    if model.is_body and model.topology == 'grid':  # which is the default
        model = dataclasses.replace(model, topology='closed')
    if model.topology != 'grid' and not model.nodes:
        model = dataclasses.replace(model, nodes=len(config.labels))
    config = dataclasses.replace(config, model=model)
    check_together(config, source)
    return config


def load(path: Path) -> Config:
    """Read a ROS parameter file: the parameters under `/**: ros__parameters:`."""
    return build(parameters_in(path), str(path))


def parameters_in(path: Path) -> dict[str, Any]:
    """Return what a ROS parameter file has under `/**: ros__parameters:`. Raises ConfigError."""
    try:
        document = parse_yaml(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigError(f'{path}: {error.strerror}') from None
    except (YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f'{path}: not YAML: {" ".join(str(error).split())}') from None
    try:
        values = document['/**']['ros__parameters']
    except (TypeError, KeyError):
        raise ConfigError(f"{path}: no '/**: ros__parameters:' at the top") from None
    return {} if values is None else values


def parse_yaml(text: str) -> Any:
    """Read YAML as ROS does: version 1.2, in which 1e-3 is a number."""
    return YAML(typ='safe').load(text)


def nest(flat: dict[str, Any]) -> dict[str, Any]:
    """Turn ROS' dotted names into nested mappings."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, last = name.split('.')
        branch = tree
        for group in groups:
            branch = branch.setdefault(group, {})
        branch[last] = value
    return tree


def flatten(tree: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    """Turn nested mappings into ROS' dotted names; the reverse of `nest`."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        name = f'{prefix}{key}'
        found |= flatten(value, f'{name}.') if isinstance(value, dict) else {name: value}
    return found


def build_group(kind: type[Group], values: Any, source: str, prefix: str = '') -> Group:
    """Build a dataclass of parameters from nested mappings; `prefix` goes before their names."""
    if not isinstance(values, dict):
        raise ConfigError(f'{source}: {prefix.rstrip(".") or "parameters"}: expected a mapping')
    hints = typing.get_type_hints(kind)
    fields = {f.name: f for f in dataclasses.fields(typing.cast('Any', kind))}
    chosen: dict[str, Any] = {}
    for key, value in values.items():
        name = f'{prefix}{key}'
        if key not in fields:
            close = difflib.get_close_matches(str(key), fields, n=1)
            hint = f' (did you mean {prefix}{close[0]}?)' if close else ''
            raise ConfigError(f'{source}: {name}: unknown parameter{hint}')
        if dataclasses.is_dataclass(hints[key]):
            chosen[key] = build_group(typing.cast('type', hints[key]), value, source, f'{name}.')
        else:
            chosen[key] = _value(hints[key], value, fields[key].metadata, f'{source}: {name}')
    return kind(**chosen)


def _value(hint: Any, value: Any, limits: typing.Mapping[str, Any], name: str) -> Any:
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, (list, tuple, array)):  # ROS gives arrays of numbers
            raise ConfigError(f'{name}: expected a list, got {value!r}')
        item = typing.get_args(hint)[0]
        items = tuple(_scalar(item, v, limits, name) for v in value)
        if limits['length'] is not None and len(items) != limits['length']:
            raise ConfigError(f'{name}: expected {limits["length"]} values, got {len(items)}')
        return items
    return _scalar(hint, value, limits, name)


def _scalar(kind: type, value: Any, limits: typing.Mapping[str, Any], name: str) -> Any:
    if isinstance(value, int) and value.bit_length() > 63:
        raise ConfigError(f'{name}: the number does not fit into 64 bits')
    accepted = (int, float) if kind is float else kind
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise ConfigError(f'{name}: expected {kind.__name__}, got {value!r}')
    if kind is str and limits['choices'] and value not in limits['choices']:
        raise ConfigError(f'{name}: {value!r} is not one of {", ".join(limits["choices"])}')
    if kind in (int, float):
        _check_range(value, limits, name)
    return kind(value)


def _check_range(number: Any, limits: typing.Mapping[str, Any], name: str) -> None:
    if not math.isfinite(number):
        raise ConfigError(f'{name}: {number} is not finite')
    for bad, words in (
        (limits['low'] is not None and number < limits['low'], f'at least {limits["low"]}'),
        (limits['high'] is not None and number > limits['high'], f'at most {limits["high"]}'),
        (limits['above'] is not None and number <= limits['above'], f'above {limits["above"]}'),
    ):
        if bad:
            raise ConfigError(f'{name}: {number} is out of range, must be {words}')


def dump(config: Any) -> str:
    """Return a ROS parameter file that `load` turns into the same configuration.

    Empty lists are left out: a ROS parameter file cannot hold one.
    """

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            pairs = ((f.name, plain(getattr(value, f.name))) for f in dataclasses.fields(value))
            return {name: inner for name, inner in pairs if inner != []}
        return list(value) if isinstance(value, tuple) else value

    text = StringIO()
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.dump({'/**': {'ros__parameters': plain(config)}}, text)
    return text.getvalue()
