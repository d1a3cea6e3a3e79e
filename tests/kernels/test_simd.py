"""Lanes are independent numbers, LANES in float64 and twice as many in float32: each operation
against NumPy, then blocks and rotations made of them.
"""

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from scipy.spatial.transform import Rotation

from habitus.kernels.simd import (
    CACHE_LINE,
    LANES,
    lane_array,
    load,
    root,
    spread,
    store,
    where_less,
)
from habitus.kernels.simd_cholesky import factor, solve_factored
from habitus.kernels.simd_linalg import block_row, load3, rotation_and_jacobian9, store9


@njit
def each(room):
    a = load(room, 0)
    b = load(room, 1)
    store(room, 2, a + b)
    store(room, 3, a - b)
    store(room, 4, a * b)
    store(room, 5, a / b)
    store(room, 6, -a)
    store(room, 7, root(a * a))
    store(room, 8, 2.5 * a - 1.0)
    store(room, 9, 1.0 / b + spread(room, 3.0))
    store(room, 10, where_less(a, b, 1.0, b))
    store(room, 11, 0.25)


TYPES = pytest.mark.parametrize("dtype, digit", [(np.float64, 1e-16), (np.float32, 1e-7)])


@TYPES
def test_operations_agree_with_numpy(dtype, digit):
    rng = np.random.default_rng(0)
    room = lane_array(12, dtype=dtype)
    assert room.dtype == dtype and room.shape[1] * room.itemsize == 8 * LANES
    room[:2] = rng.normal(size=(2, room.shape[1]))
    a, b = room[:2].copy()
    each(room)
    expected = [
        a + b,
        a - b,
        a * b,
        a / b,
        -a,
        abs(a),
        2.5 * a - 1,
        1 / b + 3,
        np.where(a < b, 1, b),
        0.25 + 0 * a,
    ]
    np.testing.assert_allclose(room[2:], expected, rtol=100 * digit)


@TYPES
def test_a_comparison_with_nan_is_false(dtype, digit):
    room = lane_array(12, dtype=dtype)
    room[0], room[1] = np.nan, 1.0
    each(room)
    np.testing.assert_array_equal(room[10], 1.0)


def test_lane_arrays_begin_on_cache_lines():
    for _ in range(20):
        for dtype in (np.float32, np.float64):
            assert lane_array(3, 5, dtype=dtype).ctypes.data % CACHE_LINE == 0


def test_only_tables_of_floats_hold_lanes():
    with pytest.raises(TypingError, match="lanes live in"):
        each(np.zeros((12, LANES), dtype=np.int64))


@njit
def turn(room):
    rotation, left = rotation_and_jacobian9(load3(room, 0))
    store9(room, 3, rotation)
    store9(room, 12, left)


@TYPES
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 1.0, np.pi, 4.7, 2 * np.pi])
def test_rotations_up_to_a_whole_turn(angle, dtype, digit):
    rng = np.random.default_rng(1)
    room = lane_array(21, dtype=dtype)
    vectors = rng.normal(size=(room.shape[1], 3))
    vectors *= angle / np.linalg.norm(vectors, axis=1, keepdims=True)
    room[:3] = vectors.T
    turn(room)
    matrices = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(room[3:12].T.reshape(-1, 3, 3), matrices, atol=2000 * digit)
    change = rng.normal(size=3)
    step = 1e-6
    moved = [Rotation.from_rotvec(vectors + sign * step * change) for sign in (1, -1)]
    rate = (moved[0] * moved[1].inv()).as_rotvec() / (2 * step)
    np.testing.assert_allclose(
        room[12:21].T.reshape(-1, 3, 3) @ change, rate, atol=1e-8 + 100 * digit
    )


@njit
def solve(room, blocks, right):
    factor(room, 0, blocks)
    solve_factored(room, 0, blocks, right)


@TYPES
@pytest.mark.parametrize("blocks", [1, 2, 3, 8])
def test_block_cholesky_solves_every_lane(blocks, dtype, digit):
    rng = np.random.default_rng(blocks)
    n = 3 * blocks
    first = block_row(blocks, 0)
    room = lane_array(first + n, dtype=dtype)
    lanes = room.shape[1]
    tables = rng.normal(size=(lanes, n, n + 4))
    matrices = tables @ tables.transpose(0, 2, 1)
    rights = rng.normal(size=(lanes, n))
    for r in range(blocks):
        for c in range(r + 1):
            block = matrices[:, 3 * r : 3 * r + 3, 3 * c : 3 * c + 3]
            room[block_row(r, c) : block_row(r, c) + 9] = block.reshape(lanes, 9).T
    room[first:] = rights.T
    solve(room, blocks, first)
    exact = np.linalg.solve(matrices, rights[..., None])[..., 0]
    error = np.abs(room[first:].T - exact).max(axis=1) / np.abs(exact).max(axis=1)
    assert (error < 10 * digit * np.linalg.cond(matrices)).all()
