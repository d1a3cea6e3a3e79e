"""A person of known shape followed through the detections of calibrated cameras, frame by frame:
`habitus.fit.markers.live` with keypoints in the place of markers.

A frame is (C, P, K, 3): pixels and confidence of each keypoint of up to P people in each camera,
NaN where missing. What it shows of the person is (C K, 3), ideal pixels and confidence; its
distance from the body is that of the keypoint from the pixel's ray, at the keypoint's depth.

The person is the one near the pixels that the last poses predict (`people.near_prediction`); who
is not followed yet is the group of detections whose rays meet that has most keypoints.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.cameras.causal import PoseFilter
from habitus.fit.cameras.people import box_sizes, grouped, line_distances, near_prediction
from habitus.fit.cameras.recipe import placed, trunk_seen
from habitus.fit.cameras.review import (
    MIN_HEIGHT_PX,
    Expected,
    Sight,
    estimated_noise,
    information,
    sides_put_back,
)
from habitus.fit.cameras.sequence import KeypointSequence, keypoint_data, solve_poses
from habitus.fit.cameras.settings import CAMERAS, CameraSettings
from habitus.fit.cameras.solution import CameraSolution
from habitus.fit.cameras.triangulate import triangulated
from habitus.fit.markers.causal import CausalFrame
from habitus.fit.markers.live import Quality, QualityLimits, Tracker
from habitus.fit.markers.settings import LiveSettings
from habitus.fit.verdict import DOUBTFUL, GOOD, Bound, Reason
from habitus.observe.camera_rig import NEAR, CameraRig
from habitus.observe.keypoints import KeypointRig

LEAST = 6
"""Detections of keypoints in all cameras with which a person is followed."""
PERSON_HEIGHT = 1.7
"""Metres, of the size in pixels."""
LIVE_CAMERAS = LiveSettings(astray=0.15)
"""Detections are less exact than markers."""
SENTENCES: Mapping[str, str] = MappingProxyType(
    {
        "nobody": "Nobody is seen.",
        "live few": "Too few keypoints are seen to place a body.",
        "live errors": "Detections lie {mean:.0f} mm from the body.",
        "live outliers": "Detections lie {mean:.0f} mm from the body; far off: {named}.",
        "live missing": "Only {share:.0%} of the keypoints are seen.",
        "live cameras": "Nobody is detected by {named}.",
    }
)
LIMITS = QualityLimits(Bound(40.0, 80.0), Bound(150.0, 300.0), 0.15, 0.4, SENTENCES)
"""Detectors are off by 1 % of the person's height; chosen on a few made scenes, not
yet judged on spoilt ones."""
SILENT = 0.02
"""Share of its detections below which a camera is named."""


@dataclass(frozen=True, eq=False)
class KeypointSubject:
    """A person whose shape is known. betas (B,); offsets (K, 3): what the fit added to the places
    of the keypoints ``names`` (m); noise (C, K): of detections, as a factor of the table's.
    """

    body: BodyModel
    prior: PosePrior
    betas: Float[np.ndarray, " B"]
    names: tuple[str, ...]
    convention: str
    offsets: Float[np.ndarray, "K 3"]
    cameras: CameraRig
    noise: Float[np.ndarray, "C K"]
    seconds: float = 0.0

    @staticmethod
    def of_fit(fit: CameraSolution, prior: PosePrior) -> "KeypointSubject":
        """The person of a fit, before the cameras as it corrected them."""
        assert fit.cameras is not None
        keypoints = KeypointRig.of(fit.body, fit.keypoint_names, fit.convention)
        nothing = np.zeros_like(fit.predicted)
        expected = Expected(np.arange(len(fit.pose)), fit.predicted, nothing)
        count = fit.confidence.shape[1:]
        still = np.zeros(count[0])
        sight = Sight(
            fit.observed, fit.confidence, fit.size_px, np.ones(count), still, fit.exchanged
        )
        return KeypointSubject(
            fit.body,
            prior.for_joints(fit.body.joint_names),
            fit.betas,
            fit.keypoint_names,
            fit.convention,
            fit.keypoint_places,
            fit.cameras,
            estimated_noise(sight, expected, keypoints),
            float(sum(fit.stage_seconds.values())),
        )

    @property
    def labels(self) -> tuple[str, ...]:
        """Of what a frame shows of the person (C K)."""
        return tuple(f"{camera} {name}" for camera in self.cameras.names for name in self.names)


class KeypointSolver:
    """Follows one person; started with pose (J, 3) and place (3,) of the first frame."""

    def __init__(
        self,
        subject: KeypointSubject,
        pose: Float[np.ndarray, "J 3"],
        trans: Float[np.ndarray, " 3"],
        rate_hz: float,
        settings: CameraSettings,
        live: LiveSettings,
    ):
        self._rig = subject.cameras
        self._keypoints = KeypointRig.of(subject.body, subject.names, subject.convention)
        self._person = self._keypoints.shaped(subject.betas, subject.offsets)
        self._noise = subject.noise
        self._settings = settings
        self._live = live
        self._frames = 0
        self._expected: Float[np.ndarray, "C K 2"] | None = None
        shape = len(self._rig.cameras), len(subject.names)
        nothing = np.full((1, *shape, 2), np.nan), np.zeros((1, *shape))
        prior = subject.prior
        self._data = keypoint_data(
            self._person,
            self._rig,
            *nothing,
            prior.mean,
            settings.pose * prior.precision,
            settings.reach,
        )
        state = np.concatenate([trans, pose.ravel()])
        problem = KeypointSequence(self._data, np.zeros(len(state)))
        self._filter = PoseFilter(problem, state, rate_hz, settings)
        self._at = self._points()

    def predicted(self) -> Float[np.ndarray, "C K 2"]:
        """Ideal pixels of the keypoints in the frame that comes next."""
        if self._expected is None:
            self._expected = self._rig.project(self._points(self._filter.ahead()))
        return self._expected

    def step(self, own: Float[np.ndarray, "N 3"]) -> CausalFrame:
        """Fit the next frame: ideal pixels and confidence of N = C K detections, NaN where
        missing.
        """
        expected = self.predicted()  # at first where the solver starts: nothing moves yet
        self._expected = None
        blind = np.isfinite(own[:, 0]).sum() < LEAST
        if self._frames:
            self._filter.predict(self._live.velocity_decay if blind else 1.0)
        self._frames += 1
        if not blind:
            seen = self._sight(own, expected)
            weights = information(seen, self._keypoints, self._settings.noise)
            self._data.pixels[:] = np.nan_to_num(seen.pixels)
            self._data.weights[:] = weights
            self._filter.correct()
        self._at = self._points()
        return self._frame()

    def distances(self, own: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Of the body's keypoints from the detections' rays (m), NaN where missing."""
        points = self._at
        off = np.linalg.norm(
            self._rig.project(points) - own[:, :2].reshape(len(self._noise), -1, 2), axis=-1
        )
        return (off * self._metres_per_pixel(points)).ravel()

    def points(self, own: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Where detections are in space (m) at the depth of the body's keypoints."""
        rig, points = self._rig, self._at
        pixels = own[:, :2].reshape(len(self._noise), -1, 2)
        depth = self._depth(points)[..., None]
        plane = (pixels - rig.centre[:, None]) / rig.focal[:, None] * depth
        there = np.concatenate([plane, depth], -1) - rig.translation[:, None]
        return np.einsum("cij,cki->ckj", rig.rotation, there).reshape(-1, 3)

    def rehearse(self) -> None:
        """Compute the last frame once more; nothing changes."""
        self._filter.rehearse()
        self._points()

    def _frame(self) -> CausalFrame:
        state = self._filter.state
        return CausalFrame(state[3:].reshape(-1, 3).copy(), state[:3].copy(), self._filter.cost)

    def _points(self, state: np.ndarray | None = None) -> Float[np.ndarray, "K 3"]:
        state = self._filter.state if state is None else state
        return self._person.points(state[3:].reshape(1, -1, 3), state[None, :3])[0]

    def _depth(self, points: np.ndarray) -> Float[np.ndarray, "C K"]:
        ahead = self._rig.rotation[:, 2] @ points.T + self._rig.translation[:, 2:]
        return np.where(ahead > NEAR, ahead, np.nan)

    def _metres_per_pixel(self, points: np.ndarray) -> Float[np.ndarray, "C K"]:
        return self._depth(points) / self._rig.focal.mean(1)[:, None]

    def _sight(self, own: np.ndarray, expected: Float[np.ndarray, "C K 2"]) -> Sight:
        """The frame's detections, sides put back."""
        cameras = len(self._noise)
        table = own.reshape(1, cameras, -1, 3)
        root = self._person.joints[0] + self._filter.state[:3]
        scale = self._metres_per_pixel(root[None])[:, 0]
        size = np.nan_to_num(PERSON_HEIGHT / scale, nan=MIN_HEIGHT_PX)
        sure = np.nan_to_num(table[..., 2])
        still = np.zeros(cameras), np.zeros((1, cameras), bool)
        sight = Sight(table[..., :2], sure, size[None], self._noise, *still)
        return sides_put_back(sight, expected[None], self._keypoints, self._settings)


class KeypointSight:
    """A person whom cameras see; what `Tracker` follows."""

    least = LEAST

    def __init__(
        self,
        subject: KeypointSubject,
        rate_hz: float,
        settings: CameraSettings = CAMERAS,
        live: LiveSettings = LIVE_CAMERAS,
    ):
        self._subject = subject
        self._rate = rate_hz
        self._settings = settings
        self._live = live
        self._keypoints = KeypointRig.of(subject.body, subject.names, subject.convention)
        self.num_joints = subject.body.num_joints
        self.num_observations = len(subject.labels)

    def own(
        self, observed: Float[np.ndarray, "C P K 3"], solver: KeypointSolver | None
    ) -> Float[np.ndarray, "N 3"]:
        """The person's detections, (C K, 3) ideal pixels and confidence, NaN where missing."""
        rig = self._subject.cameras
        there = np.flatnonzero(np.isfinite(observed[..., 0]).any((0, 2)))
        if not len(there):
            return np.full((self.num_observations, 3), np.nan)
        observed = observed[:, there]
        pixels = rig.ideal(observed[..., :2])
        sure = np.where(np.isfinite(pixels).all(-1), np.nan_to_num(observed[..., 2]), 0.0)
        size = box_sizes(pixels[None], sure[None])[0]
        if not np.isfinite(size).any():
            return np.full((self.num_observations, 3), np.nan)
        if solver is None:
            who = self._largest(pixels, sure, size)
        else:
            who = near_prediction([solver.predicted()], pixels, sure, size, self._settings.people)[
                0
            ]
        rows = np.arange(len(who)), np.maximum(who, 0)
        table = np.concatenate([pixels[rows], sure[rows][..., None]], -1)
        table[(who < 0)[:, None] | (table[..., 2] <= 0.0)] = np.nan
        return table.reshape(-1, 3)

    def seen(self, own: Float[np.ndarray, "N 3"]) -> int:
        """How many detections are the person's."""
        return int(np.isfinite(own[:, 0]).sum())

    def start(self, own: Float[np.ndarray, "N 3"]) -> KeypointSolver | None:
        """From the frame's triangulated keypoints; None where they hold too little of shoulders and
        hips.
        """
        subject, settings = self._subject, self._settings
        rig = subject.cameras
        table = own.reshape(len(rig.cameras), -1, 3)
        sure = np.nan_to_num(table[..., 2])
        size = box_sizes(table[None, :, None, :, :2], sure[None, :, None])[0]
        reach = settings.triangulation.max_error * np.nan_to_num(size, nan=MIN_HEIGHT_PX)
        points = triangulated(rig, table[..., :2], sure, np.maximum(reach, MIN_HEIGHT_PX * 0.1))[0]
        if not trunk_seen(points[None], subject.names)[0]:
            return None
        person = self._keypoints.shaped(subject.betas, subject.offsets)
        prior = subject.prior
        pose, trans = placed(points[None], self._keypoints, person, prior.mean)
        spread = settings.triangulation
        weights = np.full((1, len(points)), 1.0 / spread.max_point_error**2)
        rough = keypoint_data(
            person,
            None,
            None,
            None,
            prior.mean,
            prior.precision,
            spread.reach,
            points[None],
            weights,
        )
        pose, trans, _ = solve_poses(rough, pose, trans, self._rate, settings)
        return KeypointSolver(subject, pose[0], trans[0], self._rate, settings, self._live)

    def _largest(
        self,
        pixels: Float[np.ndarray, "C P K 2"],
        sure: Float[np.ndarray, "C P K"],
        size: Float[np.ndarray, "C P"],
    ) -> Int[np.ndarray, " C"]:
        """Of each camera the detection of the person whom most keypoints show, -1 for none."""
        people = self._settings.people
        rig = self._subject.cameras
        there = np.isfinite(size)
        apart = line_distances(pixels[None], sure[None], size[None], rig, people)[0]
        groups = [g for g in grouped(apart, there, people) if (g >= 0).sum() >= people.min_views]
        count = (sure > 0.0).sum(-1)
        shown = lambda who: sum(count[c, p] for c, p in enumerate(who) if p >= 0)  # noqa: E731
        return max(groups, key=shown, default=np.full(len(size), -1))


def keypoint_tracker(
    subject: KeypointSubject, rate_hz: float, settings: CameraSettings = CAMERAS
) -> Tracker[KeypointSolver]:
    """What follows a person by keypoints."""
    return Tracker(KeypointSight(subject, rate_hz, settings), LIVE_CAMERAS, rate_hz)


class KeypointQuality(Quality):
    """Verdict on the last second, which names cameras that see nobody. cameras: their names, in
    the order of the labels, alike many for each.
    """

    what = "keypoints"

    def __init__(self, subject: KeypointSubject, rate_hz: float, limits: QualityLimits = LIMITS):
        super().__init__(subject.labels, rate_hz, limits)
        self._cameras = subject.cameras.names

    def reasons(self, distances: Float[np.ndarray, "F N"]) -> list[Reason]:
        """By the distances (m) of the last second, NaN where missing."""
        seen = np.isfinite(distances).reshape(len(distances), len(self._cameras), -1)
        silent = seen.mean((0, 2)) < SILENT if len(distances) else np.zeros(0, bool)
        named = ", ".join(n for n, s in zip(self._cameras, silent, strict=False) if s)
        level = DOUBTFUL if named else GOOD
        return [*super().reasons(distances), Reason(level, "live cameras", {"named": named})]
