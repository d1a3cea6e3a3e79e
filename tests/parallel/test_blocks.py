"""Large arrays: over nameless files, worked on a few frames at a time, with the numbers of NumPy at
once.
"""

import errno
import os
import pickle

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.parallel import blocks

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def tiny_memory(monkeypatch):
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)


def over_file(values):
    array = blocks.empty_array(values.shape, values.dtype)
    array[:] = values
    return array


def test_small_arrays_stay_in_memory():
    assert not blocks.is_file_backed(blocks.empty_array((5, 5)))
    assert blocks.empty_array((0, 3)).shape == (0, 3)


def test_large_ones_are_arrays_like_others_and_leave_no_file_behind(monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(blocks.tempfile, "tempdir", None)
    values = RNG.normal(size=(100, 7, 3))
    array = over_file(values)
    assert (
        type(array) is np.ndarray and blocks.is_file_backed(array) and not list(tmp_path.iterdir())
    )
    blocks.drop_pages(array, array[3:], None, values)
    np.testing.assert_array_equal(array, values)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(array)), values)


@pytest.mark.skipif(
    not hasattr(os, "posix_fallocate"), reason="this system does not reserve room on a disk"
)
def test_a_full_disk_is_told_before_it_kills(monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(HabitusError, match=r"needs 0\.0 GB more of temporary files in .*TMPDIR"):
        blocks.empty_array((1000, 3))


@pytest.mark.parametrize("frames", [1, 16, 17, 200])
def test_mapping_is_what_it_would_be_at_once_and_never_sees_more_than_a_block(frames):
    values = over_file(RNG.normal(size=(frames, 50, 3)))
    seen = []

    def length(part):
        seen.append(len(part))
        return np.linalg.norm(part, axis=2)

    np.testing.assert_array_equal(blocks.mapped(length, values), np.linalg.norm(values, axis=2))
    assert max(seen) <= 16 and sum(seen) == frames


def test_joining_columns_and_distances():
    first = RNG.normal(size=(40, 9, 3))
    second = RNG.normal(size=(70, 9, 3))
    together = np.concatenate([first, second])
    np.testing.assert_array_equal(blocks.joined([first, second]), together)
    assert blocks.joined([first]) is first
    for k, column in enumerate(blocks.columns(over_file(together))):
        np.testing.assert_array_equal(column, together[:, k])
    chosen = np.arange(0, 110, 7)
    np.testing.assert_array_equal(blocks.take_frames(over_file(together), chosen), together[chosen])
    np.testing.assert_array_equal(blocks.every_nth_frame(over_file(together), 7), together[::7])
    medians = blocks.by_column(lambda places: np.median(places, axis=0), together)
    np.testing.assert_array_equal(medians, np.median(together, axis=0))
    expected = np.linalg.norm(second - second[::-1], axis=2)
    np.testing.assert_array_equal(blocks.distances(second, second[::-1]), expected)


@pytest.mark.parametrize("large", [False, True])
def test_some_columns_of_a_copy_are_changed(large, monkeypatch):
    values = RNG.normal(size=(50, 9, 3))
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000 if large else 10**6)
    expected = values.copy()
    expected[:, [1, 2, 4, 5, 8]] *= np.array([1, 2, 4, 5, 8])[:, None]
    before = values.copy()
    changed = blocks.with_columns(values, [1, 2, 4, 5, 8], lambda column, k: k * column)
    np.testing.assert_array_equal(changed, expected)
    np.testing.assert_array_equal(values, before)
    assert blocks.is_file_backed(changed) == large


@pytest.mark.skipif(
    not os.path.exists("/proc/self/statm"), reason="this system does not say what is in memory"
)
def test_memory_is_let_go_of_while_blocks_pass(monkeypatch):
    """Sixty-four megabytes go through, a few stay resident."""
    monkeypatch.setattr(blocks, "BLOCK", 1 << 12)
    big = blocks.empty_array((1 << 20, 8))
    for part in blocks.blocks(len(big)):
        big[part] = 1.0
        blocks.drop_pages(big)
    before = resident()
    doubled = blocks.mapped(lambda part: 2.0 * part, big)
    assert resident() - before < 16e6 and doubled[-1, -1] == 2.0


def resident() -> float:
    """Bytes of this process in memory."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
