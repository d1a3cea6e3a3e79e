"""Plain Python threads for kernels that release the interpreter's lock: nothing spins, a forked
child starts anew.
"""

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from functools import lru_cache

from threadpoolctl import ThreadpoolController

_MAX_THREADS: ContextVar[int | None] = ContextVar("most threads", default=None)

DEFAULT_MAX_THREADS = 8
"""Maximum number of threads unless the environment sets one: on 16 cores the pose stage of a
capture took 485, 407, 267, 225 and 296 ms with 1, 2, 4, 8 and 16 (`benchmarks/on_gpu.py`).
Archives use one process a core instead."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Everything within is done on the thread that asks for it: who works on many things at once
    has one for each.
    """
    before = _MAX_THREADS.set(1)
    try:
        with one_core():
            yield
    finally:
        _MAX_THREADS.reset(before)


def num_threads() -> int:
    """1 within `one_thread`; NUMBA_NUM_THREADS, else OMP_NUM_THREADS, else the cores that this
    process may use, up to `DEFAULT_MAX_THREADS`.
    """
    most = _MAX_THREADS.get()
    if most is not None:
        return most
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        text = os.environ.get(name, "")
        if text.isdigit() and int(text) > 0:
            return int(text)
    return min(usable_cores(), DEFAULT_MAX_THREADS)


def usable_cores() -> int:
    """The cores that this process may use; all of the machine where the system does not say."""
    if hasattr(os, "sched_getaffinity"):  # neither on Windows nor on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_chunks(
    work: Callable[[int, int, int], None], size: int, least: int = 4096, pieces: int = 1
) -> int:
    """Call `work(chunk, begin, end)` for ranges that make up 0..size; gives the number of chunks.

    There are at most `pieces` chunks a thread, each of at least `least` items, so that small work
    stays on one thread: to wake another takes about as long as a tenth of a millisecond of work.
    The chunks depend on `size` and the number of threads only: sums over them are the same in every
    run.
    """
    chunks = count_chunks(size, least, pieces)
    if chunks == 1:
        work(0, 0, size)
        return 1
    threads = num_threads()
    waiting = iter(range(chunks))

    def take() -> None:
        for chunk in waiting:  # each chunk goes to whichever thread asks next
            work(chunk, size * chunk // chunks, size * (chunk + 1) // chunks)

    others = [_pool(os.getpid(), threads).submit(take) for _ in range(min(threads, chunks) - 1)]
    take()
    for other in others:
        if (
            not other.cancel()
        ):  # on a busy machine a thread may come too late to find work: nobody waits for it
            other.result()
    return chunks


def count_chunks(size: int, least: int = 4096, pieces: int = 1) -> int:
    """How many chunks `run_chunks` makes of `size` items."""
    return max(1, min(pieces * num_threads(), size // least)) if size >= 2 * least else 1


@lru_cache(maxsize=1)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """One pool a process, by its number: threads do not survive a fork."""
    return ThreadPoolExecutor(threads, thread_name_prefix="habitus-render")


def one_core() -> AbstractContextManager:
    """Linear algebra and OpenMP within are on the thread that asks for them."""
    return _blas().limit(limits=1)


def one_blas_thread() -> AbstractContextManager:
    """Matrix products within are on the thread that asks for them: the threads are the caller's
    own.
    """
    return _blas().limit(limits=1, user_api="blas")


def _blas() -> ThreadpoolController:
    return _libraries("torch" in sys.modules, "scipy.linalg" in sys.modules)


@lru_cache(maxsize=4)
def _libraries(torch: bool, scipy: bool) -> ThreadpoolController:
    """Those that are loaded with these packages: finding them takes longer than posing a body."""
    return ThreadpoolController()
