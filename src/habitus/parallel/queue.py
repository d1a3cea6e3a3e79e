"""Work of which some can only begin when other work has ended: items are done in whatever order
they end.
"""

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

from habitus.errors import HabitusError, require_extra
from habitus.parallel.workers import Cluster, connect, thread_count

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 2
"""Items a process that are sent before it asks for them."""
_LIBRARIES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
BEFORE_SPAWN = "distributed.nanny.pre-spawn-environ"
"""Dask's setting of the environment in which a process starts. With its default malloc returns
freed memory at once, and page faults take a quarter of an archive's CPU time."""
_ONE_THREAD = dict.fromkeys(_LIBRARIES, "1") | {"OMP_WAIT_POLICY": "passive"}


class Lost(Exception):
    """An item that could not be done since every process that tried it died."""


class Queue(Protocol):
    """Does items as they come; ``function`` stands in a module, and an exception that it raises is
    raised here.
    """

    def done(
        self, function: Callable[[Any, Item], Result], shared: Any, take: Callable[[], Item | None]
    ) -> Iterator[tuple[Item, Result | Lost]]:
        """Each item with ``function(shared, item)`` as it ends; ``take`` gives the next one, None
        where there is none before another ends. An item whose processes die comes back as `Lost`.
        """
        ...


@dataclass(frozen=True)
class Here:
    """One item after another in this process."""

    def done(
        self, function: Callable, shared: Any, take: Callable[[], Any]
    ) -> Iterator[tuple[Any, Any]]:
        """See `Queue`."""
        while (item := take()) is not None:
            yield item, function(shared, item)


@dataclass(frozen=True)
class Spread:
    """Processes of a Dask cluster: no more than `AHEAD` items a process are sent, so that little is
    held at once.
    """

    cluster: Cluster

    @property
    def count(self) -> int:
        """How many items are worked on at once."""
        return sum(self.cluster.client.nthreads().values())

    def done(
        self, function: Callable, shared: Any, take: Callable[[], Any]
    ) -> Iterator[tuple[Any, Any]]:
        """See `Queue`. Raises HabitusError where there are no processes, or the scheduler is
        lost.
        """
        distributed = require_extra("distributed", "clusters", "archive")
        client = self.cluster.client
        waiting = {}
        ended = SimpleQueue()
        if not self.count:
            raise HabitusError("the cluster has no workers; start some, then give the same command")

        def send(item: Any) -> None:
            future = client.submit(function, shared, item, pure=False)
            waiting[future] = item
            future.add_done_callback(ended.put)

        try:
            while True:
                while len(waiting) < max(1, AHEAD * self.count) and (item := take()) is not None:
                    send(item)
                if not waiting:
                    return
                future = ended.get()
                item = waiting.pop(future)
                if future.cancelled() and client.status == "running":  # the scheduler forgot it
                    send(item)
                else:
                    yield item, _outcome(future, distributed)
        finally:
            client.cancel(list(waiting), reason="no longer wanted")


def _outcome(future: Any, distributed: Any) -> Any:
    try:
        return future.result()
    except distributed.scheduler.KilledWorker:
        return Lost("every process that tried it died; there may be too little memory for it")
    except (distributed.comm.CommClosedError, CancelledError) as error:
        raise HabitusError(
            f"the cluster was lost ({error}); the same command goes on once it is back"
        ) from error


@contextmanager
def open_queue(workers: int | str | None = None) -> Iterator[Queue]:
    """Processes of one thread each: so many on this machine, as many as it has cores, or those of a
    Dask scheduler's address. One is this process itself.

    Raises HabitusError for fewer than one, and where no scheduler answers.
    """
    if isinstance(workers, str):
        with connect(workers) as cluster:
            yield Spread(cluster)
        return
    count = thread_count(workers)
    if count == 1:
        yield Here()
        return
    with local_cluster(count) as cluster:
        yield Spread(cluster)


@contextmanager
def local_cluster(count: int) -> Iterator[Cluster]:
    """A Dask cluster of processes on this machine, which end with this one. Raises HabitusError
    where none starts.
    """
    distributed = require_extra("distributed", "several processes", "archive")
    dask = require_extra("dask", "several processes", "archive")
    options: dict[str, Any] = {
        "dashboard_address": None,
        "silence_logs": 50,
        "env": _path(),
    }
    with ExitStack() as stack:
        try:
            with _deaf_to_ctrl_c(), dask.config.set({BEFORE_SPAWN: _ONE_THREAD}):
                started = distributed.LocalCluster(
                    n_workers=count, threads_per_worker=1, processes=True, **options
                )
        except RuntimeError as error:
            raise HabitusError(
                f"{count} processes could not be started ({error}); a script that asks for them "
                "does so below "
                "if __name__ == '__main__':, since they read it too; or ask for one worker"
            ) from error
        stack.enter_context(started)
        yield Cluster(stack.enter_context(distributed.Client(started, set_as_default=False)))


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Processes that start within leave Ctrl-C to this one, which ends them."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # another thread than the main one
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _path() -> dict[str, str]:
    return {"PYTHONPATH": os.environ["PYTHONPATH"]} if "PYTHONPATH" in os.environ else {}
