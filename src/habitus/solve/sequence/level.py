"""One level of the whole-sequence solve (`habitus.solve.sequence.solver`): its frames, and the
sweeps over them.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

BLOCKS_PER_THREAD = 4
"""How finely the frames of one colour are dealt out to threads."""
FLOOR = 1e-9
"""Added to each matrix' diagonal, for unknowns that nothing determines."""
NOISE = 1e-13
"""A step may raise the cost by so much of it, which is rounding."""
REST = 0.3
"""A frame rests when neither it nor a neighbour moved by more than this share of the tolerance."""
SHORT = 30.0
"""Steps up to so many tolerances are over-relaxed."""


class SequenceProblem(Protocol):
    """What the solver asks of a problem; `visit` and `cost` are called from several threads at
    once.
    """

    threads: int
    """How many threads to use."""
    lanes: int
    """Frames that are best handed over together."""

    def visit(self, level: "LevelFrames", block: Int[np.ndarray, " F"]) -> None:
        """One damped Gauss-Newton step of the frames `block` (indices into the level), their
        neighbours held.

        Sets states where the step lowers the total cost; costs, damping, moved and cost_decrease of
        the frames in any case.
        `DenseVisits` has the plain form of it.
        """
        ...

    def cost(
        self, frames: Int[np.ndarray, " F"], states: Float[np.ndarray, "F N"]
    ) -> Float[np.ndarray, " F"]:
        """f_t of each frame."""
        ...

    def chart(
        self, frames: Int[np.ndarray, " F"], states: Float[np.ndarray, "F N"]
    ) -> tuple[Float[np.ndarray, "F N"], Float[np.ndarray, "F N"]]:
        """The same states in charts that suit each other, and weights of the second differences
        that end at each.
        """
        ...

    def between(
        self,
        left: Float[np.ndarray, "F N"],
        right: Float[np.ndarray, "F N"],
        share: Float[np.ndarray, " F"],
    ) -> Float[np.ndarray, "F N"]:
        """States on the way from left to right, where to start a new frame."""
        ...


@dataclass(frozen=True)
class SequenceOptions:
    """How a sequence is solved.

    strides: coarse to fine, the last being 1; (1,) solves all frames at once from the start given.
    coarse_sweeps and sweeps: most visits of a frame at the coarsest and at the finest level; levels
    between take two. tolerance: root mean square of a step (over the unknowns that are `measured`)
    under which a frame rests. cost_tolerance: relative fall of the total cost in one sweep that
    ends a level as well. damping: the first Levenberg damping, in the unit of the Gauss-Newton
    matrix. relaxation: how much longer than Gauss-Newton's short steps are made; 1 without links.
    """

    strides: tuple[int, ...] = (16, 4, 1)
    coarse_sweeps: int = 15
    sweeps: int = 30
    tolerance: float = 2e-3
    cost_tolerance: float = 1e-9
    damping: float = 1000.0
    relaxation: float = 1.3


@dataclass(eq=False, repr=False)
class LevelFrames:
    """What a visit reads and sets of a level (F frames, N unknowns).

    frames (F,) are their indices in the sequence; states (F, N); links (F + 2, N) weigh the second
    differences that end at each; costs (F,) are the frames' own; damping (F,); moved (F,) is the
    length that the last step tried would have without damping, cost_decrease (F,) how much it
    lowered the total cost; relaxations (F,) make the next one longer; measured: the unknowns whose
    steps count for ``moved``.
    """

    frames: Int[np.ndarray, " F"]
    states: Float[np.ndarray, "F N"]
    links: Float[np.ndarray, "F2 N"]
    costs: Float[np.ndarray, " F"]
    damping: Float[np.ndarray, " F"]
    moved: Float[np.ndarray, " F"]
    cost_decrease: Float[np.ndarray, " F"]
    relaxations: Float[np.ndarray, " F"]
    measured: slice


class Level(LevelFrames):
    """The frames of one stride while they are being solved."""

    def __init__(self, problem, frames, states, stride, damping, measured, options, pool):
        self.problem = problem
        self.frames = frames
        self.measured = measured
        self.pool = pool
        self.damping = damping
        self.options = options
        self.states, links = problem.chart(frames, states)
        uneven = np.diff(frames, prepend=frames[0] - stride) != stride
        links = np.where(uneven[:, None], 0.0, links) / stride**4
        links[:2] = 0.0
        self.links = np.pad(links, ((0, 2), (0, 0)))
        self.costs = evaluate(problem, frames, self.states, pool)
        self.cost_decrease = np.zeros(len(frames))
        self.moved = np.full(len(frames), np.inf)
        self.relaxations = np.ones(len(frames))

    def solve(self, most: int) -> tuple[str, list[float]]:
        """Sweep until every frame rests; status and the total cost after each sweep."""
        history = [float(np.sum(self.costs)) + self.coupling_cost()]
        tolerance = self.options.tolerance
        quiet = False
        for _ in range(most):
            active = self._active(REST * tolerance)
            if quiet or not active.any():
                break
            history.append(history[-1] - self.sweep(active))
            quiet = history[-2] - history[-1] <= self.options.cost_tolerance * history[-1]
        if not np.isfinite(self.costs).all():
            return "not finite", history
        return "converged" if quiet or not self._active(tolerance).any() else "iterations", history

    def begin_again(self, chosen: np.ndarray, starts: np.ndarray) -> None:
        """Put the frames `chosen` into other states; only they will be visited next, and who is
        moved by them.
        """
        self.states[chosen], self.damping[chosen] = starts, self.options.damping
        self.costs[chosen] = evaluate(self.problem, self.frames[chosen], starts, self.pool)
        self.moved[:] = 0.0
        self.moved[chosen] = np.inf

    def coupling_cost(self) -> float:
        """1/2 sum of link times squared second difference."""
        return 0.5 * float(
            np.sum(self.links[2 : len(self.states)] * np.diff(self.states, 2, axis=0) ** 2)
        )

    def frame_couplings(self) -> Float[np.ndarray, " F"]:
        """The shares of `coupling_cost` that end at each frame."""
        squared = self.links[2 : len(self.states)] * np.diff(self.states, 2, axis=0) ** 2
        return 0.5 * np.pad(np.sum(squared, axis=1), (len(self.states) - len(squared), 0))

    def sweep(self, active: np.ndarray) -> float:
        """Visit each active frame once, one colour after another; how much the total cost fell."""
        colours = np.arange(len(self.frames)) % 3
        self.cost_decrease[:] = 0.0
        short = self.moved < SHORT * self.options.tolerance
        self.relaxations = np.where(short, self.options.relaxation, 1.0)
        for colour in range(3):
            chosen = np.flatnonzero(active & (colours == colour))
            share_out(
                self.problem, lambda block: self.problem.visit(self, block), chosen, self.pool
            )
        return float(np.sum(self.cost_decrease))

    def _active(self, limit: float) -> np.ndarray:
        """Frames that moved by more than `limit` at their last visit, or have such a neighbour."""
        moving = np.pad(self.moved > limit, 2)
        return np.asarray(np.any(np.lib.stride_tricks.sliding_window_view(moving, 5), axis=1))


def evaluate(
    problem: SequenceProblem, frames: np.ndarray, states: np.ndarray, pool: ThreadPoolExecutor
) -> np.ndarray:
    """Own cost of each frame (F,)."""
    costs = np.empty(len(frames))

    def work(block: np.ndarray) -> None:
        with np.errstate(all="ignore"):
            costs[block] = problem.cost(frames[block], states[block])

    share_out(problem, work, np.arange(len(frames)), pool)
    return costs


def share_out(
    problem: SequenceProblem,
    work: Callable[[np.ndarray], None],
    chosen: np.ndarray,
    pool: ThreadPoolExecutor,
) -> None:
    """Let the threads work on blocks of the chosen frames."""
    parts = BLOCKS_PER_THREAD * problem.threads
    size = max(problem.lanes, -(-len(chosen) // (parts * problem.lanes)) * problem.lanes)
    blocks = [chosen[k : k + size] for k in range(0, len(chosen), size)]
    if len(blocks) == 1 or problem.threads == 1:
        for block in blocks:
            work(block)
    else:
        list(pool.map(work, blocks))
