"""Parallel map on a Dask cluster; same results as with threads."""

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from habitus.errors import HabitusError, require_extra
from habitus.parallel.workers import Item, Result

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
