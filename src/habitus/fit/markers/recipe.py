"""MoSh: a body in motion from the markers of one subject (MoSh secs. 4-6, thesis secs.
3.4-3.6), in three stages.

    recordings   samples out of reach removed, labels put back that were exchanged for a time
    shape stage  betas, latent markers and poses of a few frames, for all captures of a subject
    pose stage   pose and trans of all frames; noise, exchanged labels, drift, gaps; solved again
    soft tissue  pose, trans and changes of shape beta_t, begun from the pose stage

The energies of all stages are in `habitus.fit.markers.energy`, the constants in `MoshSettings`.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.soft_tissue import check_space, parted
from habitus.fit.markers.causal import CausalSolver, fit_causally
from habitus.fit.markers.drift import Drift, find_drifts
from habitus.fit.markers.gaps import MarkerTargets, bridged, fill_short_gaps, without
from habitus.fit.markers.recordings import (
    Recording,
    check_recordings,
    ever_seen,
    few_markers,
    first_frame,
    flag_warning,
    of_markers,
    with_labels_restored,
    without_outliers,
)
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.sequence import SequenceResult, fit_long, fit_sequence
from habitus.fit.markers.settings import MoshSettings, SequenceSettings, sequence_settings
from habitus.fit.markers.shape import Subject
from habitus.fit.markers.start import start_long, start_sequence
from habitus.fit.markers.subject import fit_subject
from habitus.fit.markers.suspects import (
    Suspect,
    exchange,
    find_swaps,
    lengths,
    marker_noise,
    suspects,
    undo_swaps,
)
from habitus.kernels.threads import one_blas_thread
from habitus.markers.layouts import MarkerLayout
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers
from habitus.parallel.blocks import distances, mapped
from habitus.solve.sequence import SequenceOptions
from habitus.types import Progress

__all__ = [
    "Recording",
    "Subject",
    "fit_known",
    "fit_markers",
    "fit_recording",
    "iterate_fits",
    "known_subject",
]


@dataclass(frozen=True)
class PoseStage:
    """The result of the pose stage.

    observed: the markers with exchanged labels put right (T, M, 3). targets: what the result was
    fitted to. scale: of the robust loss (M,), metres. swaps: pairs put back (`find_swaps`). drifts:
    markers that slide.
    """

    result: SequenceResult
    observed: Float[np.ndarray, "T M 3"]
    targets: MarkerTargets
    scale: Float[np.ndarray, " M"]
    swaps: Sequence[tuple[int, int, Bool[np.ndarray, " T"]]] = ()
    drifts: tuple[Drift, ...] = ()


def fit_markers(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings | None = None,
    progress: Progress = lambda stage, share: None,
) -> tuple[MarkerFit, ...]:
    """Shape, latent markers, pose and soft tissue of one subject from one or more captures with the
    same M markers.

    body: of any skinning and pose features (float64 inside; SMPL's are fastest). prior: of SMPL's
    joints or any others, matched by name. Raises HabitusError when no frame holds enough markers to
    fit a body to.
    """
    return tuple(iterate_fits(body, prior, layout, recordings, settings, progress))


def iterate_fits(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings | None = None,
    progress: Progress = lambda stage, share: None,
) -> Iterator[MarkerFit]:
    """The fits of ``fit_markers`` as they are done: one shape stage, then each capture in turn."""
    settings = settings or MoshSettings()
    prior = prior.for_joints(body.joint_names)
    progress("shape", 0.0)
    recordings, subject = known_subject(body, prior, layout, recordings, settings)
    for index, recording in enumerate(recordings):
        progress(recording.name, index / len(recordings))
        with one_blas_thread():
            fit = fit_recording(recording, subject, settings)
        yield fit


def known_subject(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings,
) -> tuple[list[Recording], Subject]:
    """The shape stage: the recordings as they are fitted, without markers that are never seen, and
    the subject. Raises HabitusError when no frame holds enough markers.
    """
    check_space(body, settings.soft_space)
    recordings = [
        without_outliers(recording, layout.labels, settings.outliers) for recording in recordings
    ]
    seen = np.any([ever_seen(r.observed) for r in recordings], axis=0)
    layout = replace(
        layout, markers=tuple(m for m, s in zip(layout.markers, seen, strict=True) if s)
    )
    recordings = [replace(r, observed=of_markers(r.observed, seen)) for r in recordings]
    recordings = _cleaned(recordings, layout, settings)
    with one_blas_thread():  # the matrices are small: more threads only wait for each other
        subject = fit_subject(body, prior, layout, recordings, settings)
    return recordings, subject


def fit_known(recording: Recording, subject: Subject, settings: MoshSettings) -> MarkerFit:
    """Pose and soft tissue in one more recording of a subject, on the subject's layout.

    Raises HabitusError when no frame holds enough markers.
    """
    layout = subject.layout
    (recording,) = _cleaned(
        [without_outliers(recording, layout.labels, settings.outliers)], layout, settings
    )
    with one_blas_thread():
        return fit_recording(recording, subject, settings)


def _cleaned(
    recordings: list[Recording], layout: MarkerLayout, settings: MoshSettings
) -> list[Recording]:
    """The recordings, once they are sound, with labels that were exchanged for a time put back,
    live fits' apart.
    """
    check_recordings(recordings)
    if settings.causal:
        return recordings
    return [
        with_labels_restored(recording, layout.labels, settings.flips) for recording in recordings
    ]


def fit_recording(recording: Recording, subject: Subject, settings: MoshSettings) -> MarkerFit:
    """Pose stage and soft-tissue stage of one capture, as `known_subject` returned it."""
    observed = exchange(recording.observed, subject.exchanged)
    began = time.perf_counter()
    posed = _pose_stage(subject, observed, recording.rate_hz, settings)
    pose_seconds = time.perf_counter() - began
    began = time.perf_counter()
    soft = _soft_tissue_stage(subject, posed, settings) if settings.soft_tissue else None
    soft_seconds = time.perf_counter() - began if soft else None
    seconds = {"shape": subject.seconds, "pose": pose_seconds, "soft_tissue": soft_seconds}
    return assemble(recording, subject, posed, soft, seconds, settings)


def _pose_stage(
    subject: Subject, observed: np.ndarray, rate_hz: float, settings: MoshSettings
) -> PoseStage:
    """All frames at once; then each marker's noise is known, exchanged pairs are put right, sliding
    markers found, gaps bridged, and it is solved again.
    """
    scale = np.full(observed.shape[1], settings.robust_scale[1])
    if settings.causal:
        return _causal_pose_stage(subject, observed, scale, settings)
    result = _first_poses(subject, observed, rate_hz, scale, settings)
    predicted = predict(subject.rig, result.pose, result.trans)
    swaps = find_swaps(observed, predicted, settings.suspects)
    observed = undo_swaps(observed, swaps)
    noise = marker_noise(distances(observed, predicted), settings.suspects)
    scale = np.clip(settings.noise_factor * noise, *settings.robust_scale)
    stage_settings = sequence_settings(settings, warm=True, hopeless=subject.hopeless)
    drifts = (
        ()
        if subject.hopeless
        else find_drifts(
            subject.body,
            subject.shape.attachment,
            subject.rig,
            observed,
            scale,
            rate_hz,
            subject.prior,
            result,
            stage_settings,
            settings.drift,
            settings.suspects.large_residual,
        )
    )
    targets, pose, trans = bridged(
        subject.rig,
        result.pose,
        result.trans,
        observed,
        rate_hz,
        settings.gaps,
        settings.suspects.large_residual,
    )
    targets = without(targets, subject.misplaced)
    result = fit_long(
        subject.rig,
        *targets,
        scale,
        subject.prior,
        pose,
        trans,
        stage_settings,
        longest=settings.longest,
        cut=settings.windows,
    )
    return PoseStage(result, observed, targets, scale, swaps, drifts)


def _causal_pose_stage(
    subject: Subject, observed: np.ndarray, scale: np.ndarray, settings: MoshSettings
) -> PoseStage:
    """Frame after frame, from the first with enough markers."""
    first = first_frame(observed)
    start = start_sequence(
        subject.rig,
        subject.shape.pose,
        ("root", *subject.prior.joint_names),
        observed[first : first + 1],
        settings.start,
    )
    stage_settings = sequence_settings(settings)
    result = fit_causally(
        subject.rig, observed, subject.prior, start, scale, stage_settings, settings.live
    )
    return PoseStage(result, observed, MarkerTargets(observed, None), scale)


def _first_poses(
    subject: Subject,
    observed: np.ndarray,
    rate_hz: float,
    scale: np.ndarray,
    settings: MoshSettings,
) -> SequenceResult:
    """The poses of all frames from known and plain ones, each marker's noise unknown."""
    filled = MarkerTargets(fill_short_gaps(observed, rate_hz, settings.gaps), None)
    targets = without(filled, subject.misplaced)
    pose, trans = start_long(
        subject.rig,
        subject.shape.pose,
        ("root", *subject.prior.joint_names),
        targets.markers,
        settings.longest,
        settings.start,
        settings.windows,
    )
    return fit_long(
        subject.rig,
        *targets,
        scale,
        subject.prior,
        pose,
        trans,
        sequence_settings(settings, hopeless=subject.hopeless),
        longest=settings.longest,
        cut=settings.windows,
    )


def _soft_tissue_stage(
    subject: Subject, posed: PoseStage, settings: MoshSettings
) -> SequenceResult:
    """Soft tissue that changes in time, with E_Delta (MoSh eq. 10), begun from the pose stage.

    Its coefficients are changes of the shape beta_t, or dynamics, whose prior is learned:
    coefficients in root mean squares, uncorrelated.
    """
    body = subject.body
    soft = marked_body(body, subject.shape.betas, subject.shape.attachment, settings.soft_space)
    still = np.zeros((len(posed.observed), soft.num_betas))
    stage_settings = sequence_settings(settings, warm=True, hopeless=subject.hopeless)
    given = (posed.result.pose, posed.result.trans, stage_settings, still)
    return fit_long(
        soft,
        *posed.targets,
        posed.scale,
        subject.prior,
        *given,
        longest=settings.longest,
        cut=settings.windows,
    )


def assemble(
    recording: Recording,
    subject: Subject,
    pose_stage: PoseStage,
    soft: SequenceResult | None,
    seconds: Mapping[str, float | None],
    settings: MoshSettings,
) -> MarkerFit:
    """The fit of one capture, put together from what its stages found."""
    body = subject.body
    layout = subject.layout
    posed = pose_stage.result
    observed = pose_stage.observed
    final = soft or posed
    predicted = predict(subject.rig, posed.pose, posed.trans)
    residual = mapped(np.subtract, observed, predicted)
    too_few = few_markers(observed)
    soft_tissue, dynamics, predicted_soft_tissue = _soft_tissue(subject, soft, settings)
    return MarkerFit(
        capture_name=recording.name,
        body_name=body.name,
        layout_name=layout.name,
        body=body,
        up_axis=recording.up_axis,
        rate_hz=recording.rate_hz,
        labels=layout.labels,
        betas=subject.shape.betas,
        latent_markers=subject.shape.latent_markers,
        attachment=subject.shape.attachment,
        pose=final.pose,
        trans=final.trans,
        soft_tissue=soft_tissue,
        dynamics=dynamics,
        pose_stage=(posed.pose, posed.trans),
        observed_markers=observed,
        predicted_pose_stage=predicted,
        predicted_soft_tissue=predicted_soft_tissue,
        marker_weights=mapped(_of_the_seen, observed, final.weights),
        marker_noise=marker_noise(lengths(residual), settings.suspects),
        flagged_frames=too_few,
        suspects=(*recording.suspects, *_suspects(subject, pose_stage, residual, settings)),
        costs={f"shape_{k}": v for k, v in subject.shape.costs.items()} | final.costs,
        stage_seconds=seconds,
        warnings=(*recording.warnings, *flag_warning(too_few)),
        settings=asdict(settings),
        status=final.status,
        shape_status=subject.shape.status,
        seed=settings.seed,
        recorded=recording.recorded,
        layout_confidence=recording.layout_confidence,
        doubts=recording.doubts,
        displaced=subject.displaced(),
    )


def _soft_tissue(
    subject: Subject, soft: SequenceResult | None, settings: MoshSettings
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Changes of shape, coefficients of dynamics and predicted markers of the soft-tissue stage."""
    if soft is None or soft.soft_tissue is None:
        return None, None, None
    shape = subject.shape
    marked = marked_body(subject.body, shape.betas, shape.attachment, settings.soft_space)
    predicted = predict(marked, soft.pose, soft.trans, soft.soft_tissue)
    return *parted(subject.body, settings.soft_space, soft.soft_tissue), predicted


def _suspects(
    subject: Subject, pose_stage: PoseStage, residual: np.ndarray, settings: MoshSettings
) -> tuple[Suspect, ...]:
    """Of the pose stage; pairs that the subject has exchanged count in all frames with both."""
    observed = pose_stage.observed
    always = [(i, j, np.isfinite(observed[:, [i, j], 0]).all(axis=1)) for i, j in subject.exchanged]
    return suspects(
        subject.layout.labels,
        residual,
        pose_stage.scale,
        [*always, *pose_stage.swaps],
        pose_stage.drifts,
        settings.suspects,
    )


def _of_the_seen(observed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(observed[..., 0]), weights, 0.0)


FRAMES, MARKERS = 4, 2  # of the warm-up: one group of SIMD lanes, and more markers than one


def warm_up(body: BodyModel) -> float:
    """Call each kernel of a marker fit once on a few frames of this body; the seconds that took."""
    began = time.perf_counter()
    betas = np.zeros(body.num_betas)
    vertices = np.linspace(0, body.num_vertices - 1, MARKERS).astype(np.int64)
    latent = default_markers(body, betas, vertices, np.full(MARKERS, 0.01))
    rig = marked_body(body, betas, attach(latent, body.rest_vertices(betas), body.faces))
    prior = PosePrior((), np.zeros(0), np.zeros((0, 0))).for_joints(body.joint_names)
    pose = np.zeros((FRAMES, body.num_joints, 3))
    trans = np.zeros((FRAMES, 3))
    soft = np.zeros((FRAMES, body.num_betas))
    scales = np.full(MARKERS, 0.1)
    observed = predict(rig, pose, trans, soft)
    body(betas, pose[0], trans[0])
    LatentMarkers(body, body.faces[:MARKERS]).jacobian(betas, latent, pose, trans)
    brief = SequenceSettings(options=SequenceOptions(strides=(1,), sweeps=1))
    for start in (None, soft):
        fit_sequence(rig, observed, None, scales, prior, pose, trans, brief, soft_tissue=start)
    CausalSolver(rig, prior, pose[0], trans[0], brief, scales).step(observed[0])
    return time.perf_counter() - began
