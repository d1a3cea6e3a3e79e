"""Items in this process: what is done first decides what is done next; one thread is all that they
use.
"""

import os

import pytest

from habitus.errors import HabitusError
from habitus.kernels.threads import DEFAULT_MAX_THREADS, num_threads, one_thread
from habitus.parallel.queue import Here, open_queue


def test_items_here_are_done_one_after_another_as_they_come():
    todo = [5]
    found = []
    with open_queue(1) as queue:
        for item, result in queue.done(divmod, 100, lambda: todo.pop() if todo else None):
            found.append((item, result))
            if item < 7:
                todo.append(item + 1)
    assert isinstance(queue, Here) and found == [(k, divmod(100, k)) for k in (5, 6, 7)]


def test_fewer_than_one_process_and_no_scheduler_are_refused():
    with pytest.raises(HabitusError, match="expected 1 or more"), open_queue(0):
        pass
    with pytest.raises(HabitusError, match="no Dask scheduler"), open_queue("nowhere"):
        pass


def test_one_thread_is_one_and_ends_with_its_block(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "7")
    with pytest.raises(ZeroDivisionError), one_thread():
        assert num_threads() == 1
        raise ZeroDivisionError
    assert num_threads() == 7


def test_many_cores_are_not_all_used_unless_asked_for(monkeypatch):
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    for cores, expected in ((1, 1), (3, 3), (64, DEFAULT_MAX_THREADS)):
        monkeypatch.setattr("os.sched_getaffinity", lambda _, n=cores: set(range(n)), raising=False)
        assert num_threads() == expected
    monkeypatch.setenv("NUMBA_NUM_THREADS", "20")
    assert num_threads() == 20


def test_processes_have_one_thread_each_and_keep_their_memory(monkeypatch):
    """Dask would have malloc return freed memory at once: an archive's stages take twice as long
    then.
    """
    pytest.importorskip("distributed")
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    with open_queue(2) as queue:
        for name, expected in (("MALLOC_TRIM_THRESHOLD_", "unset"), ("OPENBLAS_NUM_THREADS", "1")):
            items = ["unset"]
            ((_, found),) = queue.done(os.getenv, name, lambda i=items: i.pop() if i else None)
            assert found == expected
