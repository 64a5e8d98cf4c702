"""Finds the files that come with the package: in a source tree, or where it was installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def find(name: str) -> Path:
    """Path of a shipped file such as `config/towel.yaml`.

    A source tree comes first, then the prefixes of this Python and of ROS. The name itself where
    it is in none of them, so that the error names it.
    """
    prefixes = [sys.prefix, *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
    folders = [Path(__file__).parent.parent]
    folders += [Path(prefix, 'share', 'cloth_predict') for prefix in prefixes if prefix]
    for folder in folders:
        if (folder / 'package.xml').is_file() and (folder / name).exists():
            return folder / name
    return Path(name)
