"""Shared by the tests of files and commands."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import domains
import pytest

from cloth_predict.performance import one_core

# read when OpenCV is imported, which some tests do before the package does
os.environ.setdefault('OPENCV_LOG_LEVEL', 'SILENT')

DATA = Path(os.environ.get('CLOTH_PREDICT_DATA', Path(__file__).parents[2] / 'shared' / 'data'))


@pytest.fixture(autouse=True, scope='session')
def quick() -> Iterator[None]:
    """Run all tests as the commands and the nodes run."""
    with one_core():
        yield


@pytest.fixture(autouse=True, scope='session')
def apart() -> None:
    """Keep what commands start from being heard by whatever else runs on this machine."""
    os.environ['ROS_DOMAIN_ID'] = str(domains.OF_COMMANDS)


@pytest.fixture
def real() -> Callable[[str], Path]:
    """Give the path of a real recording; the test skips where it is absent."""

    def find(name: str) -> Path:
        if not (DATA / name).exists():
            pytest.skip(f'no recording {DATA / name}')
        return DATA / name

    return find


@pytest.fixture
def parameters(tmp_path: Path) -> Callable[..., Path]:
    """Write the given parameters into a file and give its path."""

    def write(**values: Any) -> Path:
        path = tmp_path / 'parameters.yaml'
        path.write_text(json.dumps({'/**': {'ros__parameters': values}}))  # JSON is YAML 1.2
        return path

    return write


@pytest.fixture
def graph() -> Iterator[Any]:
    """Give a live graph of its own to a test."""
    from live_graph import Graph  # ROS takes a second to import, which few tests need

    found = Graph()
    yield found
    found.close()
