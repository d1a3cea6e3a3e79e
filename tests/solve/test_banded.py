"""The banded solver: against a dense one, within bounds, in windows."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import minimize

from habitus.solve.banded import BandedOptions, solve_banded, within_change


@dataclass
class Curved:
    """Frames that shall follow a target through a sine, and neighbours with little acceleration."""

    target: np.ndarray
    links: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    change: np.ndarray

    def cost(self, frames, states):
        return 0.5 * np.sum((states + 0.3 * np.sin(states) - self.target[frames]) ** 2, axis=1)

    def linearize(self, frames, states):
        slope = 1.0 + 0.3 * np.cos(states)
        gradients = slope * (states + 0.3 * np.sin(states) - self.target[frames])
        return self.cost(frames, states), gradients, np.einsum("fn,nm->fnm", slope**2, np.eye(3))


def problem(frames=40, bound=np.inf, change=np.inf, seed=0):
    rng = np.random.default_rng(seed)
    target = np.cumsum(rng.normal(size=(frames, 3)), axis=0)
    full = np.full(3, 1.0)
    return Curved(target, 5.0 * full, -bound * full, bound * full, change * full)


def dense(which):
    """The same minimum by SciPy's general solver."""
    shape = which.target.shape

    def cost(flat):
        states = flat.reshape(shape)
        bend = np.diff(states, 2, axis=0)
        own = which.cost(np.arange(len(states)), states).sum()
        return own + 0.5 * np.sum(which.links * bend**2)

    bounds = [*zip(which.lower, which.upper, strict=True)] * shape[0]
    found = minimize(
        cost,
        np.zeros(which.target.size),
        bounds=bounds,
        method="L-BFGS-B",
        tol=1e-14,
        options={"maxiter": 5000, "maxfun": 10**6},
    )
    return found.x.reshape(shape)


EXACT = BandedOptions(steps=60, tolerance=1e-14, rest=1e-9)


@pytest.mark.parametrize("bound", [np.inf, 1.5])
def test_minimum_is_that_of_a_dense_solver(bound):
    which = problem(bound=bound)
    solved = solve_banded(which, np.zeros_like(which.target), EXACT)
    assert solved.status == "converged"
    np.testing.assert_allclose(solved.states, dense(which), atol=2e-4)
    assert (np.abs(solved.states) <= bound).all()


def test_windows_agree_with_one_system():
    which = problem(frames=300)
    whole = solve_banded(which, np.zeros_like(which.target), EXACT)
    parts = BandedOptions(steps=60, tolerance=1e-14, rest=1e-9, window=64, overlap=32)
    split = solve_banded(which, np.zeros_like(which.target), parts)
    np.testing.assert_allclose(split.states, whole.states, atol=1e-3)


def test_frames_between_a_stride_are_on_straight_ways():
    which = problem(frames=41)
    solved = solve_banded(which, np.zeros_like(which.target), BandedOptions(stride=8, steps=40))
    bends = np.diff(solved.states, 2, axis=0)
    inner = np.arange(len(bends)) % 8 != 7
    np.testing.assert_allclose(bends[inner], 0.0, atol=1e-12)


def test_limits_of_change_hold_exactly():
    which = problem(change=0.4)
    solved = solve_banded(which, np.zeros_like(which.target), EXACT)
    assert np.abs(np.diff(solved.states, axis=0)).max() <= 0.4 + 1e-12
    free = solve_banded(problem(), np.zeros_like(which.target), EXACT)
    assert np.abs(np.diff(free.states, axis=0)).max() > 0.4


def test_what_keeps_the_limits_stays_and_what_does_not_stays_between_its_bounds():
    rng = np.random.default_rng(1)
    states = np.clip(rng.normal(size=(50, 2)), -1.0, 1.0)
    slow = np.cumsum(rng.uniform(-0.1, 0.1, size=(50, 2)), axis=0)
    np.testing.assert_array_equal(within_change(slow, np.full(2, 0.1)), slow)
    kept = within_change(states, np.array([0.2, np.inf]))
    assert np.abs(np.diff(kept[:, 0])).max() <= 0.2 + 1e-12
    np.testing.assert_array_equal(kept[:, 1], states[:, 1])
    assert np.abs(kept).max() <= 1.0
