"""Laws of the sequence solver on a toy problem: SciPy's optimum, descent, gaps, cut links, numbers
that go wrong.
"""

import numpy as np
import pytest
import scipy.optimize

from habitus.solve.sequence import DenseVisits, SequenceOptions, solve_sequence

TIGHT = SequenceOptions(tolerance=1e-8, cost_tolerance=0.0, sweeps=4000)
WIDTH = 3


class Curves(DenseVisits):
    """Frames with residuals tanh(A x) + x / 3 - target, linked by second differences."""

    def __init__(self, frames, seed=0, link=5.0, threads=1):
        rng = np.random.default_rng(seed)
        self.mix = rng.normal(size=(5, WIDTH))
        self.weight = np.ones(frames)
        truth = np.cumsum(0.2 * rng.normal(size=(frames, WIDTH)), axis=0)
        self.target = (
            np.tanh(truth @ self.mix.T)
            + (truth / 3) @ self.mix.T
            + 0.05 * rng.normal(size=(frames, 5))
        )
        self.link = np.full((frames, WIDTH), link)
        self.threads = threads

    def residual(self, frames, states):
        inner = states @ self.mix.T
        return np.sqrt(self.weight[frames])[:, None] * (
            np.tanh(inner) + inner / 3 - self.target[frames]
        )

    def cost(self, frames, states):
        return 0.5 * np.sum(self.residual(frames, states) ** 2, axis=1)

    def linearize(self, frames, states):
        slope = np.sqrt(self.weight[frames])[:, None] / np.cosh(states @ self.mix.T) ** 2
        jacobian = (slope + np.sqrt(self.weight[frames])[:, None] / 3)[..., None] * self.mix
        residual = self.residual(frames, states)
        gradient = np.einsum("frn,fr->fn", jacobian, residual)
        return 0.5 * np.sum(residual**2, axis=1), gradient, jacobian.transpose(0, 2, 1) @ jacobian

    def chart(self, frames, states):
        return states.copy(), self.link[frames]

    def between(self, left, right, share):
        return left + share[:, None] * (right - left)

    def solve(self, options=TIGHT, start=None):
        start = np.zeros((len(self.target), WIDTH)) if start is None else start
        return solve_sequence(self, start, slice(0, WIDTH), options)

    def scipy_optimum(self, start):
        frames = np.arange(len(self.target))

        def residual(flat):
            states = flat.reshape(-1, WIDTH)
            bends = np.sqrt(self.link[2:]) * np.diff(states, 2, axis=0)
            return np.concatenate([self.residual(frames, states).ravel(), bends.ravel()])

        return scipy.optimize.least_squares(
            residual, start.ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-12
        )


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 7, 40])
@pytest.mark.parametrize("strides", [(1,), (4, 2, 1)])
def test_the_optimum_is_scipys(frames, strides):
    problem = Curves(frames, seed=frames)
    solution = problem.solve(
        SequenceOptions(strides=strides, tolerance=1e-8, cost_tolerance=0.0, sweeps=2000)
    )
    peer = problem.scipy_optimum(solution.states + 0.01)
    total = solution.frame_costs.sum() + solution.coupling_cost
    assert solution.status == "converged"
    np.testing.assert_allclose(total, peer.cost, rtol=1e-8)
    np.testing.assert_allclose(solution.states, peer.x.reshape(-1, WIDTH), atol=1e-5)


def test_the_cost_never_rises_and_history_ends_at_it():
    solution = Curves(50).solve(SequenceOptions(strides=(1,), tolerance=1e-6, sweeps=200))
    assert (np.diff(solution.history) <= 1e-12).all()
    np.testing.assert_allclose(
        solution.history[-1], solution.frame_costs.sum() + solution.coupling_cost, rtol=1e-10
    )
    assert len(solution.history) == solution.iterations + 1


def test_threads_change_nothing():
    one = Curves(60)
    two = Curves(60, threads=3)
    options = SequenceOptions(sweeps=5)
    np.testing.assert_allclose(one.solve(options).states, two.solve(options).states, atol=1e-12)


def test_frames_without_data_are_carried_by_the_others():
    problem = Curves(30, link=2.0)
    problem.weight[10:16] = 0.0
    solution = problem.solve()
    assert solution.status == "converged"
    bends = np.diff(solution.states, 2, axis=0)
    fourth = np.diff(bends, 2, axis=0)[8:14]
    np.testing.assert_allclose(fourth, 0.0, atol=1e-6)  # a cubic: nothing but the links acts there


def test_a_cut_link_separates_the_parts():
    whole = Curves(12)
    whole.link[6:8] = 0.0
    solution = whole.solve()
    for part in (slice(0, 6), slice(6, 12)):
        alone = Curves(6)
        alone.mix = whole.mix
        alone.target = whole.target[part]
        np.testing.assert_allclose(solution.states[part], alone.solve().states, atol=1e-6)


def test_no_links_means_frames_by_themselves():
    problem = Curves(9, link=0.0)
    order = np.random.default_rng(0).permutation(9)
    shuffled = Curves(9, link=0.0)
    shuffled.mix = problem.mix
    shuffled.target = problem.target[order]
    options = SequenceOptions(strides=(1,), tolerance=1e-10, sweeps=200)
    np.testing.assert_allclose(
        problem.solve(options).states[order], shuffled.solve(options).states, atol=1e-8
    )


def test_a_frame_that_is_not_finite_stays_and_is_reported():
    problem = Curves(9, link=0.0)
    problem.target[4] = np.nan
    solution = problem.solve()
    assert solution.status == "not finite"
    np.testing.assert_array_equal(solution.states[4], np.zeros(WIDTH))
    clean = Curves(9, link=0.0).solve()
    np.testing.assert_allclose(
        np.delete(solution.states, 4, 0), np.delete(clean.states, 4, 0), atol=1e-7
    )


def test_the_limit_of_sweeps_is_reported():
    assert (
        Curves(20).solve(SequenceOptions(strides=(1,), sweeps=1, tolerance=1e-9)).status
        == "iterations"
    )


def test_a_heavily_damped_step_is_no_reason_to_rest():
    problem = Curves(20, link=0.1)
    one, two = (
        problem.solve(SequenceOptions(strides=(1,), damping=d, tolerance=1e-6, sweeps=500))
        for d in (0.0, 1e5)
    )
    assert two.status == "converged"
    np.testing.assert_allclose(one.states, two.states, atol=1e-4)
