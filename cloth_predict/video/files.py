"""Videos as files: MP4, and folders of numbered PNG files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from cloth_predict.errors import FormatError
from cloth_predict.formats.files import make_folder
from cloth_predict.video.opencv import cv2

Picture = NDArray[np.uint8]
"""Blue, green, red, shape (height, width, 3)."""


@dataclass(frozen=True)
class Frame:
    """A picture, its number from 0 on, and when it was taken [ns]."""

    number: int
    stamp: int
    picture: Picture


def frames(path: Path, fps: float) -> Iterator[Frame]:
    """Read a video frame by frame; fps: of a folder of PNG files, whose names number them.

    Raises FormatError, after all frames before it, for one that cannot be read.
    """
    yield from _numbered(path, fps) if path.is_dir() else _film(path)


def picture_in(path: Path) -> Picture:
    """Read a picture. Raises FormatError."""
    found = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if found is None:
        raise FormatError(f'{path}: {"no picture" if path.is_file() else "no such file"}')
    return np.asarray(found, np.uint8)


def rate_of(path: Path, fps: float) -> float:
    """Frames per second of a video."""
    if path.is_dir():
        return fps
    return float(_opened(path).get(cv2.CAP_PROP_FPS))


def _opened(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise FormatError(f'{path}: no such file or folder')
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not video.isOpened() or video.get(cv2.CAP_PROP_FPS) <= 0:
        raise FormatError(f'{path}: no video that can be read')
    return video


def _film(path: Path) -> Iterator[Frame]:
    video = _opened(path)
    rate, count = video.get(cv2.CAP_PROP_FPS), round(video.get(cv2.CAP_PROP_FRAME_COUNT))
    number = -1
    try:
        while True:
            good, picture = video.read()
            if not good:
                break
            # where the time of a frame is not told, frames are taken to follow each other
            told = round(1e-3 * video.get(cv2.CAP_PROP_POS_MSEC) * rate)
            number = max(told, number + 1)
            yield Frame(number, round(1e9 * number / rate), np.asarray(picture, np.uint8))
    finally:
        video.release()
    if number + 1 < count:
        raise FormatError(f'{path}: frame {number + 1} of {count} cannot be read')


def _numbered(path: Path, fps: float) -> Iterator[Frame]:
    found = {}
    for file in path.glob('*.png'):
        digits = re.search(r'(\d+)\.png$', file.name)
        if digits is None:
            raise FormatError(f'{file}: its name does not end in a number')
        found[int(digits[1])] = file
    if not found:
        raise FormatError(f'{path}: no PNG file')
    for number, file in sorted(found.items()):
        yield Frame(number, round(1e9 * number / fps), picture_in(file))


class Writer:
    """Writes pictures of one size: into an MP4 file, or, without a suffix, a folder of PNGs."""

    def __init__(self, path: Path, fps: float) -> None:
        """Prepare; the first picture says the size. Raises FormatError for other suffixes."""
        if path.suffix not in ('', '.mp4'):
            raise FormatError(f'{path}: a video is an .mp4 file, or a folder of PNG files')
        self._path, self._fps, self._count = path, fps, 0
        self._video: cv2.VideoWriter | None = None

    def __enter__(self) -> Writer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._video is not None:
            self._video.release()

    def write(self, picture: Picture) -> None:
        """Add a picture. Raises FormatError."""
        if self._path.suffix:
            self._add(picture)
        else:
            make_folder(self._path)
            self._keep(self._path / f'{self._count:06d}.png', picture)
        self._count += 1

    def _add(self, picture: Picture) -> None:
        if self._video is None:
            make_folder(self._path.parent)
            code, size = cv2.VideoWriter.fourcc(*'mp4v'), picture.shape[1::-1]
            self._video = cv2.VideoWriter(str(self._path), code, self._fps, size)
            if not self._video.isOpened():
                raise FormatError(f'{self._path}: cannot be written')
        self._video.write(picture)

    @staticmethod
    def _keep(path: Path, picture: Picture) -> None:
        if not cv2.imwrite(str(path), picture):
            raise FormatError(f'{path}: cannot be written')
