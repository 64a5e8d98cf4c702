"""Files and folders that are written: what fails is told by their name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cloth_predict.errors import FormatError


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise FormatError, which names the path, where what is done within cannot be written."""
    try:
        yield
    except OSError as error:
        raise FormatError(f'{path}: cannot be written: {error.strerror or error}') from None


def make_folder(path: Path) -> None:
    """Make a folder, and those above it. Raises FormatError where that cannot be."""
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
