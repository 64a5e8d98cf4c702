"""The markers of an encoded recording, rebuilt."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloth_predict.config import Config, build, parse_yaml
from cloth_predict.config.ruler_video import RulerVideoConfig, build_ruler_video
from cloth_predict.encoding.container import ENCODING, read_encoded
from cloth_predict.encoding.encode import checksum
from cloth_predict.encoding.expectation import Expectation, expecting
from cloth_predict.encoding.numbers import unpacked, unpacked_residual, unpacked_stamps
from cloth_predict.encoding.rounding import rounded
from cloth_predict.errors import FormatError
from cloth_predict.tracker import NANOSECONDS
from cloth_predict.types import BoolArray, FloatArray, IntArray, MarkerSequence, Surface

Progress = Callable[[int, int], None]
"""Called with the frames done since the last call, and the total."""


@dataclass(frozen=True)
class Decoded:
    """A recording up to the end of its file, or to the first fault in it.

    config: of the surface, or of the bar in a video; markers: as recorded but for the bound [m];
    nodes: what the tracker took for each node, in order, of a surface with rows and columns in
    `shape`; states: what the filter made of each frame, None where there was no surface,
    or none were asked for; fault: what is wrong with the file; empty of a sound one.
    """

    config: Config | RulerVideoConfig
    markers: MarkerSequence
    nodes: MarkerSequence
    shape: tuple[int, int]
    max_error: float
    states: tuple[Surface | None, ...] = ()
    fault: str = ''


class _Frame(NamedTuple):
    """A rebuilt frame, and what the tracker made of it."""

    stamp: int
    positions: FloatArray
    visible: BoolArray
    nodes: FloatArray
    taken: BoolArray
    state: Surface | None


def read_markers(
    path: Path, states: bool = False, progress: Progress = lambda done, total: None
) -> Decoded:
    """Rebuild the markers of a file; of a damaged one those before the fault.

    Raises FormatError naming the file where there is no frame before the fault, or the version is
    not known.
    """
    messages = read_encoded(path)
    header = _header(messages, path)
    parameters = parse_yaml(header.parameters)['/**']['ros__parameters']
    of_bar = 'ruler' in parameters
    config = (build_ruler_video if of_bar else build)(parameters, str(path))
    labels = tuple(header.labels)
    expectation = expecting(config, labels, header.frame_id, header.step, str(path))
    frames, fault = list[_Frame](), ''
    try:
        for _, message in messages:
            frames += _rebuilt(message, expectation, header, states, path)
            progress(int(message.frames), int(header.frames))
            if len(frames) >= header.frames:
                break
        else:
            raise FormatError(f'{path}: ends before the last of {header.frames} frames')
    except FormatError as error:
        fault = str(error)
        if not frames:
            raise
    stamps, positions, visible, nodes, taken, found = zip(*frames, strict=True)
    at = np.array(stamps, np.int64)
    return Decoded(
        config,
        MarkerSequence(at, labels, np.array(positions), np.array(visible), header.frame_id),
        MarkerSequence(at, expectation.nodes, np.array(nodes), np.array(taken), header.frame_id),
        expectation.shape,
        float(header.max_error),
        found,
        fault,
    )


def _header(messages: Iterator[tuple[str, Any]], path: Path) -> Any:
    """Return the first message. Raises FormatError where it is another one."""
    topic, header = next(messages, ('', None))
    if header is None or topic != ENCODING:
        raise FormatError(f'{path}: not a recording made by `encode`')
    return header


def _rebuilt(
    message: Any, expectation: Expectation, header: Any, states: bool, path: Path
) -> list[_Frame]:
    """Rebuild the frames of a message. Raises FormatError where they are not those encoded."""
    count, markers = int(message.frames), len(header.labels)
    try:
        stamps = unpacked_stamps(message.stamps, count).tolist()
        offsets = unpacked(message.rounding, 'u1', count).tolist()
        bits = np.unpackbits(unpacked(message.visible, 'u1'), count=count * markers)
        visible = bits.astype(bool).reshape(count, markers)
        residual = np.zeros((count, markers, 3), np.int64)
        large = message.residual, message.large
        residual[visible] = unpacked_residual(*large, 3 * int(visible.sum())).reshape(-1, 3)
        multiples, found = np.zeros_like(residual), list[_Frame]()
        for k, (stamp, seen) in enumerate(zip(stamps, visible, strict=True)):
            base = rounded(expectation.at(stamp), offsets[k])
            multiples[k] = np.where(seen[:, None], base + residual[k], 0)
            found.append(_frame(expectation, stamp, multiples[k], seen, header.step, states))
    except (ValueError, zlib.error) as error:
        raise FormatError(f'{path}: damaged: {error}') from None
    if checksum(multiples) != message.checksum:
        raise FormatError(
            f'{path}: from {(stamps[0]) / NANOSECONDS:.2f} s on the markers are not those that '
            'were encoded: what predicts here does so otherwise than what encoded them (version '
            f'{header.software})'
        )
    return found


def _frame(
    expectation: Expectation,
    stamp: int,
    multiples: IntArray,
    visible: BoolArray,
    step: float,
    states: bool,
) -> _Frame:
    taken = expectation.take(stamp, multiples, visible)
    positions = np.where(visible[:, None], multiples * step, np.nan)
    return _Frame(
        stamp,
        positions,
        visible,
        taken.positions,
        taken.visible,
        expectation.estimate() if states else None,
    )
