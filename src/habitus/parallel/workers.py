"""Parallel map over independent items: this process or its threads (a Dask cluster:
``cluster``).
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from threadpoolctl import threadpool_limits

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
        with threadpool_limits(limits=1):
            if self.count == 1:
                yield from (function(shared, item) for item in items)
                return
            one_core = {
                "initializer": threadpool_limits,
                "initargs": (1,),
            }  # OpenMP's limit is each thread's own
            with ThreadPoolExecutor(
                self.count, thread_name_prefix="habitus-learn", **one_core
            ) as pool:
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
