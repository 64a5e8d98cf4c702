"""ROS domains for the graphs of this process: no other process of the same tests has them."""

import os
from collections.abc import Iterator
from itertools import count

WORKER = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
WORKERS = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
RUN = os.getppid() if WORKERS > 1 else os.getpid()  # the same for all of the workers

OF_COMMANDS = 1 + (RUN + WORKER) % 100
"""For what a command starts, one after the other."""


def of_graphs() -> Iterator[int]:
    """Give a domain for each graph, so that what another left behind is not heard."""
    for k in count():
        # up to 228: the ports of those above 232 do not exist
        yield 101 + (RUN + WORKER + k * WORKERS) % 128
