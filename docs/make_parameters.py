"""Prints docs/parameters.md from the configuration's dataclasses."""

from __future__ import annotations

import dataclasses
import typing

from cloth_predict.config import Config
from cloth_predict.config.ruler_video import RulerVideoConfig

HEAD = """# Parameters

One YAML file in ROS parameter format serves all nodes and the command line (`config/towel.yaml`
is an example). Everything has a default; an unknown name, a wrong type or a value out of range
stops a node at its start with one line that names the parameter. Units are SI.

This page is made by `python docs/make_parameters.py > docs/parameters.md`.
"""


def limits(meta: typing.Mapping[str, typing.Any]) -> str:
    """Values that a parameter may take, in words."""
    found = []
    if meta['choices']:
        found.append(' or '.join(f'`{choice}`' for choice in meta['choices']))
    for key, sign in (('above', '>'), ('low', '≥'), ('high', '≤')):
        if meta[key] is not None:
            found.append(f'{sign} {meta[key]:g}')
    if meta['length'] is not None:
        found.append(f'{meta["length"]} values')
    return ', '.join(found)


def shown(value: object) -> str:
    """Default value as YAML."""
    if isinstance(value, tuple):
        return f'`[{", ".join(str(v) for v in value)}]`' if value else 'none'
    if isinstance(value, bool):
        return f'`{str(value).lower()}`'
    return f'`{value}`' if value != '' else 'none'


def section(kind: type, prefix: str, title: str) -> list[str]:
    """Table of one group and, after it, of the groups inside it."""
    hints = typing.get_type_hints(kind)
    lines = [f'## {title}', '', (kind.__doc__ or '').strip(), '']
    lines += ['| parameter | default | unit | may be | meaning |', '|---|---|---|---|---|']
    groups = []
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(hints[field.name]):
            inner = typing.cast('type', hints[field.name])
            groups += section(inner, f'{prefix}{field.name}.', f'`{field.name}`')
            continue
        meta = field.metadata
        cells = (f'`{prefix}{field.name}`', shown(field.default), meta['unit'], limits(meta))
        lines.append(f'| {" | ".join(cells)} | {meta["doc"]} |')
    return [*lines, '', *groups]


if __name__ == '__main__':
    print(HEAD)
    print('\n'.join(section(Config, '', 'General')))
    print('\n'.join(section(RulerVideoConfig, '', 'A bar in a video')).rstrip())
