"""Work on threads: results in order, errors where they belong."""

import threading

import pytest

from habitus.kernels.threads import num_threads, one_thread
from habitus.parallel.workers import map_on_threads


def test_results_are_in_the_order_of_items():
    assert map_on_threads(lambda x: x * x, range(20)) == [x * x for x in range(20)]
    assert map_on_threads(str, []) == [] and map_on_threads(str, [3]) == ["3"]


def test_items_are_worked_on_at_once(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    assert num_threads() == 2
    both = threading.Barrier(2, timeout=20.0)
    map_on_threads(lambda _: both.wait(), range(2))  # would time out one after the other


def test_one_thread_does_all_in_turn():
    with one_thread():
        names = map_on_threads(lambda _: threading.current_thread().name, range(5))
    assert set(names) == {threading.current_thread().name}


def test_maps_within_maps_end(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    found = map_on_threads(lambda a: map_on_threads(lambda b: a + b, range(4)), range(4))
    assert found == [[a + b for b in range(4)] for a in range(4)]


def test_an_error_reaches_the_caller():
    def fails(item):
        if item == 3:
            raise ValueError("of the third")
        return item

    with pytest.raises(ValueError, match="of the third"):
        map_on_threads(fails, range(6))
