"""Least squares over a whole sequence whose frames meet only in second differences; it knows
nothing of bodies.

    minimise  sum_t f_t(x_t)  +  1/2 sum_{t >= 2} sum_n link[t, n] (x_t - 2 x_{t-1} + x_{t-2})_n^2

f_t is a frame's own least-squares cost (data, priors). A frame is coupled to two neighbours on
either side, so frames whose indices agree modulo 3 can be solved side by side: three-colour block
Gauss-Seidel, one damped Gauss-Newton step a visit, taken only where it lowers the total cost, with
a Levenberg damping of its own for each frame.

Coarse to fine: every 16th frame first, then every 4th, then all, each new frame starting between
its solved neighbours; key frames that cost much more than most are tried again from their
neighbours' states. From a start that is nearly a solution, coarse frames are solved in the same
way, and the frames between them are moved as far as these were (a correction). A second difference
over h frames is h^2 times larger and its links weigh 1 / h^4 there, so that all levels ask for the
same. Once steps are short they are lengthened (over-relaxation), which carries slow waves along
faster. What no frame's own cost determines over a stretch much longer than 16 frames still
converges slowly: start it well.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from habitus.kernels.threads import run_chunks

BLOCKS_PER_THREAD = 4
"""How finely the frames of one colour are dealt out to threads."""
FLOOR = 1e-9
"""Added to each matrix' diagonal, for unknowns that nothing determines."""
NOISE = 1e-13
"""A step may raise the cost by so much of it, which is rounding."""
NOISE_32 = 2e-6
"""The same for costs that are summed in float32."""
REST = 0.3
"""A frame rests when neither it nor a neighbour moved by more than this share of the tolerance."""
SHORT = 30.0
"""Steps up to so many tolerances are over-relaxed."""


class SequenceProblem(Protocol):
    """What the solver asks of a problem."""

    parallel: bool
    """Whether `visit` and `cost` may be called from several threads at once."""
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
    corrects: the start is nearly a solution, and coarse levels correct it (module's docstring).
    """

    strides: tuple[int, ...] = (16, 4, 1)
    coarse_sweeps: int = 15
    sweeps: int = 30
    tolerance: float = 2e-3
    cost_tolerance: float = 1e-9
    damping: float = 1000.0
    relaxation: float = 1.3
    corrects: bool = False


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

    def __init__(self, problem, frames, states, stride, damping, measured, options):
        self.problem = problem
        self.frames = frames
        self.measured = measured
        self.damping = damping
        self.options = options
        self.states, links = problem.chart(frames, states)
        uneven = np.diff(frames, prepend=frames[0] - stride) != stride
        links = np.where(uneven[:, None], 0.0, links) / stride**4
        links[:2] = 0.0
        self.links = np.pad(links, ((0, 2), (0, 0)))
        self.costs = evaluate(problem, frames, self.states)
        self.cost_decrease = np.zeros(len(frames))
        self.moved = np.full(len(frames), np.inf)
        self.relaxations = np.ones(len(frames))

    def solve(self, max_sweeps: int) -> tuple[str, list[float]]:
        """Sweep until every frame rests; status and the total cost after each sweep."""
        history = [self.total_cost()]
        tolerance = self.options.tolerance
        quiet = False
        for _ in range(max_sweeps):
            active = self._active(REST * tolerance)
            if quiet or not active.any():
                break
            history.append(history[-1] - self.sweep(active))
            quiet = history[-2] - history[-1] <= self.options.cost_tolerance * history[-1]
        history[-1] = self.total_cost()  # sums of differences have rounded
        if not np.isfinite(self.costs).all():
            return "not finite", history
        return "converged" if quiet or not self._active(tolerance).any() else "iterations", history

    def begin_again(self, chosen: np.ndarray, starts: np.ndarray) -> None:
        """Put the frames `chosen` into other states; only they will be visited next, and who is
        moved by them.
        """
        self.states[chosen], self.damping[chosen] = starts, self.options.damping
        self.costs[chosen] = evaluate(self.problem, self.frames[chosen], starts)
        self.moved[:] = 0.0
        self.moved[chosen] = np.inf

    def total_cost(self) -> float:
        """The frames' own costs and the coupling's."""
        return float(np.sum(self.costs)) + self.coupling_cost()

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
            share_out(self.problem, lambda block: self.problem.visit(self, block), chosen)
        return float(np.sum(self.cost_decrease))

    def _active(self, limit: float) -> np.ndarray:
        """Frames that moved by more than `limit` at their last visit, or have such a neighbour."""
        moving = np.pad(self.moved > limit, 2)
        return np.asarray(np.any(np.lib.stride_tricks.sliding_window_view(moving, 5), axis=1))


def evaluate(problem: SequenceProblem, frames: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Own cost of each frame (F,)."""
    costs = np.empty(len(frames))

    def work(block: np.ndarray) -> None:
        with np.errstate(all="ignore"):
            costs[block] = problem.cost(frames[block], states[block])

    share_out(problem, work, np.arange(len(frames)))
    return costs


def share_out(
    problem: SequenceProblem,
    work: Callable[[np.ndarray], None],
    chosen: np.ndarray,
) -> None:
    """Let the threads work on blocks of the chosen frames, which fill the lanes."""
    lanes = problem.lanes

    def work_on(_: int, begin: int, end: int) -> None:
        work(chosen[begin * lanes : end * lanes])

    if problem.parallel and len(chosen):
        run_chunks(work_on, -(-len(chosen) // lanes), least=1, pieces=BLOCKS_PER_THREAD)
    elif len(chosen):
        work(chosen)


class DenseVisits:
    """Visits from a `linearize(frames, states)` that returns own costs (F,), gradients (F, N) and
    matrices (F, N, N).

    The plain form of a visit, for any problem: inherit from it.
    """

    parallel = False
    lanes = 1

    def linearize(
        self, frames: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Own costs (F,), gradients (F, N) and Gauss-Newton matrices (F, N, N)."""
        raise NotImplementedError

    def cost(self, frames: np.ndarray, states: np.ndarray) -> np.ndarray:
        """Own costs (F,)."""
        raise NotImplementedError

    def visit(self, level: LevelFrames, block: np.ndarray) -> None:
        """One damped Gauss-Newton step of the frames `block`, their neighbours held."""
        here = level.states[block]
        frames = level.frames[block]
        damping = level.damping[block]
        costs, gradient, matrix = self.linearize(frames, here)
        pull, stiffness = coupling(level, block)
        gradient = gradient + pull
        newton = _damped_steps(gradient, matrix, stiffness + damping[:, None])
        relaxation = level.relaxations[block][:, None]
        steps = relaxation * newton
        with np.errstate(all="ignore"):
            trial = self.cost(frames, here + steps)
            change = trial - costs + np.sum((pull + 0.5 * stiffness * steps) * steps, axis=1)
            bent = 0.5 * relaxation**2 * (gradient + damping[:, None] * newton)
            ratio = change / np.sum((relaxation * gradient - bent) * newton, axis=1)
            along = -np.sum(gradient * newton, axis=1)
            spent = damping * np.sum(newton**2, axis=1)
            size = np.sqrt(np.mean(newton[:, level.measured] ** 2, axis=1)) * undamped(along, spent)
        accepted = change < NOISE * costs
        level.states[block] = np.where(accepted[:, None], here + steps, here)
        level.costs[block] = np.where(accepted, trial, costs)
        level.cost_decrease[block] = np.where(accepted, -change, 0.0)
        level.moved[block] = np.nan_to_num(size)
        level.damping[block] = next_damping(damping, accepted, ratio)


def coupling(level: LevelFrames, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (F, N) and diagonal curvature (F, N) of the second differences that each frame is
    part of.
    """
    near = level.states[np.clip(block[:, None] + np.arange(-2, 3), 0, len(level.states) - 1)]
    bend = near[:, 2:] - 2.0 * near[:, 1:4] + near[:, :3]
    links = level.links[block[:, None] + np.arange(3)]
    pull = links[:, 0] * bend[:, 0] - 2.0 * links[:, 1] * bend[:, 1] + links[:, 2] * bend[:, 2]
    return pull, links[:, 0] + 4.0 * links[:, 1] + links[:, 2]


def undamped(along: np.ndarray, spent: np.ndarray) -> np.ndarray:
    """How much longer a step p would be without damping d, at the curvature along it: -g.p / (-g.p
    - d p.p).
    """
    return along / np.maximum(along - spent, 1e-6 * along)


def next_damping(damping: np.ndarray, accepted: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Levenberg damping after a step: a good prediction lowers it, a refused step raises it."""
    lower = np.where(
        damping > 1e-2, damping * np.where(ratio > 0.75, 0.1, np.where(ratio > 0.25, 0.5, 2.0)), 0.0
    )
    return np.where(accepted, lower, np.clip(8.0 * damping, 10.0, 1e12))


def _damped_steps(gradient: np.ndarray, matrix: np.ndarray, added: np.ndarray) -> np.ndarray:
    damped = np.array(matrix)
    diagonal = np.arange(matrix.shape[1])
    damped[:, diagonal, diagonal] += added + FLOOR
    finite = np.isfinite(np.sum(damped, axis=(1, 2)) + np.sum(gradient, axis=1))
    damped[~finite] = np.eye(matrix.shape[1])
    return -np.linalg.solve(damped, np.where(finite[:, None], gradient, 0.0)[..., None])[..., 0]


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
    for stride in strides:
        frames = np.unique(np.append(np.arange(0, len(states), stride), len(states) - 1))
        own = start if options.corrects else None
        _start_between(problem, states, damping, solved, frames, own)
        most = options.sweeps if stride == 1 else options.coarse_sweeps if not len(solved) else 2
        level = Level(problem, frames, states[frames], stride, damping[frames], measured, options)
        status, history = level.solve(most)
        if stride > 1 and not len(solved) and not options.corrects:
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
    level = Level(problem, np.arange(len(start)), start, 1, damping, measured, options)
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
    start: np.ndarray | None,
) -> None:
    """Start each new frame between its solved neighbours, or from its own start where that costs
    less.

    start: the states before coarser levels corrected them (None: no corrections); each new frame
    starts from its own state plus the interpolated correction of its neighbours.
    """
    new = np.setdiff1d(frames, solved)
    if len(solved) == 0 or len(new) == 0:
        return
    after = np.searchsorted(solved, new)
    left = solved[after - 1]
    right = solved[after]
    share = (new - left) / (right - left)
    if start is None:
        middle = problem.between(states[left], states[right], share)
    else:
        before, after = (_correction(problem, start[at], states[at]) for at in (left, right))
        middle = start[new] + before + share[:, None] * (after - before)
    own_is_cheaper = evaluate(problem, new, states[new]) < evaluate(problem, new, middle)
    states[new] = np.where(own_is_cheaper[:, None], states[new], middle)
    damping[new] = np.maximum(damping[left], damping[right])


def _correction(problem: SequenceProblem, start: np.ndarray, solved: np.ndarray) -> np.ndarray:
    """How far states were moved, in one chart."""
    return problem.between(start, solved, np.ones(len(start))) - start


def second_chances(level: Level, max_trials: int) -> None:
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
                improved |= _retry(level, doubtful, level.states[doubtful + side], max_trials)
        if not improved:
            return


def _retry(level: Level, chosen: np.ndarray, starts: np.ndarray, max_trials: int) -> bool:
    """Solve the chosen frames from other starts; whether that helped any."""
    states = level.states.copy()
    costs = level.costs.copy()
    level.begin_again(chosen, starts)
    level.solve(max_trials)
    worse = ~(level.costs < costs)
    level.states[worse], level.costs[worse] = states[worse], costs[worse]
    return bool((level.costs[chosen] < 0.9 * costs[chosen]).any())
