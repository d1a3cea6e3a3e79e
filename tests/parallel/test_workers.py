"""Workers answer in order whatever the number of threads, pass on what goes wrong, and do not run
far ahead.
"""

import threading
import time

import numpy as np
import pytest
from small_rigs import disturbed, planted, small_body
from threadpoolctl import threadpool_info

from habitus.learn.steps.alternation import STEPS
from habitus.parallel.workers import Threads, in_blocks

threads = pytest.mark.parametrize("count", [1, 2, 5])


@threads
@pytest.mark.parametrize("items", [0, 1, 3, 40])
def test_results_come_in_order(count, items):
    def slowly(shared, item):
        time.sleep(0.002 * (item % 3 == 0))
        return shared + item

    assert list(Threads(count).map(slowly, 100, range(items))) == [
        100 + item for item in range(items)
    ]


@threads
def test_what_goes_wrong_is_passed_on(count):
    done = []

    def sometimes(_, item):
        done.append(item)
        if item == 3:
            raise ValueError("number 3")
        return item

    results = Threads(count).map(sometimes, None, range(1000))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="number 3"):
        next(results)
    assert len(done) < 100


@threads
def test_work_waits_until_results_are_taken(count):
    begun = []

    def note(_, item):
        begun.append(item)
        return item

    results = Threads(count, ahead=2).map(note, None, range(100))
    next(results)
    time.sleep(0.05)
    assert len(begun) <= 2 * count + 1
    results.close()
    time.sleep(0.05)
    assert len(begun) <= 2 * count + 1


def test_threads_work_at_once_and_share():
    both = threading.Barrier(2, timeout=10)
    shared = object()

    def meet(given, item):
        assert given is shared
        both.wait()  # would never end if one came after the other
        return threading.current_thread().name

    assert len(set(Threads(2).map(meet, shared, range(2)))) == 2


@threads
def test_linear_algebra_keeps_to_one_core_meanwhile(count):
    before = [(pool["filepath"], pool["num_threads"]) for pool in threadpool_info()]
    inside = list(
        Threads(count).map(
            lambda *_: [pool["num_threads"] for pool in threadpool_info()], None, range(3)
        )
    )
    assert all(number == 1 for numbers in inside for number in numbers)
    assert [(pool["filepath"], pool["num_threads"]) for pool in threadpool_info()] == before


def test_blocks_cover_everything_once():
    assert (
        in_blocks(0, 4) == []
        and in_blocks(8, 4) == [range(4), range(4, 8)]
        and in_blocks(9, 4)[-1] == range(8, 9)
    )


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_training_is_the_same_on_threads(skinning):
    problem, truth = planted(
        small=small_body(pairs=3, middle=1), skinning=skinning, each=9, noise=0.01, shape_features=1
    )
    alone = together = disturbed(truth)
    for step in STEPS.values():
        alone = step(problem, alone, Threads(1))
        together = step(problem, together, Threads(2))
    for key in ("templates", "joints", "pose", "trans"):
        assert np.array_equal(getattr(alone, key), getattr(together, key))
    assert np.array_equal(alone.rig.posedirs, together.rig.posedirs)
    assert np.array_equal(alone.rig.weights, together.rig.weights)
