"""The schedule of the sequence solver: which levels it solves and how often, who starts where, who
does the work.
"""

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from habitus.solve import sequence as solver
from habitus.solve.sequence import (
    BLOCKS_PER_THREAD,
    DenseVisits,
    Level,
    SequenceOptions,
    share_out,
    solve_sequence,
)


class Wells(DenseVisits):
    """Frames whose cost has two wells, at 1 and (deeper) at -1, linked to their neighbours."""

    def __init__(self, frames, link=0.0):
        self.links = np.full((frames, 1), link)
        self.visits = []

    def cost(self, frames, states):
        return 0.5 * ((states[:, 0] ** 2 - 1) ** 2 + 0.1 * (states[:, 0] + 1) ** 2)

    def linearize(self, frames, states):
        self.visits.append(np.array(frames))
        x = states[:, 0]
        jacobian = np.stack([2 * x, np.full_like(x, np.sqrt(0.1))], axis=1)
        residual = np.stack([x**2 - 1, np.sqrt(0.1) * (x + 1)], axis=1)
        gradient = np.sum(jacobian * residual, axis=1, keepdims=True)
        return self.cost(frames, states), gradient, np.sum(jacobian**2, axis=1)[:, None, None]

    def chart(self, frames, states):
        return states.copy(), self.links[frames]

    def between(self, left, right, share):
        return left + share[:, None] * (right - left)


def solve(problem, start, **options):
    return solve_sequence(
        problem, np.asarray(start, dtype=float)[:, None], slice(0, 1), SequenceOptions(**options)
    )


def test_levels_go_from_coarse_to_fine_and_only_the_coarsest_and_the_finest_take_long(monkeypatch):
    levels = []
    chances = []
    monkeypatch.setattr(
        Level,
        "solve",
        lambda self, most: levels.append((self.frames.tolist(), most)) or ("", [0.0]),
    )
    monkeypatch.setattr(
        solver, "second_chances", lambda level, most: chances.append((len(level.frames), most))
    )
    solve(Wells(34), np.zeros(34), strides=(8, 4, 2, 1), coarse_sweeps=7, sweeps=9)
    assert [most for _, most in levels] == [7, 2, 2, 9]
    assert levels[0][0] == [0, 8, 16, 24, 32, 33] and levels[-1][0] == list(range(34))
    assert chances == [(6, 7)]


def test_levels_too_coarse_for_a_sequence_are_left_out(monkeypatch):
    levels = []
    monkeypatch.setattr(
        Level, "solve", lambda self, most: levels.append(len(self.frames)) or ("", [0.0])
    )
    solve(Wells(9), np.zeros(9), strides=(16, 2, 1))
    assert levels == [5, 9]
    levels.clear()
    solve(Wells(8), np.zeros(8), strides=(16, 2, 1))
    assert levels == [8]


class Bowls(Wells):
    """Frames whose cost is 2 (x - 1)²."""

    def cost(self, frames, states):
        return 2.0 * (states[:, 0] - 1.0) ** 2

    def linearize(self, frames, states):
        return self.cost(frames, states), 4.0 * (states - 1.0), np.full((len(frames), 1, 1), 4.0)


def test_how_far_a_frame_has_to_go_is_told_whatever_the_damping():
    """A damped step is short; the way that is left is not."""
    start = np.array([[3.0], [0.5], [1.2]])
    damping = np.array([0.0, 5.0, 80.0])
    step = (1.0 - start[:, 0]) * 4.0 / (4.0 + damping)
    level = Level(Bowls(3), np.arange(3), start, 1, damping, slice(0, 1), SequenceOptions())
    level.problem.visit(level, np.arange(3))
    np.testing.assert_allclose(level.moved, np.abs(start[:, 0] - 1.0), rtol=1e-6)
    np.testing.assert_allclose(level.states[:, 0], start[:, 0] + step, rtol=1e-6)


@pytest.mark.parametrize("moved, factor", [(0.0, SequenceOptions().relaxation), (np.inf, 1.0)])
def test_frames_that_hardly_moved_go_beyond_their_step(moved, factor):
    start = np.array([[1.01], [0.99], [1.02]])
    options = SequenceOptions()
    level = Level(Bowls(3), np.arange(3), start.copy(), 1, np.zeros(3), slice(0, 1), options)
    level.moved[:] = moved
    level.sweep(np.ones(3, dtype=bool))
    np.testing.assert_allclose(level.states, start + factor * (1.0 - start), atol=1e-9)
    assert SequenceOptions().relaxation > 1.0


@pytest.mark.parametrize("gap", [16, 7])
def test_the_last_link_of_the_coarsest_level_counts_where_it_is_as_long_as_the_others(
    monkeypatch, gap
):
    links = []
    monkeypatch.setattr(
        Level, "solve", lambda self, most: links.append(self.links[:, 0].copy()) or ("", [0.0])
    )
    monkeypatch.setattr(solver, "second_chances", lambda level, most: None)
    solver.solve_coarsest(
        Wells(5, 16.0**4), np.zeros((5, 1)), gap, slice(0, 1), SequenceOptions(strides=(16, 1))
    )
    np.testing.assert_allclose(links[0][:5], [0.0, 0.0, 1.0, 1.0, 1.0 if gap == 16 else 0.0])


def test_a_bad_start_gets_a_second_chance_from_its_neighbours():
    """Most frames begin in the deep well; those of the shallow one follow, side by side, each from
    the last.
    """
    start = np.full(40, -1.0)
    start[12:24] = 1.0
    found = solve(Wells(40), start, strides=(4, 1), tolerance=1e-8)
    np.testing.assert_allclose(found.states, -1.0, atol=1e-6)
    stuck = solve(
        Wells(40), start, strides=(1,), tolerance=1e-8
    )  # without a coarse level nobody is asked again
    assert (stuck.states[12:24] > 0.9).all()


def test_new_frames_start_between_their_neighbours_or_at_their_own_start_where_that_is_better():
    start = np.full(33, 0.7)
    start[::4] = -1.0
    start[5] = -1.01
    found = solve(Wells(33), start, strides=(4, 1), tolerance=1e-8)
    np.testing.assert_allclose(found.states, -1.0, atol=1e-6)


def test_new_frames_start_where_they_lie_between_their_neighbours(monkeypatch):
    asked = []
    problem = Wells(17)
    between = Wells.between
    monkeypatch.setattr(
        problem, "between", lambda *way: asked.append(way) or between(problem, *way)
    )
    monkeypatch.setattr(Level, "solve", lambda self, most: ("", [0.0]))
    monkeypatch.setattr(solver, "second_chances", lambda level, most: None)
    start = np.linspace(-1.0, -0.6, 17)
    start[[1, 2, 3]] = 5.0  # worse than between their neighbours
    found = solve(problem, start, strides=(4, 1))
    ((left, right, share),) = asked
    np.testing.assert_allclose(left[:, 0], np.repeat(start[[0, 4, 8, 12]], 3))
    np.testing.assert_allclose(right[:, 0], np.repeat(start[[4, 8, 12, 16]], 3))
    np.testing.assert_allclose(share, np.tile([0.25, 0.5, 0.75], 4))
    np.testing.assert_allclose(found.states[:, 0], np.linspace(-1.0, -0.6, 17))


def test_a_start_that_is_nearly_a_solution_is_corrected_from_coarse_to_fine(monkeypatch):
    """Frames between the coarse ones keep their own shape, and are moved as far as these."""
    problem = Bowls(17)
    monkeypatch.setattr(problem, "cost", lambda frames, states: np.zeros(len(frames)))
    starts = []

    def solve_level(self, most):
        starts.append(self.states[:, 0].copy())
        self.states[:, 0] += 0.1 * self.frames
        return "", [0.0]

    monkeypatch.setattr(Level, "solve", solve_level)
    start = np.sin(np.arange(17.0))
    solve(problem, start, strides=(4, 1), corrects=True)
    np.testing.assert_allclose(starts[0], start[::4])
    np.testing.assert_allclose(starts[1], start + 0.1 * np.arange(17))


def test_corrections_end_where_the_finest_level_alone_does():
    start = -1.0 + 0.05 * np.sin(np.arange(40.0))
    ends = [
        solve(Wells(40, 3.0), start, strides=strides, corrects=True, tolerance=1e-9, sweeps=300)
        for strides in ((1,), (4, 1), (16, 4, 1))
    ]
    for end in ends[1:]:
        np.testing.assert_allclose(end.states, ends[0].states, atol=1e-6)


def test_frames_at_rest_are_not_visited_again():
    problem = Wells(30)
    start = np.full(30, -1.0)
    start[14] = -0.5
    solve(problem, start, strides=(1,), tolerance=1e-3, sweeps=30)
    counts = np.bincount(np.concatenate(problem.visits), minlength=30)
    assert counts[14] > 2 and (counts[:10] == 1).all() and (counts[20:] == 1).all()


@pytest.mark.parametrize(
    ("threads", "lanes", "count"), [(1, 1, 50), (3, 1, 50), (2, 8, 50), (3, 1, 1), (4, 8, 6)]
)
@pytest.mark.parametrize("parallel", [False, True])
def test_work_is_shared_out_whole_and_only_of_parallel_problems(
    monkeypatch, parallel, threads, lanes, count
):
    monkeypatch.setenv("NUMBA_NUM_THREADS", str(threads))
    expected = min(threads, -(-count // lanes)) if parallel else 1
    all_here = threading.Barrier(expected, timeout=30.0)
    blocks = []
    workers = set()

    def work(block):
        blocks.append(block)
        if threading.get_ident() not in workers:
            workers.add(threading.get_ident())
            all_here.wait()

    share_out(SimpleNamespace(parallel=parallel, lanes=lanes), work, np.arange(count))
    np.testing.assert_array_equal(np.sort(np.concatenate(blocks)), np.arange(count))
    assert len(blocks) <= BLOCKS_PER_THREAD * threads
    assert all(len(block) % lanes == 0 for block in blocks if block[-1] != count - 1)
    assert len(workers) == expected and threading.get_ident() in workers
