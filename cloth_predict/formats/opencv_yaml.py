"""YAML as OpenCV's FileStorage writes it, with tags of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode

from cloth_predict.errors import FormatError


def parse(path: Path) -> Any:
    """Return what the file holds, as lists and mappings of what has a tag.

    Raises FormatError, which names the file, where it cannot be read or is no YAML.
    """
    try:
        text = path.read_text(encoding='utf-8')
    except OSError as error:
        raise FormatError(f'{path}: cannot be read: {error.strerror}') from None
    except ValueError:
        raise FormatError(f'{path}: not a text file, so no calibration') from None
    yaml = YAML(typ='safe', pure=True)
    yaml.Constructor = _Untagged
    try:
        return yaml.load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        raise FormatError(f'{path}: not YAML: {" ".join(str(error).split())}') from None


class _Untagged(SafeConstructor):
    """Takes what has an unknown tag as if it had none."""

    def plain(self, node: Node) -> Any:
        if isinstance(node, MappingNode):
            return self.construct_mapping(node, deep=True)
        if isinstance(node, SequenceNode):
            return self.construct_sequence(node, deep=True)
        return self.construct_scalar(node)


_Untagged.add_constructor(None, _Untagged.plain)
