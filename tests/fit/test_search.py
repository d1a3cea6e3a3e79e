"""Multi-start search: the cheapest of each group go on, refined round by round."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from habitus.fit.search import Round, best_of_tries, best_rows, distinct_rows, multi_start

COSTS = arrays(float, st.integers(1, 20), elements=st.floats(0, 9))


def newton(values: np.ndarray, steps: int) -> np.ndarray:
    """Minimises (x^2 - 1)^2 / 4 + x / 10, which has two minima."""
    for _ in range(steps):
        slope = (values**2 - 1.0) * values + 0.1
        values = values - slope / np.maximum(3.0 * values**2 - 1.0, 1.0)
    return values


def cost(values: np.ndarray) -> np.ndarray:
    return (values**2 - 1.0) ** 2 / 4.0 + values / 10.0


def search(starts: np.ndarray, group: np.ndarray, rounds: list[Round[int]]) -> np.ndarray:
    found = multi_start(
        (starts, group),
        rounds,
        refine=lambda some, steps: (newton(some[0], steps), some[1]),
        cost=lambda some: cost(some[0]),
        select=lambda some, rows: (some[0][rows], some[1][rows]),
        groups=lambda some: some[1],
    )
    return found[0]


def test_the_global_minimum_is_found_where_one_start_would_miss_it():
    starts = np.array([1.4, 0.9, -0.7, 2.0])
    (alone,) = search(starts[:1], np.zeros(1, int), [Round(50, 1)])
    (found,) = search(starts, np.zeros(4, int), [Round(2, 2), Round(50, 1)])
    assert alone > 0.9 and found < -1.0 and cost(found) < cost(alone)


def test_each_group_keeps_its_own():
    starts = np.array([2.0, -2.0, 0.5, 1.5])
    found = search(starts, np.array([0, 1, 0, 0]), [Round(None, 2), Round(50, 1)])
    assert found[0] > 0.9 and found[1] < -1.0 and len(found) == 2


def test_costs_are_asked_for_only_where_candidates_are_dropped():
    asked = []
    multi_start(
        np.arange(4.0),
        [Round(None, 4), Round(None, None), Round(None, 9)],
        refine=lambda some, _: some,
        cost=lambda some: asked.append(some) or some,
        select=lambda some, rows: some[rows],
        groups=lambda some: np.zeros(len(some), int),
    )
    assert not asked


@given(COSTS, st.integers(1, 5))
def test_no_row_that_is_left_out_is_cheaper(costs, keep):
    rows = best_rows(costs, keep)
    assert len(rows) == min(keep, len(costs))
    assert (np.diff(costs[rows]) >= 0).all()
    assert np.delete(costs, rows).min(initial=np.inf) >= costs[rows].max()


def test_groups_come_in_the_order_of_their_first_rows_and_equals_in_theirs():
    rows = best_rows(np.array([1.0, 0.0, 1.0, 0.0, 2.0]), 2, np.array([7, 3, 7, 3, 7]))
    assert rows.tolist() == [0, 2, 1, 3]


@given(COSTS, st.integers(1, 5))
def test_distinct_rows_differ_and_each_left_out_is_like_a_cheaper_one(costs, keep):
    def alike(a, b):
        return abs(costs[a] - costs[b]) < 1.0

    rows = distinct_rows(costs, keep, alike).tolist()
    assert all(not alike(a, b) for k, a in enumerate(rows) for b in rows[:k])
    assert rows[0] == int(np.argmin(costs))
    if len(rows) < keep:
        assert all(
            any(alike(k, row) and costs[row] <= costs[k] for row in rows) for k in range(len(costs))
        )


def test_of_each_entry_the_values_of_its_cheapest_try():
    costs = np.array([[3.0, 1.0, 2.0], [2.0, 2.0, 2.0]])
    values = np.arange(12.0).reshape(2, 3, 2)
    (found,) = best_of_tries(costs, values)
    np.testing.assert_array_equal(found, values[[1, 0, 0], [0, 1, 2]])
