"""MoSh: a body in motion from the markers of one subject (MoSh 4-6, thesis 3.4-3.6), as a recipe of
three stages.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.assembly import PoseStage, Subject, assemble
from habitus.fit.markers.causal import fit_causally
from habitus.fit.markers.drift import find_drifts
from habitus.fit.markers.gaps import Evidence, bridged, fill_short_gaps, without
from habitus.fit.markers.recordings import (
    Recording,
    check_recordings,
    ever_seen,
    first_frame,
    labels_put_back,
    of_markers,
    shape_frames,
    within_reach,
)
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.sequence import SequenceResult
from habitus.fit.markers.settings import MoshSettings, sequence_settings
from habitus.fit.markers.shape import place, shape_stage
from habitus.fit.markers.start import start_frames, start_sequence, trunk_weights
from habitus.fit.markers.suspects import (
    crossed_placements,
    exchange,
    far_placements,
    find_swaps,
    marker_noise,
    undo_swaps,
)
from habitus.fit.markers.windows import fit_long, start_long
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import marked_body, predict
from habitus.observe.markers import attach, default_markers
from habitus.observe.soft_space import check_space
from habitus.parallel.blocks import distances
from habitus.types import Progress

__all__ = [
    "Recording",
    "Subject",
    "fit_known",
    "fit_markers",
    "fit_subject",
    "iterate_fits",
    "known_subject",
]


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
    layout, recordings, subject = known_subject(body, prior, layout, recordings, settings)
    for index, recording in enumerate(recordings):
        progress(recording.name, index / len(recordings))
        with threadpool_limits(1, user_api="blas"):
            fit = _fit_recording(body, prior, layout, recording, subject, settings)
        yield fit


def known_subject(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings,
) -> tuple[MarkerLayout, list[Recording], Subject]:
    """The shape stage of a subject: its layout and recordings as they are fitted, without markers
    that are never seen, and what was found. Raises HabitusError when no frame holds enough markers.
    """
    check_space(body, settings.soft_space)
    recordings = [within_reach(recording, layout.labels) for recording in recordings]
    seen = np.any([ever_seen(r.observed) for r in recordings], axis=0)
    layout = replace(
        layout, markers=tuple(m for m, s in zip(layout.markers, seen, strict=True) if s)
    )
    recordings = [replace(r, observed=of_markers(r.observed, seen)) for r in recordings]
    recordings = _put_right(recordings, layout, settings)
    with threadpool_limits(
        1, user_api="blas"
    ):  # the matrices are small: more threads only wait for each other
        subject = fit_subject(
            body, prior.for_joints(body.joint_names), layout, recordings, settings
        )
    return layout, recordings, subject


def fit_known(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recording: Recording,
    subject: Subject,
    settings: MoshSettings,
) -> MarkerFit:
    """Pose and soft tissue in one more recording of a subject whose shape stage is done, on the
    layout that it gave.

    Raises HabitusError when no frame holds enough markers.
    """
    (recording,) = _put_right([within_reach(recording, layout.labels)], layout, settings)
    with threadpool_limits(1, user_api="blas"):
        return _fit_recording(
            body, prior.for_joints(body.joint_names), layout, recording, subject, settings
        )


def _put_right(
    recordings: list[Recording], layout: MarkerLayout, settings: MoshSettings
) -> list[Recording]:
    """The recordings, once they are sound, with labels that were exchanged for a time put back,
    live fits' apart.
    """
    check_recordings(recordings)
    if settings.causal:
        return recordings
    return [labels_put_back(recording, layout.labels) for recording in recordings]


def fit_subject(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings,
) -> Subject:
    """The shape stage on a few frames of all captures; a pair of labels exchanged throughout is
    found and put right.
    """
    began = time.perf_counter()
    placement = place(layout, body)
    observed, sources = shape_frames(recordings, settings)
    latent = default_markers(body, np.zeros(body.num_betas), placement.vertices, placement.distance)
    rig = marked_body(
        body,
        np.zeros(body.num_betas),
        attach(latent, body.rest_vertices(np.zeros(body.num_betas)), body.faces),
    )
    trunk = trunk_weights(body, placement.vertices)
    aligning = trunk if settings.start_markers == "trunk" else np.ones_like(trunk)
    pose, trans = start_frames(rig, body.joint_names, aligning, observed, prior)
    shape = shape_stage(body, placement, observed, prior, pose, trans, settings)
    start = default_markers(body, shape.betas, placement.vertices, placement.distance)
    exchanged = crossed_placements(shape.latent_markers, start)
    if exchanged:
        observed = exchange(observed, exchanged)
        shape = shape_stage(body, placement, observed, prior, shape.pose, shape.trans, settings)
        start = default_markers(body, shape.betas, placement.vertices, placement.distance)
    rig = marked_body(body, shape.betas, shape.attachment)
    distance = np.linalg.norm(observed - predict(rig, shape.pose, shape.trans), axis=2)
    misplaced = far_placements(shape.latent_markers, start, placement.place_spread, distance)
    if misplaced:
        observed = np.where(np.isin(np.arange(len(layout)), misplaced)[:, None], np.nan, observed)
        shape = shape_stage(body, placement, observed, prior, shape.pose, shape.trans, settings)
        rig = marked_body(body, shape.betas, shape.attachment)
    return Subject(shape, rig, exchanged, misplaced, time.perf_counter() - began, sources)


def _fit_recording(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recording: Recording,
    subject: Subject,
    settings: MoshSettings,
) -> MarkerFit:
    """Pose stage and soft-tissue stage of one capture."""
    observed = exchange(recording.observed, subject.exchanged)
    began = time.perf_counter()
    found = _pose_stage(body, subject, observed, recording.rate_hz, prior, settings)
    pose_seconds = time.perf_counter() - began
    began = time.perf_counter()
    soft = (
        _soft_tissue_stage(body, subject, found, prior, settings) if settings.soft_tissue else None
    )
    soft_seconds = time.perf_counter() - began if soft else None
    seconds = {"shape": subject.seconds, "pose": pose_seconds, "soft_tissue": soft_seconds}
    return assemble(body, layout, recording, subject, found, soft, seconds, settings)


def _pose_stage(
    body: BodyModel,
    subject: Subject,
    observed: np.ndarray,
    rate_hz: float,
    prior: PosePrior,
    settings: MoshSettings,
) -> PoseStage:
    """All frames at once; then each marker's noise is known, exchanged pairs are put right, sliding
    markers found, gaps bridged, and it is solved again.
    """
    scale = np.full(observed.shape[1], settings.robust_scale[1])
    if settings.causal:
        first = first_frame(observed)
        known = (
            subject.rig,
            subject.shape.pose,
            ("root", *prior.joint_names),
            observed[first : first + 1],
        )
        start = start_sequence(*known)
        result = fit_causally(
            subject.rig, observed, prior, start, scale, sequence_settings(settings)
        )
        return PoseStage(result, observed, Evidence(observed, None), scale)
    longest = settings.longest
    lam = sequence_settings(settings)
    first = without(Evidence(fill_short_gaps(observed, rate_hz), None), subject.misplaced)
    pose, trans = start_long(
        subject.rig, subject.shape.pose, ("root", *prior.joint_names), first.markers, longest
    )
    result = fit_long(subject.rig, *first, scale, prior, pose, trans, lam, longest=longest)
    predicted = predict(subject.rig, result.pose, result.trans)
    swaps = find_swaps(observed, predicted)
    observed = undo_swaps(observed, swaps)
    noise = marker_noise(distances(observed, predicted))
    scale = np.clip(settings.noise_factor * noise, *settings.robust_scale)
    lam = sequence_settings(settings, warm=True)
    drifts = find_drifts(
        body, subject.shape.attachment, subject.rig, observed, scale, rate_hz, prior, result, lam
    )
    evidence, pose, trans = bridged(subject.rig, result.pose, result.trans, observed, rate_hz)
    evidence = without(evidence, subject.misplaced)
    result = fit_long(subject.rig, *evidence, scale, prior, pose, trans, lam, longest=longest)
    return PoseStage(result, observed, evidence, scale, swaps, drifts)


def _soft_tissue_stage(
    body: BodyModel, subject: Subject, found: PoseStage, prior: PosePrior, settings: MoshSettings
) -> SequenceResult:
    """Soft tissue let go in time, with E_Delta (eq. 10), begun from the pose stage: the shape's
    changes beta_t, or dynamics, whose prior is what was learned: their coefficients are in root
    mean squares, and not correlated.
    """
    soft = marked_body(body, subject.shape.betas, subject.shape.attachment, settings.soft_space)
    still = np.zeros((len(found.observed), soft.num_betas))
    lam = sequence_settings(settings, warm=True)
    given = (found.result.pose, found.result.trans, lam, still)
    return fit_long(soft, *found.evidence, found.scale, prior, *given, longest=settings.longest)
