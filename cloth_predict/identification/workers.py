"""Evaluates a cost side by side, in processes of their own."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from cloth_predict.errors import ClothPredictError
from cloth_predict.performance import one_core

T = TypeVar('T')
R = TypeVar('R')
Evaluate = Callable[[Sequence[T]], Iterator[R]]
"""Costs, one after the other in the order of what is given."""

_here: dict[str, Any] = {}
"""What a worker process was given at its start."""


@contextmanager
def workers(cost: Callable[[T], R], jobs: int) -> Iterator[Evaluate[T, R]]:
    """Give a way to evaluate a cost on `jobs` cores; `cost` goes once to each process.

    What still runs at the end, as after Ctrl-C, is ended. Raises ClothPredictError where a
    process dies.
    """
    if jobs == 1:
        yield lambda given: map(cost, given)
        return
    others = set(multiprocessing.active_children())
    spawn = multiprocessing.get_context('spawn')  # a fork would copy the threads of BLAS
    pool = ProcessPoolExecutor(jobs, spawn, _begin, (cost,))
    try:
        yield lambda given: pool.map(_evaluate, given)
    except BrokenProcessPool:
        raise ClothPredictError('a worker process died; out of memory? try fewer --jobs') from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()


def _begin(cost: Callable[[Any], Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the business of the first process
    _here['cost'], _here['cores'] = cost, ExitStack()
    _here['cores'].enter_context(one_core())


def _evaluate(given: Any) -> Any:
    return _here['cost'](given)
