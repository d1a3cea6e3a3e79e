"""Least squares over a whole sequence by banded Cholesky factors; it knows nothing of bodies.

    minimise    sum_t f_t(x_t)  +  1/2 sum_t sum_n link_n (x_t - 2 x_{t-1} + x_{t-2})_n^2
    subject to  lower <= x_t <= upper,  |x_t - x_{t-1}| <= change

All frames take a damped Gauss-Newton step at once, each with a Levenberg damping of its own. The
matrix has a band of two frames, whose factor takes 4 N^3 operations a frame. With some thirty
unknowns a frame and stiff costs this converges in about ten steps, where visiting one frame after
the other (`habitus.solve.sequence`) takes hundreds; with many more unknowns a visit is cheaper.
Bounds hold by projection: an unknown stays at its bound for a step where the cost falls beyond it.
Limits of change are penalties while solving, and `within_change` enforces them at the end.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import get_lapack_funcs
from scipy.ndimage import binary_dilation

from habitus.arrays import runs

HOLD = 1e12
"""On the diagonal of an unknown that is held."""
STIFF = 1e4
"""Weight of the square of what changes beyond a limit."""
SMALL = 1e-4
"""A predicted change of a frame's cost below which how well it was predicted does not count."""
TOGETHER = 4
"""Steps of all frames before those that still move go on by themselves."""
AROUND = 12
"""Frames on either side of one that moves which go on with it."""
CLIPPED = 0.02
"""Where a step exceeds a bound by more than this, the frames around are solved again with that
unknown on its bound."""
DOUBTFUL = 20.0
"""Frames that cost so many times the median are tried again from their neighbours."""
PATIENCE = 3
"""Steps in a row that may raise the cost: bounds that are met on the way raise it at first."""
LOOSE = 0.1
"""Damping up to which a step counts as undamped: another one can then gain at most what this one's
prediction missed, and is not taken where that is below the tolerance."""
GOOD, POOR = 0.25, 0.75
"""Relative surprise of a frame's cost that lowers and that raises its damping."""


class BandedProblem(Protocol):
    """What the solver asks of a problem of N unknowns a frame."""

    links: Float[np.ndarray, " N"]
    """Weights of second differences."""
    lower: Float[np.ndarray, " N"]
    upper: Float[np.ndarray, " N"]
    change: Float[np.ndarray, " N"]
    """Limits, of the change from each frame to the next; infinite where there is none."""

    def linearize(
        self, frames: Int[np.ndarray, " F"], states: Float[np.ndarray, "F N"]
    ) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F N"], Float[np.ndarray, "F N N"]]:
        """Costs, gradients and Gauss-Newton matrices of frames."""
        ...

    def cost(
        self, frames: Int[np.ndarray, " F"], states: Float[np.ndarray, "F N"]
    ) -> Float[np.ndarray, " F"]:
        """Costs of frames."""
        ...


@dataclass(frozen=True)
class BandedOptions:
    """How a sequence is solved.

    stride: every stride-th frame is solved. steps: the most. tolerance: relative fall of the total
    cost in a step that ends it. rest: a frame rests when no unknown changes by more in a step.
    damping: the first Levenberg damping. window: most frames of one system of equations; overlap:
    how many more look ahead only.
    """

    stride: int = 1
    steps: int = 20
    tolerance: float = 1e-3
    rest: float = 3e-3
    damping: float = 0.01
    window: int = 2048
    overlap: int = 32


BANDED = BandedOptions()


@dataclass(frozen=True)
class BandedSolution:
    """States (T, N) within all limits, costs of the frames (T,), status, most steps of a level.

    status: "converged", "iterations", or "not finite".
    """

    states: Float[np.ndarray, "T N"]
    costs: Float[np.ndarray, " T"]
    status: str
    iterations: int


def solve_banded(
    problem: BandedProblem, start: Float[np.ndarray, "T N"], options: BandedOptions = BANDED
) -> BandedSolution:
    """Minimise the sequence's cost from ``start``. Frames between those of a stride follow them on
    straight ways.
    """
    states = np.clip(start, problem.lower, problem.upper)
    every = np.arange(len(states))
    stride = options.stride if 4 * options.stride < len(states) else 1
    frames = np.unique([*every[::stride], every[-1]])
    statuses, steps = [], []
    for first in range(0, len(frames), options.window):
        begin, end = max(first - 2, 0), min(first + options.window, len(frames))
        chosen = frames[begin : end + options.overlap]
        level = _Level(problem, chosen, states[chosen], stride, options)
        level.held[: first - begin] = True
        status, count = level.solve(min(TOGETHER, options.steps))
        if status == "iterations":
            status, more = level.solve_runs(options.steps - count)
            count += more
        level.second_chances(options.steps)
        states[frames[begin:end]] = level.states[: end - begin]
        statuses.append(status)
        steps.append(count)
    if stride > 1:
        states = _between(every, frames, states[frames])
    else:
        states = within_change(states, problem.change)
    costs = problem.cost(every, states)
    worst = next((each for each in statuses if each != "converged"), "converged")
    return BandedSolution(
        states, costs, worst if np.isfinite(costs).all() else "not finite", max(steps)
    )


def _between(
    frames: Int[np.ndarray, " F"], known: Int[np.ndarray, " K"], states: Float[np.ndarray, "K N"]
) -> Float[np.ndarray, "F N"]:
    """States of frames on straight ways between known ones."""
    after = np.clip(np.searchsorted(known, frames), 1, max(len(known) - 1, 1))
    if len(known) == 1:
        return np.repeat(states, len(frames), axis=0)
    left, right = known[after - 1], known[after]
    share = ((frames - left) / (right - left))[:, None]
    return states[after - 1] + share * (states[after] - states[after - 1])


class _Level:
    """Some frames in a row while they are being solved."""

    def __init__(self, problem, frames, states, stride, options):
        self.problem = problem
        self.frames = frames
        self.states = states
        self.options = options
        self.stride = stride
        self.held: Bool[np.ndarray, " F"] = np.zeros(len(frames), bool)
        gaps = np.diff(frames)
        even = (gaps[1:] == gaps[:-1]) & (gaps[1:] == stride)
        self.links = np.where(even[:, None], problem.links / stride**4, 0.0)
        self.reach = gaps[:, None] * np.where(np.isfinite(problem.change), problem.change, 1e9)
        self.damping = np.full(len(frames), options.damping)
        self.moved = np.full(len(frames), np.inf)
        self.rows = slice(0, len(frames))

    def solve(self, limit: int) -> tuple[str, int]:
        """Take steps until the cost rests; status and how many."""
        costs, gradient, matrix = self._linearized()
        total = float(np.sum(costs)) + self._coupling(self.states)[0]
        if not np.isfinite(total):
            return "not finite", 0
        best, least, rises = self.states, total, 0
        for count in range(limit):
            trial = self._trial(gradient, matrix)
            step = trial - self.states
            predicted = np.sum(gradient * step, axis=1)
            predicted += 0.5 * np.sum(step * (matrix @ step[..., None])[..., 0], axis=1)
            with np.errstate(all="ignore"):
                own = self.problem.cost(self.frames, trial)
                after = float(np.sum(own)) + self._coupling(trial)[0]
                missed = np.abs(own - costs - predicted)
                surprise = (own - costs - predicted) / np.maximum(np.abs(predicted), SMALL)
            free = bool((self.damping <= LOOSE).all())
            change = np.where(surprise < GOOD, 0.1, np.where(surprise < POOR, 1.0, 10.0))
            self.damping = np.clip(self.damping * change, 1e-6, 1e9)
            self.damping[~(surprise < POOR)] = np.maximum(self.damping[~(surprise < POOR)], 0.1)
            self.moved = np.abs(step).max(axis=1)
            rises = 0 if after < least else rises + 1
            if rises > PATIENCE or not np.isfinite(after):
                rises = 0
                self.states, total = best, least
                self.damping = np.maximum(100.0 * self.damping, 1.0)
            else:
                fall = abs(total - after)
                self.states, total = trial, after
            if after < least:
                best, least = trial, after
                rest = min(fall, float(np.sum(missed))) if free else fall
                if rest <= self.options.tolerance * total:
                    return "converged", count + 1
            if count + 1 < limit:
                costs, gradient, matrix = self._linearized()
        self.states = best
        return "iterations", limit

    def solve_runs(self, limit: int) -> tuple[str, int]:
        """Go on with the runs of frames that still move, each by itself, its surroundings held."""
        moving = binary_dilation(self.moved > self.options.rest, iterations=AROUND)
        statuses, steps = ["converged"], [0]
        for first, end in runs(moving & ~self.held):
            part = self._part(first, end, self.states)
            part.damping = np.maximum(self.damping[part.rows], 0.01)
            status, count = part.solve(limit)
            self.states[part.rows] = part.states
            statuses.append(status)
            steps.append(count)
        return next((each for each in statuses if each != "converged"), "converged"), max(steps)

    def second_chances(self, limit: int) -> None:
        """Solve runs of frames that cost much more than most again, from straight ways between
        their neighbours, and keep what is cheaper.
        """
        costs = self.problem.cost(self.frames, self.states)
        doubtful = costs > DOUBTFUL * max(float(np.median(costs)), SMALL)
        for first, end in runs(binary_dilation(doubtful & ~self.held, iterations=2)):
            if first < 1 or end > len(self.frames) - 1:
                continue
            ends = np.array([first - 1, end])
            start = self.states.copy()
            inner = np.arange(first, end)
            start[inner] = _between(inner, ends, self.states[ends])
            begin, stop = max(first - AROUND, 0), min(end + AROUND, len(self.frames))
            before = self._part(begin, stop, self.states).total()
            part = self._part(begin, stop, start)
            part.solve(limit)
            if part.total() < before:
                self.states[part.rows] = part.states

    def total(self) -> float:
        """Cost of all frames and of their coupling."""
        own = self.problem.cost(self.frames, self.states)
        return float(np.sum(own)) + self._coupling(self.states)[0]

    def _part(self, first: int, end: int, states: np.ndarray) -> "_Level":
        """The frames first to end - 1 by themselves, two on either side held."""
        begin, stop = max(first - 2, 0), min(end + 2, len(self.frames))
        rows = slice(begin, stop)
        options = self.options
        part = _Level(self.problem, self.frames[rows], states[rows], self.stride, options)
        part.held[: first - begin] = True
        part.held[end - begin :] = True
        part.rows = rows
        return part

    def _linearized(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.problem.linearize(self.frames, self.states)

    def _coupling(self, states: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost of second differences and of what changes too fast, these differences."""
        bend = np.diff(states, 2, axis=0)
        step = np.diff(states, axis=0)
        beyond = step - np.clip(step, -self.reach, self.reach)
        cost = 0.5 * float(np.sum(self.links * bend**2) + STIFF * np.sum(beyond**2))
        return cost, bend, beyond

    def _trial(self, gradient: np.ndarray, matrix: np.ndarray) -> Float[np.ndarray, "F N"]:
        """Where a damped step leads, within bounds."""
        count, size = self.states.shape
        gradient = gradient.copy()
        band = np.zeros((count, size, 2 * size + 1))
        for i in range(size):
            band[:, i, : size - i] = matrix[:, i:, i]
        band[:, :, 0] += self.damping[:, None]
        _, bend, beyond = self._coupling(self.states)
        for k, factor in enumerate((1.0, -2.0, 1.0)):
            gradient[k : count - 2 + k] += factor * self.links * bend
            band[k : count - 2 + k, :, 0] += factor**2 * self.links
        band[: count - 2, :, size] -= 2.0 * self.links
        band[1 : count - 1, :, size] -= 2.0 * self.links
        band[: count - 2, :, 2 * size] += self.links
        fast = np.where(beyond != 0.0, STIFF, 0.0)
        gradient[1:] += STIFF * beyond
        gradient[:-1] -= STIFF * beyond
        band[1:, :, 0] += fast
        band[:-1, :, 0] += fast
        band[:-1, :, size] -= fast
        low, high = self.problem.lower, self.problem.upper
        still = (self.states <= low) & (gradient > 0.0)
        still |= (self.states >= high) & (gradient < 0.0)
        still |= self.held[:, None]
        held = np.where(still, 0.0, np.nan)
        step = _solved(band, gradient, held)
        beyond = np.clip(self.states + step, low, high) - self.states
        clipped = np.abs(beyond - step) > CLIPPED
        fixed = np.where(clipped & ~still, beyond, held)
        for first, end in runs(binary_dilation(clipped.any(axis=1), iterations=AROUND)):
            begin, stop = max(first - 2, 0), min(end + 2, count)
            part = fixed[begin:stop].copy()
            part[: first - begin], part[end - begin :] = step[begin:first], step[end:stop]
            step[begin:stop] = _solved(band[begin:stop], gradient[begin:stop], part)
        return np.clip(self.states + step, low, high)


def _solved(
    band: Float[np.ndarray, "F N W"], gradient: Float[np.ndarray, "F N"], held: np.ndarray
) -> Float[np.ndarray, "F N"]:
    """Newton's step where ``held`` (F, N) is NaN, and ``held`` elsewhere; NaN where there is
    none.
    """
    count, size, width = band.shape
    fixed = np.isfinite(held)
    system = band.copy()
    system[:, :, 0] += HOLD * fixed
    right = np.where(fixed, HOLD * held, -gradient)
    pbtrf, pbtrs = get_lapack_funcs(("pbtrf", "pbtrs"), (system, right))
    factor, failed = pbtrf(system.reshape(count * size, width).T, lower=1, overwrite_ab=1)
    if failed:
        return np.full_like(gradient, np.nan)
    step = pbtrs(factor, right.ravel(), lower=1)[0].reshape(count, size)
    return np.where(fixed, held, step)


def within_change(
    states: Float[np.ndarray, "T N"], change: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "T N"]:
    """States that change by no more than ``change`` from frame to frame; the same where they do
    not.

    The mean of the lowest such course above and the highest below, which is between any bounds that
    the states keep.
    """
    out = states.copy()
    fast = np.abs(np.diff(states, axis=0)) > change
    for n in np.flatnonzero(fast.any(axis=0)):
        above, below = states[:, n].copy(), states[:, n].copy()
        for course, sign in ((above, 1.0), (below, -1.0)):
            for way in (range(1, len(states)), range(len(states) - 2, -1, -1)):
                for t in way:
                    near = course[t - way.step] - sign * change[n]
                    course[t] = max(course[t], near) if sign > 0 else min(course[t], near)
        out[:, n] = 0.5 * (above + below)
    return out
