"""The start of a live fit to keypoints in calibrated cameras, and its result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.cameras.live import (
    PERSON_HEIGHT,
    KeypointQuality,
    KeypointSolver,
    KeypointSubject,
    keypoint_tracker,
)
from habitus.fit.cameras.recipe import fit_cameras, upright
from habitus.fit.cameras.result import CameraFit
from habitus.fit.cameras.settings import CAMERAS
from habitus.fit.cameras.shape import corrected_rig
from habitus.fit.markers.live import Tracker
from habitus.io.cameras.read import read_calibration
from habitus.io.keypoints.fits import read_camera_fit
from habitus.io.streams.detections import MAX_PEOPLE, DetectionStream
from habitus.io.streams.source import Source
from habitus.jobs.bodies import loaded
from habitus.jobs.cameras import CameraResult
from habitus.jobs.live_start import Evidence, Followed, Gathered, LivePerson, Track
from habitus.jobs.options import LiveOptions, read_age
from habitus.kernels.threads import one_blas_thread
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections
from habitus.observe.keypoints import KeypointRig, convention_names
from habitus.rotations import rotvec_from_matrix
from habitus.types import PathLike

DETECTIONS = "detections"
"""The source that has cameras."""
SAME_CAMERA = 1e-5
"""Between numbers of cameras that are the same ones."""


@dataclass(frozen=True)
class DetectionWiring:
    """A stream's points, (C P K, 3), as the tracker takes them."""

    cameras: int
    keypoints: int

    def markers(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "C P K 3"]:
        """Pixels and confidence of each camera, person and keypoint."""
        return points.reshape(self.cameras, -1, self.keypoints, 3)


@dataclass(frozen=True, eq=False)
class DetectionStart:
    """How a live fit to keypoints starts: the options, the cameras as calibrated, and the body to
    fit or the earlier fit whose shape is taken.
    """

    options: LiveOptions
    rig: CameraRig
    source: CameraFit | BodyModel

    @staticmethod
    def of(options: LiveOptions) -> "DetectionStart":
        """Read calibration and body. Raises HabitusError."""
        given = options.cameras
        assert given is not None
        rig = given if isinstance(given, CameraRig) else read_calibration(given)
        if len(rig.cameras) < 2:
            raise HabitusError(
                "the calibration has 1 camera; expected two or more: one does not tell depth"
            )
        known, body = options.known, options.body
        if known is None:
            source = loaded(body, age=read_age(options.age))
        elif isinstance(known, CameraFit):
            source = known
        elif isinstance(known, str | Path):
            by_name = isinstance(body, str) and body == "default"
            source = read_camera_fit(known, None if by_name else body)
        else:
            raise HabitusError("known is no fit to cameras; expected a result of habitus cameras")
        return DetectionStart(options, rig, source)

    @property
    def is_known(self) -> bool:
        """Whether there is an earlier fit."""
        return isinstance(self.source, CameraFit)

    @property
    def rate_hz(self) -> float | None:
        """Rate of the stream, where it is given."""
        return self.options.fps

    def open(self, source: str, address: PathLike | None) -> Source:
        """A stream of detections. Raises HabitusError."""
        return DetectionStream(self.rig.names, address, self.options.fps)

    def learn(self, name: str, gathered: Gathered) -> Followed:
        """The person of the frames. Raises HabitusError where they do not tell it."""
        convention = gathered.heading.format
        names = convention_names(convention)
        wiring = DetectionWiring(len(self.rig.cameras), len(names))
        observed = np.stack([wiring.markers(frame.points) for frame in gathered.frames])
        rate = gathered.rate_hz
        with one_blas_thread():
            if isinstance(self.source, CameraFit):
                subject, warnings = known_subject(self.source, self.rig, convention)
                how = "as saved"
            else:
                detections = _detections(name, convention, self.rig.names, observed, rate)
                body, prior = self.source, prior_of(self.source)
                fit = fit_cameras(body, prior, detections, self.rig, CAMERAS)[0]
                subject, warnings = KeypointSubject.of_fit(fit, prior), fit.warnings
                how = f"shape in {subject.seconds:.1f} s"
            tracker = keypoint_tracker(subject, rate)
            frames, kept = [], []
            for each in observed:
                frames.append(tracker.step(each))
                kept.append(_evidence(tracker, each).kept)
        seen = np.array([frame.state != "nobody" for frame in frames])
        up = _up(subject, np.array([f.pose for f in frames])[seen],
                 np.array([f.trans for f in frames])[seen], self.source)  # fmt: skip
        by = f"{len(names)} keypoints ({convention}) in {len(self.rig.cameras)} cameras"
        return Followed(
            LivePerson(subject.body, subject.betas, subject.labels, by, up, rate),
            how,
            warnings,
            wiring,
            tracker,
            KeypointQuality(subject, rate),
            tuple(frames),
            np.array(kept),
            partial(_evidence, tracker),
            partial(camera_result, name, subject, self.rig, up, rate, warnings),
        )

    def save(self, fit: CameraFit, folder: PathLike) -> None:
        """Write all files of a fit to cameras."""
        CameraResult.of(fit).save(folder)


def _evidence(tracker: Tracker[KeypointSolver], observed: np.ndarray) -> Evidence:
    """Of the tracker's last frame."""
    own, solver = tracker.own, tracker.solver
    assert own is not None
    return Evidence(np.full(own.shape, np.nan) if solver is None else solver.points(own), own)


def _detections(
    name: str,
    convention: str,
    cameras: tuple[str, ...],
    observed: Float[np.ndarray, "T C P K 3"],
    rate_hz: float,
) -> Detections:
    """The frames, without the rows of people who are nowhere."""
    count = max(1, int(np.isfinite(observed[..., 0]).any(-1).sum(2).max(initial=0)))
    observed = observed[:, :, : min(count, MAX_PEOPLE)]
    return Detections(
        name,
        convention,
        convention_names(convention),
        cameras,
        observed[..., :2],
        np.nan_to_num(observed[..., 2]),
        rate_hz,
    )


def known_subject(
    fit: CameraFit, rig: CameraRig, convention: str
) -> tuple[KeypointSubject, tuple[str, ...]]:
    """The person of an earlier fit before these cameras, and what differs. What the fit added to
    places of keypoints counts for the same convention, corrections and noise for the same cameras.
    """
    subject = KeypointSubject.of_fit(fit, prior_of(fit.body))
    names = convention_names(convention)
    warnings = []
    if (subject.convention, subject.names) != (convention, names):
        warnings.append(
            f"keypoints are {convention}, of the earlier result {fit.convention or 'unknown'}: "
            "their places are those of the table"
        )
        subject = replace(
            subject,
            names=names,
            convention=convention,
            offsets=np.zeros((len(names), 3)),
            noise=np.ones((len(fit.confidence[0]), len(names))),
        )
    assert fit.cameras is not None
    if fit.cameras.names != rig.names:
        noise = np.ones((len(rig.cameras), len(names)))
        return replace(subject, cameras=rig, noise=noise), tuple(warnings)
    corrected = corrected_rig(rig, fit.corrections)
    return replace(subject, cameras=corrected if _same(corrected, fit.cameras) else rig), (
        *warnings,
    )


def _same(rig: CameraRig, other: CameraRig) -> bool:
    """Whether they are the same cameras."""
    pairs = ((rig.rotation, other.rotation), (rig.translation, other.translation))
    return all(np.allclose(a, b, atol=SAME_CAMERA) for a, b in pairs)


def _up(
    subject: KeypointSubject,
    pose: Float[np.ndarray, "T J 3"],
    trans: Float[np.ndarray, "T 3"],
    source: CameraFit | BodyModel,
) -> str:
    """The world's axis that points up, from hips to shoulders over the frames; where these show
    nobody, that of the earlier fit.
    """
    if not len(pose):
        return source.up_axis if isinstance(source, CameraFit) else "+y"
    rig = KeypointRig.of(subject.body, subject.names, subject.convention)
    person = rig.shaped(subject.betas, subject.offsets)
    return upright(person.points(pose, trans), rig, "auto")


def camera_result(
    name: str,
    subject: KeypointSubject,
    given: CameraRig,
    up_axis: str,
    rate_hz: float,
    warnings: Sequence[str],
    track: Track,
    notes: Sequence[str],
) -> CameraFit:
    """The fit of all frames."""
    rig = subject.cameras
    cameras = len(rig.cameras)
    frames = len(track.pose)
    observed = track.observed.reshape(frames, cameras, -1, 3)
    root = subject.body.rest_joints(subject.betas)[0] + track.trans
    depth = root @ rig.rotation[:, 2].T + rig.translation[:, 2]
    turn = np.einsum("cij,ckj->cik", rig.rotation, given.rotation)
    shift = rig.translation - np.einsum("cij,cj->ci", turn, given.translation)
    return CameraFit(
        body=subject.body,
        betas=subject.betas,
        pose=track.pose,
        trans=track.trans,
        rate_hz=rate_hz,
        up_axis=up_axis,
        capture_name=name,
        body_name=subject.body.name,
        made=(f"followed live by {subject.convention} of {cameras} cameras",),
        keypoint_names=subject.names,
        convention=subject.convention,
        cameras=rig,
        given_cameras=given,
        corrections=np.concatenate([rotvec_from_matrix(turn), shift], 1),
        late=np.zeros(cameras),
        observed=observed[..., :2],
        confidence=np.nan_to_num(observed[..., 2]),
        size_px=PERSON_HEIGHT * rig.focal.mean(1) / np.maximum(depth, 0.3),
        exchanged=np.zeros((frames, cameras), bool),
        keypoint_places=subject.offsets,
        triangulated=np.full((frames, len(subject.names), 3), np.nan),
        status="causal",
        costs={"pixels": float(track.costs.sum())},
        stage_seconds={"shape": subject.seconds},
        warnings=(*warnings, *notes),
    )
