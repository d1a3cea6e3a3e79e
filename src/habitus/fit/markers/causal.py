"""Marker fit for live use: each frame from its own markers and the two frames before it, as MoSh
filters (MoSh sec. 6).

The energy of a step is that of `habitus.fit.markers.energy` for three frames, the first two
held.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.prior import PosePrior
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.recordings import MIN_MARKERS
from habitus.fit.markers.sequence import SequenceResult
from habitus.fit.markers.sequence_kernels import LevelArrays, nearest_equivalent, shortened
from habitus.fit.markers.settings import LIVE, LiveSettings, SequenceSettings
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.parallel.blocks import blocks, distances, drop_pages, empty_array, mapped
from habitus.solve.terms import geman_mcclure_weight


class CausalFrame(NamedTuple):
    """Pose (J, 3) rad and trans (3,) m of a frame, and its own cost as in
    `energy.sequence_terms`.
    """

    pose: Float[np.ndarray, "J 3"]
    trans: Float[np.ndarray, " 3"]
    cost: float


class CausalSolver:
    """Fits frames one by one, from what it has seen so far; for one stream and one thread.

    start_pose (J, 3), start_trans (3,): a rough guess of the first frame (30 degrees off will do).
    scales: s of each marker in metres (`energy.sequence_terms`), None for squares.
    iterations: most steps of a later frame.
    """

    def __init__(
        self,
        marked: MarkedBody,
        prior: PosePrior,
        start_pose: Float[np.ndarray, "J 3"],
        start_trans: Float[np.ndarray, " 3"],
        settings: SequenceSettings | None = None,
        scales: Float[np.ndarray, " M"] | None = None,
        iterations: int = 2,
        live: LiveSettings = LIVE,
    ):
        self.settings = settings or SequenceSettings()
        self.iterations = iterations
        self.live = live
        self.frames = 0
        nothing = np.full((1, marked.num_markers, 3), np.nan)
        self._problem = marker_sequence(marked, nothing, None, scales, prior, self.settings, 0)
        start = self._problem.pack(
            np.asarray(start_pose)[None], np.asarray(start_trans)[None], None
        )
        states = np.repeat(start, 3, axis=0)
        links = np.zeros((5, start.shape[1]))
        self._level = LevelArrays(
            frames=np.zeros(3, dtype=np.int64),
            states=states,
            links=links,
            costs=np.zeros(3),
            damping=np.zeros(3),
            moved=np.zeros(3),
            cost_decrease=np.zeros(3),
            relaxations=np.ones(3),
        )

    def step(
        self, observed: Float[np.ndarray, "M 3"], weights: Float[np.ndarray, " M"] | None = None
    ) -> CausalFrame:
        """Fit the next frame; `observed` in metres, NaN where missing."""
        problem = self._problem
        level = self._level
        options = self.settings.options
        seen = np.all(np.isfinite(observed), axis=1, keepdims=True)
        problem.data.observed[0] = np.where(seen, observed, 0.0)
        problem.data.weights[0] = np.where(seen[:, 0], 1.0 if weights is None else weights, 0.0)
        blind = np.count_nonzero(problem.data.weights[0]) < MIN_MARKERS
        self._advance(self.live.velocity_decay if blind else 1.0)
        if blind and self.frames:
            level.costs[2] = problem.cost(level.frames[2:], level.states[2:])[0]
        else:
            level.damping[2] = 0.0 if self.frames else options.damping
            steps = self.iterations if self.frames else options.coarse_sweeps
            problem.visit_again(
                level, 2, steps, self.live.close if self.frames else options.tolerance
            )
        self.frames += 1
        pose, trans, _ = problem.unpack(level.states[2:])
        return CausalFrame(pose[0], trans[0], float(level.costs[2]))

    def rehearse(self) -> None:
        """Solve the last frame once more for nothing: what a step needs is then near the processor
        when one comes.
        """
        level = LevelArrays(*(array.copy() for array in self._level))
        self._problem.visit_again(level, 2, 1, 0.0)
        self._problem.markers(level.states[2:])

    def markers(self) -> Float[np.ndarray, "M 3"]:
        """Where the body of the last frame has its markers, metres."""
        return self._problem.markers(self._level.states[2:])[0]

    def _advance(self, lasts: float) -> None:
        """Move on by a frame: two states to remember, and the third where so much of their velocity
        leads.
        """
        states = self._level.states
        if self.frames == 2:
            self._level.links[2] = self._problem.link_weights()
        if self.frames > 0:
            states[0], states[1] = states[1] if self.frames > 1 else states[2], states[2]
            states[1, 3:6] = shortened(states[1, 3:6])
            states[0, 3:6] = nearest_equivalent(states[0, 3:6], states[1, 3:6])
            states[2] = states[1] + lasts * (states[1] - states[0])


def fit_causally(
    marked: MarkedBody,
    observed: Float[np.ndarray, "T M 3"],
    prior: PosePrior,
    start: tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F 3"]],
    scale: Float[np.ndarray, " M"],
    settings: SequenceSettings,
    live: LiveSettings = LIVE,
) -> SequenceResult:
    """Frame after frame, each from itself and the two before it, as MoSh filters (sec. 6).

    start: pose and trans, of which the first frame's are used.
    """
    solver = CausalSolver(marked, prior, start[0][0], start[1][0], settings, scale, live=live)
    count = len(observed)
    pose = empty_array((count, marked.num_joints, 3))
    trans = empty_array((count, 3))
    costs = np.empty(count)
    for part in blocks(count):
        for frame in range(part.start, part.stop):
            pose[frame], trans[frame], costs[frame] = solver.step(observed[frame])
        drop_pages(pose, observed)
    distance = distances(observed, predict(marked, pose, trans))
    weights = mapped(lambda each: np.nan_to_num(geman_mcclure_weight(each, scale)), distance)
    total = float(costs.sum())
    return SequenceResult(
        pose, trans, None, {"frames": total}, costs, weights, "causal", count, (total,)
    )
