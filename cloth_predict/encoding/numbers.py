"""Whole numbers as bytes: zlib streams, of what is small and at random by Huffman's code alone."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloth_predict.types import IntArray

ESCAPE = -128
"""Stands for a residual that is no int8."""


def packed(numbers: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a zlib stream of numbers of any kind, in order."""
    return _bytes(zlib.compress(numbers.astype(numbers.dtype.newbyteorder('<')).tobytes(), 9))


def unpacked(data: NDArray[np.uint8], kind: str, count: int | None = None) -> NDArray[Any]:
    """Return the numbers of a zlib stream, of this kind, such as `i8`.

    Raises ValueError where there are not `count` of them.
    """
    numbers = np.frombuffer(zlib.decompress(data.tobytes()), f'<{kind}')
    if count is not None and len(numbers) != count:
        raise ValueError(f'{len(numbers)} numbers in place of {count}')
    return numbers


def packed_residual(residual: IntArray) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return streams of small residuals, shape (m,), and of those that are larger.

    Small residuals repeat nothing, so that nothing but their frequencies is made use of.
    """
    small = np.abs(residual) < -ESCAPE
    stream = zlib.compressobj(9, strategy=zlib.Z_HUFFMAN_ONLY)
    first = stream.compress(np.where(small, residual, ESCAPE).astype('i1').tobytes())
    return _bytes(first + stream.flush()), packed(residual[~small])


def unpacked_residual(small: NDArray[np.uint8], large: NDArray[np.uint8], count: int) -> IntArray:
    """Return the residuals, shape (count,). Raises ValueError where there are not so many."""
    residual = unpacked(small, 'i1', count).astype(np.int64)
    escaped = residual == ESCAPE
    residual[escaped] = unpacked(large, 'i8', int(escaped.sum()))
    return residual


def packed_stamps(stamps: IntArray) -> NDArray[np.uint8]:
    """Return a stream of the second differences of stamps [ns], shape (m,)."""
    return packed(np.diff(stamps, 2, prepend=np.zeros(2, np.int64)))


def unpacked_stamps(data: NDArray[np.uint8], count: int) -> IntArray:
    """Return the stamps [ns], shape (count,)."""
    return np.cumsum(np.cumsum(unpacked(data, 'i8', count)))


def _bytes(data: bytes) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8)
