"""Workers from what a caller names: a number of threads, the address of a Dask scheduler, or
workers themselves.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from habitus.errors import HabitusError
from habitus.parallel.cluster import connect
from habitus.parallel.workers import Threads, Workers

WorkersLike = int | str | Workers | None
"""Number of threads, address of a Dask scheduler ("tcp://host:8786"), workers, or None: as many
threads as cores.
"""


@contextmanager
def open_workers(workers: WorkersLike = None) -> Iterator[Workers]:
    """The workers; a connection to a cluster is closed at the end of the block.

    Raises HabitusError for fewer than one thread and where no scheduler answers.
    """
    if isinstance(workers, str):
        with connect(workers) as cluster:
            yield cluster
    elif workers is None or isinstance(workers, int):
        yield Threads(thread_count(workers))
    else:
        yield workers


def thread_count(threads: int | None) -> int:
    """The number asked for, or that of the cores this process may use. Raises HabitusError for
    fewer than one.
    """
    count = len(os.sched_getaffinity(0)) if threads is None else threads
    if count < 1:
        raise HabitusError(f"{count} threads asked for; expected 1 or more")
    return count
