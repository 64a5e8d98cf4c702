"""Reads any recording that the project knows, by what is at the path."""

from __future__ import annotations

import os
from pathlib import Path

from cloth_predict.errors import FormatError
from cloth_predict.formats.bag import Recording, read_recording
from cloth_predict.formats.motive_csv import read_motive_csv


def read(path: Path) -> Recording:
    """Read a bag (a folder, .mcap or .db3) or a Motive CSV export.

    Raises FormatError with one line that names the file and what is wrong with it.
    """
    if not os.path.exists(path):  # a name too long for any file is an error of Path.exists
        raise FormatError(f'{path}: no such file or folder')
    if path.is_dir() or path.suffix in ('.mcap', '.db3'):
        return read_recording(path)
    if path.suffix.lower() == '.csv':
        return Recording(read_motive_csv(path))
    raise FormatError(f'{path}: neither a bag (folder, .mcap, .db3) nor a Motive .csv')
