"""Parallel map over independent items: by this process or its threads, or on a Dask cluster
with the same results; workers are opened by what a caller names.
"""

import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from habitus.errors import HabitusError, require_extra
from habitus.kernels.threads import num_threads, one_core, usable_cores

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers(Protocol):
    """Calls a function for many items, given what all of them share; results come in the items'
    order.
    """

    def map(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[Result]:
        """Results of ``function(shared, item)``; ``function`` stands in a module and changes
        nothing.
        """
        ...


@dataclass(frozen=True)
class Threads:
    """Threads of this process, each with linear algebra on one core; ``ahead`` results a thread
    wait to be taken.
    """

    count: int
    ahead: int = 2

    def map(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[Result]:
        """Results in order; no more than a few are held at once."""
        with one_core():
            if self.count == 1:
                yield from (function(shared, item) for item in items)
                return
            # one_core for each thread: OpenMP's limit is each thread's own
            with ThreadPoolExecutor(self.count, "habitus-learn", initializer=one_core) as pool:
                waiting = [
                    pool.submit(function, shared, item) for item in items[: self.count * self.ahead]
                ]
                try:
                    for k in range(len(items)):
                        result = waiting[k].result()
                        waiting[k] = None  # type: ignore[call-overload]
                        if len(waiting) < len(items):
                            waiting.append(pool.submit(function, shared, items[len(waiting)]))
                        yield result
                finally:
                    for future in waiting:
                        if future is not None:
                            future.cancel()


def map_on_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`function` of each item, in order, on `num_threads` threads: for functions that spend their
    time in kernels, searches and products which release the interpreter's lock.
    """
    return list(Threads(num_threads()).map(_called, function, list(items)))


def _called(function: Callable[[Item], Result], item: Item) -> Result:
    return function(item)


@dataclass(frozen=True)
class ReportingWorkers:
    """Workers whose maps call ``on_item(done, total)`` after each result."""

    workers: Workers
    on_item: Callable[[int, int], None]

    def map(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[Result]:
        """The results of the workers' own map."""
        for done, result in enumerate(self.workers.map(function, shared, items), 1):
            self.on_item(done, len(items))
            yield result


def in_blocks(count: int, size: int) -> list[range]:
    """0..count in ranges of ``size``."""
    return [range(k, min(k + size, count)) for k in range(0, count, size)]


TIMEOUT = "10s"  # for a scheduler to answer


@dataclass(frozen=True)
class Cluster:
    """The workers of a Dask ``distributed`` client (any that has its methods scatter, submit and
    nthreads).

    What items share is sent to every machine once a call. ``ahead`` results a thread wait to be
    taken; a task whose machine is lost is tried ``retries`` times more. Arrays travel with what
    holds them; readers of files travel without data and open the files anew, so that machines must
    see them under the same path.
    """

    client: Any
    ahead: int = 2
    retries: int = 3

    def map(
        self, function: Callable[[Any, Item], Result], shared: Any, items: Sequence[Item]
    ) -> Iterator[Result]:
        """Results in the items' order; no more than a few are held at once.

        Raises HabitusError where there are no machines, or they are lost.
        """
        distributed = require_extra("distributed", "clusters")
        lost = (
            distributed.comm.CommClosedError,
            distributed.scheduler.KilledWorker,
            CancelledError,
        )
        try:
            yield from self._results(function, shared, items)
        except lost as error:
            raise HabitusError(
                f"the cluster was lost ({error}); the same command goes on once it is back"
            ) from error

    def _results(self, function: Callable, shared: Any, items: Sequence[Any]) -> Iterator[Any]:
        threads = sum(self.client.nthreads().values())
        if not threads:
            raise HabitusError("the cluster has no workers; start some, then give the same command")
        submit = self._submitting(function, shared)
        waiting = []
        try:
            for item in items[: threads * self.ahead]:
                waiting.append(submit(item))
            for k, item in enumerate(items):
                result, waiting[k] = self._result(waiting[k], item, function, shared), None
                if len(waiting) < len(items):
                    waiting.append(submit(items[len(waiting)]))
                yield result
        finally:
            self.client.cancel(
                [future for future in waiting if future is not None], reason="no longer wanted"
            )

    def _submitting(self, function: Callable, shared: Any) -> Callable[[Any], Any]:
        """What sends one item after what all share is there."""
        (there,) = self.client.scatter([shared], broadcast=True, hash=False)
        return partial(self.client.submit, function, there, pure=False, retries=self.retries)

    def _result(self, future: Any, item: Any, function: Callable, shared: Any) -> Any:
        """The result of a future. A scheduler may forget a task when a machine dies: it is sent
        again.
        """
        for _ in range(self.retries):
            try:
                return future.result()
            except CancelledError:
                if self.client.status != "running":
                    raise
            future = self._submitting(function, shared)(item)
        return future.result()


@contextmanager
def connect(address: str) -> Iterator[Cluster]:
    """The cluster whose Dask scheduler has this address. Raises HabitusError where none answers."""
    distributed = require_extra("distributed", "clusters")
    try:
        distributed.comm.get_address_host_port(
            address
        )  # a client would try for long, and complain when collected
        client = distributed.Client(address, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise HabitusError(
            f"no Dask scheduler at {address!r} "
            f"({str(error).splitlines()[0] if str(error) else type(error).__name__}); "
            "expected an address such as tcp://host:8786"
        ) from error
    with client:
        yield Cluster(client)


def pickled_size(thing: Any) -> int:
    """Bytes that pickling sends to another process; buffers are counted without being copied."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(thing, protocol=5, buffer_callback=buffers.append)
    return len(head) + sum(buffer.raw().nbytes for buffer in buffers)


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
    count = usable_cores() if threads is None else threads
    if count < 1:
        raise HabitusError(f"{count} threads asked for; expected 1 or more")
    return count
