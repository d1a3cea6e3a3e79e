"""Least squares over a whole sequence whose frames meet only in second differences; it knows
nothing of bodies.

    minimise  sum_t f_t(x_t)  +  1/2 sum_{t >= 2} sum_n link[t, n] (x_t - 2 x_{t-1} + x_{t-2})_n^2

f_t is a frame's own least-squares cost (data, priors). A frame is coupled to two neighbours on
either side, so frames whose indices agree modulo 3 can be solved side by side: three-colour block
Gauss-Seidel, one damped Gauss-Newton step a visit, taken only where it lowers the total cost, with
a Levenberg damping of its own for each frame.

Coarse to fine: every 16th frame first, then every 4th, then all, each new frame starting between
its solved neighbours; key frames that cost much more than most are tried again from their
neighbours' states. A second difference over h frames is h^2 times larger and its links weigh 1 /
h^4 there, so that all levels ask for the same. Once steps are short they are lengthened
(over-relaxation), which carries slow waves along faster. What no frame's own cost determines over a
stretch much longer than 16 frames still converges slowly: start it well.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.solve.sequence.level import Level, SequenceOptions, SequenceProblem, evaluate

__all__ = [
    "SequenceOptions",
    "SequenceProblem",
    "SequenceSolution",
    "SolvedFrames",
    "solve_coarsest",
    "solve_sequence",
]

DEFAULT = SequenceOptions()
DOUBTFUL = 2.0
"""A key frame that costs so many times the median is tried again from its neighbours."""
ROUNDS = 4
"""How often, so that a good state can spread over a run of bad ones."""


@dataclass(frozen=True)
class SequenceSolution:
    """States (T, N), each frame's own cost (T,), the coupling's cost and what of it ends at each
    frame (T,), status, sweeps of the finest level, its history.

    history: total cost at the start of the finest level and after each of its sweeps. status:
    "converged", "iterations" or "not finite" (some frame has no finite cost; it stays where it
    was).
    """

    states: Float[np.ndarray, "T N"]
    frame_costs: Float[np.ndarray, " T"]
    coupling_cost: float
    frame_couplings: Float[np.ndarray, " T"]
    status: str
    iterations: int
    history: tuple[float, ...]


@dataclass(frozen=True)
class SolvedFrames:
    """Frames (F,) of a sequence that the coarsest level has solved already, with the damping (F,)
    it left there.
    """

    frames: Int[np.ndarray, " F"]
    damping: Float[np.ndarray, " F"]


def solve_sequence(
    problem: SequenceProblem,
    start: Float[np.ndarray, "T N"],
    measured: slice,
    options: SequenceOptions = DEFAULT,
    known: SolvedFrames | None = None,
) -> SequenceSolution:
    """Minimise the sequence's cost from `start`; steps of the unknowns `measured` decide when a
    frame rests.

    known: frames that `start` holds solved, the first and the last among them; only finer levels
    follow.
    """
    states = np.array(start, dtype=float)
    damping = np.full(len(states), float(options.damping))
    strides = [stride for stride in options.strides if stride == 1 or 4 * stride < len(states)]
    solved = np.zeros(0, dtype=int)
    if known is not None:
        strides = [stride for stride in strides if stride < options.strides[0]]
        solved = known.frames
        damping[solved] = known.damping
    with ThreadPoolExecutor(problem.threads) as pool:
        for stride in strides:
            frames = np.unique(np.append(np.arange(0, len(states), stride), len(states) - 1))
            _start_between(problem, states, damping, solved, frames, pool)
            most = (
                options.sweeps if stride == 1 else options.coarse_sweeps if not len(solved) else 2
            )
            level = Level(
                problem, frames, states[frames], stride, damping[frames], measured, options, pool
            )
            status, history = level.solve(most)
            if stride > 1 and not len(solved):
                second_chances(level, most)
            states[frames], damping[frames], solved = level.states, level.damping, frames
    return SequenceSolution(
        states=states,
        frame_costs=level.costs,
        coupling_cost=level.coupling_cost(),
        frame_couplings=level.frame_couplings(),
        status=status,
        iterations=len(history) - 1,
        history=tuple(history),
    )


def solve_coarsest(
    problem: SequenceProblem,
    start: Float[np.ndarray, "F N"],
    gap: int,
    measured: slice,
    options: SequenceOptions = DEFAULT,
) -> tuple[Float[np.ndarray, "F N"], Float[np.ndarray, " F"]]:
    """The coarsest level of a sequence by itself: its states and the damping that is left.

    problem: of the level's frames alone, ``options.strides[0]`` apart, but for the last, which is
    ``gap`` from the one before it.
    """
    stride = options.strides[0]
    most = options.coarse_sweeps
    damping = np.full(len(start), float(options.damping))
    with ThreadPoolExecutor(problem.threads) as pool:
        level = Level(problem, np.arange(len(start)), start, 1, damping, measured, options, pool)
        level.links[: len(start)] /= stride**4
        if gap != stride:
            level.links[len(start) - 1] = 0.0
        level.solve(most)
        second_chances(level, most)
    return level.states, level.damping


def _start_between(
    problem: SequenceProblem,
    states: np.ndarray,
    damping: np.ndarray,
    solved: np.ndarray,
    frames: np.ndarray,
    pool: ThreadPoolExecutor,
) -> None:
    """Start each new frame between its solved neighbours, or from its own start where that costs
    less.
    """
    new = np.setdiff1d(frames, solved)
    if len(solved) == 0 or len(new) == 0:
        return
    after = np.searchsorted(solved, new)
    left = solved[after - 1]
    right = solved[after]
    share = (new - left) / (right - left)
    middle = problem.between(states[left], states[right], share)
    own_is_cheaper = evaluate(problem, new, states[new], pool) < evaluate(
        problem, new, middle, pool
    )
    states[new] = np.where(own_is_cheaper[:, None], states[new], middle)
    damping[new] = np.maximum(damping[left], damping[right])


def second_chances(level: Level, most: int) -> None:
    """Solve doubtful frames of a level again from the states of their neighbours, and keep what is
    cheaper.
    """
    for _ in range(ROUNDS):
        improved = False
        for side in (-1, 1):
            doubtful = np.flatnonzero(level.costs > DOUBTFUL * np.nanmedian(level.costs))
            doubtful = doubtful[(doubtful + side >= 0) & (doubtful + side < len(level.costs))]
            doubtful = doubtful[level.costs[doubtful + side] < level.costs[doubtful]]
            if len(doubtful):
                improved |= _retry(level, doubtful, level.states[doubtful + side], most)
        if not improved:
            return


def _retry(level: Level, chosen: np.ndarray, starts: np.ndarray, most: int) -> bool:
    """Solve the chosen frames from other starts; whether that helped any."""
    states = level.states.copy()
    costs = level.costs.copy()
    level.begin_again(chosen, starts)
    level.solve(most)
    worse = ~(level.costs < costs)
    level.states[worse], level.costs[worse] = states[worse], costs[worse]
    return bool((level.costs[chosen] < 0.9 * costs[chosen]).any())
