"""A recording of markers as a file that holds the model, and what it does not expect."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cloth_predict import __version__
from cloth_predict.config import Config, dump
from cloth_predict.config.ruler_video import RulerVideoConfig
from cloth_predict.encoding.container import (
    ENCODING,
    FRAMES,
    VERSION,
    EncodedWriter,
    create_encoded,
)
from cloth_predict.encoding.expectation import Expectation, expecting
from cloth_predict.encoding.numbers import packed, packed_residual, packed_stamps
from cloth_predict.encoding.rounding import cheapest, offset_for, rounded
from cloth_predict.errors import FormatError
from cloth_predict.formats.bag import LATEST
from cloth_predict.types import IntArray, MarkerSequence

BLOCK = 100
"""Frames in a message: what a fault costs at most."""


def write_encoded(
    output: Path,
    markers: MarkerSequence,
    config: Config | RulerVideoConfig,
    max_error: float,
    source: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write markers so that no coordinate that is rebuilt as float32 is off by over the bound.

    max_error [m]: of the distance of a marker. Raises FormatError naming the source where the
    markers are not those of the model, or the bound is below what float32 resolves.
    """
    stamps = markers.stamps
    if stamps.min() < 0 or stamps.max() >= LATEST:
        raise FormatError(f'{source}: a stamp is negative, or more than a message can hold')
    step = step_of(markers, max_error, source)
    expectation = expecting(config, markers.labels, markers.frame_id, step, source)
    with create_encoded(output) as file:
        file.write(
            ENCODING,
            int(markers.stamps[0]),
            version=VERSION,
            software=__version__,
            parameters=dump(config),
            labels=list(markers.labels),
            frame_id=markers.frame_id,
            max_error=max_error,
            step=step,
            frames=len(markers),
        )
        for first in range(0, len(markers), BLOCK):
            frames = np.arange(first, min(first + BLOCK, len(markers)))
            _write_block(file, markers, frames, expectation, step)
            progress(len(frames), len(markers))


def step_of(markers: MarkerSequence, max_error: float, source: str) -> float:
    """Step [m] at which rounding each coordinate, to it and to float32, keeps the bound [m]."""
    largest = np.abs(markers.positions[markers.visible]).max(initial=0.0)
    # half a spacing of float32 in each of three coordinates, and what float64 loses on the way
    lost = np.sqrt(3.0) * 0.5 * float(np.spacing(np.float32(largest))) * (1 + 1e-6)
    if max_error <= 2 * lost:
        raise FormatError(
            f'{source}: an error of {1e3 * max_error:g} mm is not above what a bag resolves this '
            f'far from the origin, {2e3 * lost:.2g} mm'
        )
    return float(2.0 / np.sqrt(3.0) * (max_error - lost))


def _write_block(
    file: EncodedWriter,
    markers: MarkerSequence,
    frames: IntArray,
    expectation: Expectation,
    step: float,
) -> None:
    visible, rounding, residuals = markers.visible[frames], [], []
    rebuilt = np.zeros((len(frames), len(markers.labels), 3), np.int64)
    for multiples, k in zip(rebuilt, frames.tolist(), strict=True):
        stamp, seen = int(markers.stamps[k]), markers.visible[k]
        expected = expectation.at(stamp)
        rounding.append(offset_for(expected))
        base = rounded(expected, rounding[-1])[seen]
        multiples[seen] = cheapest(markers.positions[k][seen] / step, base)
        residuals.append((multiples[seen] - base).ravel())
        expectation.take(stamp, multiples, seen)
    small, large = packed_residual(np.concatenate(residuals))
    file.write(
        FRAMES,
        int(markers.stamps[frames[0]]),
        frames=len(frames),
        stamps=packed_stamps(markers.stamps[frames]),
        visible=packed(np.packbits(visible)),
        rounding=packed(np.array(rounding, np.uint8)),
        residual=small,
        large=large,
        checksum=checksum(rebuilt),
    )


def checksum(rebuilt: IntArray) -> int:
    """CRC-32 of the multiples of the step of some frames, shape (frames, markers, 3)."""
    return zlib.crc32(rebuilt.astype('<i8').tobytes())
