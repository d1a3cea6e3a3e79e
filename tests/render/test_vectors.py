"""Vector instructions of the renderer's kernels against the same in NumPy, one by one."""

import numpy as np
import pytest
from numba import njit

from habitus.render.kernels.vectors import PIXELS, draw_span, greater, lesser, lowest, overlapping


@njit
def drawn(nearest, ids, at, x, count, start, across, f):
    draw_span(nearest, ids, at, x, count, start, across, f)


@njit
def met(bounds, first, count, box, least):
    return overlapping(bounds, first, count, box[0], box[1], box[2], box[3], least)


@njit
def bit(bits):
    return lowest(bits)


@pytest.mark.parametrize("count", [1, 3, PIXELS])
def test_a_span_is_drawn_where_it_is_nearer_or_a_tie_of_an_earlier_face(count):
    random = np.random.default_rng(count)
    nearest = random.random((3, 20))
    ids = random.integers(-1, 9, (3, 20)).astype(np.int32)
    start = 0.4
    across = 0.01
    at = 27
    f = np.int32(5)
    w = start + np.arange(7, 7 + count) * across
    nearest.reshape(-1)[at] = w[0]
    expected = nearest.copy()
    shown = ids.copy()
    for k in range(count):
        before = expected.reshape(-1)[at + k]
        if w[k] > before or (w[k] == before and f < shown.reshape(-1)[at + k]):
            expected.reshape(-1)[at + k], shown.reshape(-1)[at + k] = w[k], f
    drawn(nearest, ids, at, 7.0, count, start, across, f)
    assert np.array_equal(nearest, expected) and np.array_equal(ids, shown)


@pytest.mark.parametrize("count", [1, 5, PIXELS])
def test_boxes_that_meet_a_box(count):
    random = np.random.default_rng(count)
    low, size = random.random((2, 2, 40)).astype(np.float32)
    bounds = np.stack(
        [low[0], low[0] + size[0], low[1], low[1] + size[1], random.random(40, np.float32)]
    )
    bounds = np.ascontiguousarray(bounds, np.float32)
    box = np.array([0.5, 0.7, 0.4, 0.8], np.float32)
    least = np.float32(0.3)
    first = 11
    meets = (
        (bounds[0] <= box[1])
        & (bounds[1] >= box[0])
        & (bounds[2] <= box[3])
        & (bounds[3] >= box[2])
    )
    meets = (meets & (bounds[4] >= least))[first : first + count]
    assert met(bounds, first, count, box, least) == sum(1 << k for k in range(count) if meets[k])
    assert meets.any() or count == 1


def test_lowest_bit():
    assert [bit(n) for n in (1, 2, 12, 128)] == [0, 1, 2, 7]


@njit
def extremes(first, second):
    return lesser(first, second), greater(first, second)


def test_the_lesser_and_the_greater_of_two():
    large = np.uint64(2**63 + 5)
    for pair in (
        (1, 2),
        (2, 1),
        (-3, 4),
        (0.5, -0.5),
        (np.float32(0.25), 1),
        (large, np.uint64(7)),
    ):
        assert extremes(*pair) == (min(pair), max(pair))
