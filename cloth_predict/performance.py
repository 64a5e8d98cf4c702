"""Settings of the process for many small matrices on one core."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
KEPT = 2**31 - 1
"""Bytes of freed memory that stay with the process."""
LARGEST = 32 * 2**20
"""Bytes of the largest array that comes from it; glibc allows no more."""


@contextmanager
def one_core() -> Iterator[None]:
    """Keep BLAS to one thread, and freed memory in the process.

    A second thread costs such matrices more than it computes. And an array of a megabyte that is
    given back to the system and asked for again, some ten times per frame, costs more in page
    faults than what is computed with it.
    """
    _keep_memory()
    with threadpool_limits(1):
        yield


def _keep_memory() -> None:
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # no glibc
        return
    mallopt(M_MMAP_THRESHOLD, LARGEST)
    mallopt(M_TRIM_THRESHOLD, KEPT)
    mallopt(M_TOP_PAD, 2 * LARGEST)
