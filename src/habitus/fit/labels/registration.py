"""A body registered to single frames of points without names, from many poses and headings.

An articulated expectation-maximisation: each point is shared among the markers near it, the body
moves to what its markers got, and the reach of the sharing shrinks; in the end points and markers
are matched one to one.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.exchanges import side_by_side
from habitus.fit.labels.kernels import firm_matches, soft_targets
from habitus.fit.labels.settings import REGISTRATION, RegistrationSettings
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.settings import SequenceSettings
from habitus.fit.markers.start import PLAIN_POSES, plain_pose
from habitus.fit.search import Round, best_rows, multi_start
from habitus.kernels.threads import run_chunks
from habitus.observe.marker_prediction import MarkedBody, predict
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.sequence import share_out

SINGLE_FRAMES = SequenceSettings(acceleration=0.0)
"""Weights of single frames."""
LEAST = 16
"""Hypotheses that are worth a thread."""


@dataclass(frozen=True)
class Registered:
    """A body in F frames: frames (F,), pose (F, J, 3), trans (F, 3), the point of each marker (F,
    M), -1 for none, and what it costs (F,): squared distances cut at the last gate and the pose
    prior, as in `habitus.fit.markers.sequence`; last_step (F,): of its last Gauss-Newton step, rad
    (RMS).
    """

    frames: Int[np.ndarray, " F"]
    pose: Float[np.ndarray, "F J 3"]
    trans: Float[np.ndarray, "F 3"]
    match: Int[np.ndarray, "F M"]
    cost: Float[np.ndarray, " F"]
    last_step: Float[np.ndarray, " F"]

    def of(self, chosen: np.ndarray) -> "Registered":
        """Some of the frames."""
        return Registered(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def observed(self, clouds: Clouds) -> Float[np.ndarray, "F M 3"]:
        """The markers' points, NaN where there is none."""
        return np.where((self.match >= 0)[..., None], clouds.points[self.match], np.nan)


def register(
    rig: MarkedBody,
    prior: PosePrior,
    clouds: Clouds,
    frames: Int[np.ndarray, " F"],
    poses: Float[np.ndarray, "N J 3"],
    settings: RegistrationSettings = REGISTRATION,
) -> Registered:
    """The cheapest registration of each frame, from every pose (roots left out) in every heading
    about the up axis.
    """
    states = _starts(rig, clouds, frames, poses, settings.headings)
    each = np.repeat(frames, len(states[0]) // len(frames))
    batch = _Batch(rig, prior, clouds, each, *states, settings)
    return multi_start(
        batch,
        [Round((spread, firmness), keep) for spread, firmness, keep in settings.soft],
        refine=_Batch.share,
        cost=_Batch.ranking,
        select=_Batch.of,
        groups=lambda batch: batch.frames,
    ).match(settings.firm)


def plain_poses(joint_names: tuple[str, ...]) -> Float[np.ndarray, "N J 3"]:
    """The poses that registration begins with where it knows nothing."""
    return np.stack([plain_pose(joint_names, angles) for angles in PLAIN_POSES])


def upright(up_axis: str) -> Float[np.ndarray, "3 3"]:
    """The rotation from the body's axes (y up) to a capture's."""
    up = np.zeros(3)
    up["xyz".index(up_axis[1])] = 1.0 if up_axis[0] == "+" else -1.0
    side = np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]
    return np.stack([side, up, np.cross(side, up)], axis=1)


def _starts(
    rig: MarkedBody, clouds: Clouds, frames: np.ndarray, poses: np.ndarray, headings: int
) -> tuple[np.ndarray, np.ndarray]:
    """Poses and trans (F N headings) with the middles of markers and points on each other."""
    turns = np.zeros((headings, 3))
    turns[:, 1] = np.arange(headings) * (2.0 * np.pi / headings)
    roots = rotvec_from_matrix(upright(clouds.up_axis) @ matrix_from_rotvec(turns))
    bank = np.repeat(poses[:, None], headings, axis=1)
    bank[:, :, 0] = roots
    bank = bank.reshape(-1, *poses.shape[1:])
    middle = np.median(predict(rig, bank, np.zeros((len(bank), 3))), axis=1)
    points = [
        np.median(clouds.points[clouds.start[t] : clouds.start[t + 1]], axis=0) for t in frames
    ]
    trans = np.array(points)[:, None] - middle[None]
    return np.tile(bank, (len(frames), 1, 1)), trans.reshape(-1, 3)


class _Batch:
    """Hypotheses that are solved side by side: each its own frame of a sequence without links."""

    def __init__(
        self,
        rig: MarkedBody,
        prior: PosePrior,
        clouds: Clouds,
        frames: np.ndarray,
        pose: np.ndarray,
        trans: np.ndarray,
        settings: RegistrationSettings,
    ):
        self.rig = rig
        self.prior = prior
        self.clouds = clouds
        self.settings = settings
        self.frames = np.ascontiguousarray(frames)
        nothing = np.full((len(frames), rig.num_markers, 3), np.nan)
        self.problem = marker_sequence(rig, nothing, None, None, prior, SINGLE_FRAMES, 0)
        self._precision = self.problem.data.precision.copy()
        states = self.problem.pack(pose, trans, None)
        self.level = side_by_side(states, self.problem.pose_end, 100.0)

    @property
    def _state(self) -> tuple[np.ndarray, np.ndarray]:
        pose, trans, _ = self.problem.unpack(self.level.states)
        return pose, trans

    def predicted(self) -> Float[np.ndarray, "H M 3"]:
        """The markers of all hypotheses."""
        return predict(self.rig, *self._state)

    def share(self, step: tuple[float, float]) -> "_Batch":
        """Points shared among markers within a ``spread`` (m), and the bodies moved; ``firmness``
        weighs the pose prior.
        """
        spread, firmness = step
        data = self.problem.data
        cloud = self.clouds
        predicted = self.predicted()

        def work(_: int, begin: int, end: int) -> None:
            part = slice(begin, end)
            given = predicted[part], cloud.points, cloud.start, self.frames[part]
            found = data.observed[part], data.weights[part]
            soft_targets(*given, spread, self.settings.outlier, *found)

        run_chunks(work, len(predicted), least=LEAST, pieces=2)
        self._solve(firmness)
        return self

    def match(self, gates: tuple[float, ...]) -> Registered:
        """One point a marker, ever nearer; the cheapest hypothesis of each frame."""
        for gate in gates:
            match, _ = self._matched(gate)
            seen = match >= 0
            self.problem.data.weights[:] = seen
            self.problem.data.observed[:] = np.where(
                seen[..., None], self.clouds.points[match], 0.0
            )
            self._solve(1.0)
        match, cost = self._matched(gates[-1])
        total = cost + self._prior_cost()
        order = best_rows(total, 1, self.frames)
        pose, trans = self._state
        return Registered(
            self.frames[order],
            pose[order],
            trans[order],
            match[order],
            total[order],
            self.level.moved[order],
        )

    def ranking(self) -> Float[np.ndarray, " H"]:
        """The cost that hypotheses are ranked by."""
        return self._matched(self.settings.ranking_gate)[1] + self._prior_cost()

    def of(self, rows: Int[np.ndarray, " n"]) -> "_Batch":
        """Some of the hypotheses."""
        pose, trans = self._state
        chosen = (self.frames[rows], pose[rows], trans[rows])
        return _Batch(self.rig, self.prior, self.clouds, *chosen, self.settings)

    def _matched(self, gate: float) -> tuple[np.ndarray, np.ndarray]:
        match = np.empty((len(self.frames), self.rig.num_markers), dtype=np.int64)
        cost = np.empty(len(self.frames))
        predicted = self.predicted()
        cloud = self.clouds

        def work(_: int, begin: int, end: int) -> None:
            part = slice(begin, end)
            given = predicted[part], cloud.points, cloud.start, self.frames[part]
            firm_matches(*given, gate, match[part], cost[part])

        run_chunks(work, len(predicted), least=LEAST, pieces=2)
        return match, 0.5 * SINGLE_FRAMES.data * cost

    def _prior_cost(self) -> Float[np.ndarray, " H"]:
        off = self.level.states - self.problem.data.mean
        return 0.5 * np.sum((off @ self._precision) * off, axis=1)

    def _solve(self, firmness: float) -> None:
        self.problem.data.precision[:] = firmness * self._precision
        everything = np.arange(len(self.frames))
        for _ in range(self.settings.sweeps):
            share_out(self.problem, lambda some: self.problem.visit(self.level, some), everything)


def at_height(body: BodyModel, metres: float) -> Float[np.ndarray, " B"]:
    """The likeliest betas of a person so tall."""
    none = np.zeros(body.num_betas)
    height = float(np.ptp(body.rest_vertices(none)[:, 1]))
    step = np.eye(body.num_betas)
    slope = np.array([np.ptp(body.rest_vertices(each)[:, 1]) - height for each in step])
    return slope * (metres - height) / float(slope @ slope)
