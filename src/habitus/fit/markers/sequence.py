"""The pose stage and the soft-tissue stage: poses of a whole sequence of a known body and markers
(MoSh secs. 5 and 6).

The energy is `habitus.fit.markers.energy.sequence_terms`, over pose, trans and, in the soft-tissue
stage, beta_t. MoSh solves frame after frame; here all frames are solved together
(`habitus.solve.sequence`), the optimum that the paper's filter approximates.

Long captures are solved in overlapping windows. A frame feels others through the acceleration term
alone, and a disturbance decays within some ten frames. So a window is solved with `WindowSettings`'
``overlap`` frames more on either side than are kept of it, from the same start and on the same grid
of levels as the whole would be, and its kept frames agree with those of the whole
(`benchmarks/mosh_size.py` measures how nearly). The coarsest level, which chooses between poses
that explain the markers almost equally well, is solved for all windows together; starts that are
nearly solutions are corrected window by window. Windows meet where markers are seen. A capture no
longer than `MoshSettings.longest` is one window.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.prior import PosePrior
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.recordings import few_markers
from habitus.fit.markers.settings import WINDOWS, SequenceSettings, WindowSettings
from habitus.observe.marker_prediction import MarkedBody
from habitus.parallel.blocks import drop_pages, empty_array, take_frames
from habitus.solve.sequence import SolvedFrames, solve_coarsest, solve_sequence


@dataclass(frozen=True)
class SequenceResult:
    """What a stage found.

    pose (T, J, 3) rad, trans (T, 3) m, soft_tissue (T, B) or None; costs by term and frame_costs
    (T,) without the acceleration, both as in `energy.sequence_terms`; weights (T, M): the given
    ones times the robust ones; status and iterations of `habitus.solve.sequence`; history of
    the total cost.
    """

    pose: Float[np.ndarray, "T J 3"]
    trans: Float[np.ndarray, "T 3"]
    soft_tissue: Float[np.ndarray, "T B"] | None
    costs: dict[str, float]
    frame_costs: Float[np.ndarray, " T"]
    weights: Float[np.ndarray, "T M"]
    status: str
    iterations: int
    history: tuple[float, ...]


def fit_sequence(
    marked: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: PosePrior,
    start_pose: Float[np.ndarray, "T J 3"],
    start_trans: Float[np.ndarray, "T 3"],
    settings: SequenceSettings | None = None,
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
) -> SequenceResult:
    """Pose and trans of T frames; with `soft_tissue` (T, B) to start from, the changes of shape
    beta_t as well.

    observed: metres, NaN where missing. weights: of each observation, 1 if None. scales: s of each
    marker in metres, None for squares. prior: mean (3 (J - 1),) and precision, root left out.
    Without acceleration each frame is solved by itself: at the finest level, without relaxation.
    """
    settings = settings or SequenceSettings()
    betas = 0 if soft_tissue is None else np.shape(soft_tissue)[1]
    problem = marker_sequence(marked, observed, weights, scales, prior, settings, betas)
    start = problem.pack(start_pose, start_trans, soft_tissue)
    uncoupled = settings.acceleration == 0.0
    options = (
        replace(settings.options, strides=(1,), relaxation=1.0) if uncoupled else settings.options
    )
    solution = solve_sequence(problem, start, slice(3, problem.pose_end), options)
    costs, weights = problem.terms(solution.states, solution.frame_costs)
    pose, trans, soft = problem.unpack(solution.states)
    return SequenceResult(
        pose=pose,
        trans=trans,
        soft_tissue=soft,
        costs=costs | {"acceleration": solution.coupling_cost},
        frame_costs=solution.frame_costs,
        weights=weights,
        status=solution.status,
        iterations=solution.iterations,
        history=solution.history,
    )


WORST_FIRST = ("not finite", "iterations", "converged")


@dataclass(frozen=True)
class Window:
    """Frames of a capture that are solved together, and those of them that are kept."""

    solved: slice
    kept: slice

    @property
    def inside(self) -> slice:
        """The kept frames, counted from the first that is solved."""
        return slice(self.kept.start - self.solved.start, self.kept.stop - self.solved.start)


def windows(
    few: Bool[np.ndarray, " T"], longest: int, settings: WindowSettings = WINDOWS
) -> list[Window]:
    """How a capture is cut; few: frames with too few markers, near which no window should begin or
    end.

    longest: about how many frames are solved together, those of the overlap included.
    """
    frames = len(few)
    overlap = settings.overlap
    grid = settings.grid
    edges = [0]
    if frames <= longest:
        return [Window(slice(0, frames), slice(0, frames))]
    bad = np.concatenate([[0], np.cumsum(few)])
    step = max((longest - 2 * overlap) // grid, 1) * grid
    while frames - edges[-1] > step + overlap:
        edges.append(_cut(bad, edges[-1] + step, edges[-1] + grid, settings))
    edges.append(frames)
    parts = [slice(first, last) for first, last in pairwise(edges)]
    return [
        Window(slice(max(p.start - overlap, 0), min(p.stop + overlap + 1, frames)), p)
        for p in parts
    ]


def _cut(bad: np.ndarray, count: int, first: int, settings: WindowSettings) -> int:
    """The latest place up to ``count`` around which the fewest frames lack markers."""
    overlap = settings.overlap
    lowest = max(first, count - settings.search_steps * settings.grid)
    places = np.arange(count, lowest - 1, -settings.grid)
    missing = bad[np.minimum(places + overlap, len(bad) - 1)] - bad[np.maximum(places - overlap, 0)]
    return int(places[np.argmin(missing)])


def fit_long(
    marked: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    weights: Float[np.ndarray, "T M"] | None,
    scales: Float[np.ndarray, " M"] | None,
    prior: PosePrior,
    start_pose: Float[np.ndarray, "T J 3"],
    start_trans: Float[np.ndarray, "T 3"],
    settings: SequenceSettings,
    soft_tissue: Float[np.ndarray, "T B"] | None = None,
    *,
    longest: int,
    cut: WindowSettings = WINDOWS,
) -> SequenceResult:
    """`fit_sequence` of a capture of any length; of long ones the result's arrays may lie over
    files.

    There, status is that of the worst window, iterations the most of any, and history holds the
    first and the last total cost, nearly.
    """
    parts = windows(few_markers(observed), longest, cut)
    if len(parts) == 1:
        return fit_sequence(
            marked,
            observed,
            weights,
            scales,
            prior,
            start_pose,
            start_trans,
            settings,
            soft_tissue=soft_tissue,
        )
    stage = _Stage(
        marked, observed, weights, scales, prior, (start_pose, start_trans), settings, soft_tissue
    )
    return _gathered(stage, parts, stage.solutions(parts))


@dataclass(frozen=True)
class _Stage:
    """What `fit_long` is given."""

    marked: MarkedBody
    observed: np.ndarray
    weights: np.ndarray | None
    scales: np.ndarray | None
    prior: PosePrior
    start: tuple[np.ndarray, np.ndarray]
    settings: SequenceSettings
    soft_tissue: np.ndarray | None

    @property
    def betas(self) -> int:
        return 0 if self.soft_tissue is None else self.soft_tissue.shape[1]

    def problem(self, frames: slice | np.ndarray):
        """The problem of some frames, and their start."""

        def chosen(array: np.ndarray) -> np.ndarray:
            return array[frames] if isinstance(frames, slice) else take_frames(array, frames)

        problem = marker_sequence(
            self.marked,
            chosen(self.observed),
            None if self.weights is None else chosen(self.weights),
            self.scales,
            self.prior,
            self.settings,
            self.betas,
        )
        pose, trans = map(chosen, self.start)
        soft_tissue = None if self.soft_tissue is None else chosen(self.soft_tissue)
        return problem, problem.pack(pose, trans, soft_tissue)

    def solutions(self, parts: list[Window]) -> Iterator[tuple]:
        """Problem and solution of each window."""
        options = self.settings.options
        coarse = None
        if self.settings.acceleration == 0.0:
            options = replace(options, strides=(1,), relaxation=1.0)
        if options.strides[0] > 1 and not options.corrects:
            coarse = self._coarse(options)
        for window in parts:
            problem, start = self.problem(window.solved)
            known = None
            if coarse is not None:
                frames, states, damping = coarse
                here = (frames >= window.solved.start) & (frames < window.solved.stop)
                known = SolvedFrames(frames[here] - window.solved.start, damping[here])
                start[known.frames] = states[here]
            yield (
                problem,
                solve_sequence(problem, start, slice(3, problem.pose_end), options, known),
            )

    def _coarse(self, options):
        """Frames of the coarsest level, their states and damping; all windows share them."""
        last = len(self.observed) - 1
        frames = np.unique(np.append(np.arange(0, last + 1, options.strides[0]), last))
        problem, start = self.problem(frames)
        return frames, *solve_coarsest(
            problem, start, frames[-1] - frames[-2], slice(3, problem.pose_end), options
        )


def _gathered(stage: _Stage, parts: list[Window], solutions: Iterator[tuple]) -> SequenceResult:
    """The kept frames of all windows, one after another."""
    count = len(stage.observed)
    joints = stage.marked.num_joints
    pose = empty_array((count, joints, 3))
    trans = empty_array((count, 3))
    weights = empty_array(stage.observed.shape[:2])
    soft = empty_array((count, stage.betas)) if stage.betas else None
    frame_costs = np.empty(count)
    costs = []
    total = np.zeros(2)
    ends: list[tuple[str, int]] = []
    for window, (problem, solution) in zip(parts, solutions, strict=True):
        states = solution.states[window.inside]
        frame_costs[window.kept] = solution.frame_costs[window.inside]
        shares, weights[window.kept] = problem.terms(
            states, frame_costs[window.kept], window.inside.start
        )
        costs.append(
            shares | {"acceleration": float(np.sum(solution.frame_couplings[window.inside]))}
        )
        pose[window.kept], trans[window.kept], some = problem.unpack(states)
        if soft is not None:
            soft[window.kept] = some
        total += (
            len(states)
            / len(solution.states)
            * np.array([solution.history[0], solution.history[-1]])
        )
        ends.append((solution.status, solution.iterations))
        drop_pages(pose, trans, weights, soft, stage.observed, stage.weights, *stage.start)
    return SequenceResult(
        pose=pose,
        trans=trans,
        soft_tissue=soft,
        costs={name: sum(part[name] for part in costs) for name in costs[0]},
        frame_costs=frame_costs,
        weights=weights,
        status=next(status for status in WORST_FIRST if any(end[0] == status for end in ends)),
        iterations=max(end[1] for end in ends),
        history=(float(total[0]), float(total[1])),
    )
