"""Evaluates a cost side by side, in processes of their own."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
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

    def evaluate(given: Sequence[T]) -> Iterator[R]:
        with _no_interrupt():  # it starts processes as they are needed
            return pool.map(_evaluate, given)

    try:
        yield evaluate
    except BrokenProcessPool:
        raise ClothPredictError('a worker process died; out of memory? try fewer --jobs') from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Let Ctrl-C wait; a process that is started meanwhile never gets it, from its first line on.

    Processes inherit what is blocked. To block it is not enough here, as any thread may take it.
    """
    resource_tracker.ensure_running()  # which would unblock it when it is needed first
    waiting: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(signal.SIGINT, handler)
        if waiting:
            signal.raise_signal(signal.SIGINT)


def _begin(cost: Callable[[Any], Any]) -> None:
    _here['cost'], _here['cores'] = cost, ExitStack()
    _here['cores'].enter_context(one_core())


def _evaluate(given: Any) -> Any:
    return _here['cost'](given)
