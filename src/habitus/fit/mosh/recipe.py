"""MoSh: a body in motion from the markers of one subject (MoSh 4-6, thesis 3.4-3.6), as a recipe of three stages."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.mosh.causal import CausalSolver
from habitus.fit.mosh.frames import random_frames, spread_frames
from habitus.fit.mosh.result import MarkerFit
from habitus.fit.mosh.sequence import SequenceResult, fit_sequence
from habitus.fit.mosh.settings import MoshSettings, SequenceSettings
from habitus.fit.mosh.shape import Placement, ShapeFit, shape_stage
from habitus.fit.mosh.start import TRUNK, start_frames, start_sequence
from habitus.fit.mosh.suspects import Suspect, crossed_placements, find_swaps, marker_noise, suspects, undo_swaps
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import MarkedBody, marked_body, predict
from habitus.observe.markers import attach
from habitus.observe.rest import RestShape
from habitus.residuals.robust import geman_mcclure_weight
from habitus.residuals.shape_stage import PER_CM2
from habitus.solve.sequence.solver import SequenceOptions
from habitus.types import Progress

FEWEST_MARKERS = 4  # a frame with fewer keeps the prior's motion and is flagged


@dataclass(frozen=True)
class Recording:
    """One capture: markers (T, M, 3) in the layout's order, metres, NaN where missing; suspects found so far."""

    name: str
    observed: Float[np.ndarray, "T M 3"]
    rate_hz: float
    up_axis: str = "+z"
    warnings: tuple[str, ...] = ()
    suspects: tuple[Suspect, ...] = ()


@dataclass(frozen=True)
class Subject:
    """What is found once for a subject: the shape stage's result, the rig it gives, and pairs of exchanged labels."""

    shape: ShapeFit
    rig: MarkedBody
    exchanged: tuple[tuple[int, int], ...]
    seconds: float


def fit_markers(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings | None = None,
    progress: Progress = lambda stage, share: None,
) -> tuple[MarkerFit, ...]:
    """Shape, latent markers, pose and soft tissue of one subject from one or more captures with the same M markers.

    body: an LBS model (float64 inside). prior: of SMPL's joints or any others, matched by name. Raises HabitusError
    when no frame holds enough markers to fit a body to.
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
    body, prior = body.to(torch.float64), prior.for_joints(body.joint_names)
    seen = np.any([np.isfinite(r.observed[..., 0]).any(axis=0) for r in recordings], axis=0)
    layout = replace(layout, markers=tuple(m for m, s in zip(layout.markers, seen, strict=True) if s))
    recordings = [replace(r, observed=np.ascontiguousarray(r.observed[:, seen])) for r in recordings]
    _check(recordings)
    progress("shape", 0.0)
    with threadpool_limits(1, user_api="blas"):  # the matrices are small: more threads only wait for each other
        subject = fit_subject(body, prior, layout, recordings, settings)
    for index, recording in enumerate(recordings):
        progress(recording.name, index / len(recordings))
        with threadpool_limits(1, user_api="blas"):
            fit = _fit_recording(body, prior, layout, recording, subject, settings)
        yield fit


def fit_subject(
    body: BodyModel, prior: PosePrior, layout: MarkerLayout, recordings: Sequence[Recording], settings: MoshSettings
) -> Subject:
    """The shape stage on a few frames of all captures; a pair of labels exchanged throughout is found and put right."""
    began = time.perf_counter()
    placement = place(layout, body)
    observed = _shape_frames(recordings, settings)
    rest = RestShape(body)
    latent, _ = rest.default_markers(np.zeros(rest.num_betas), placement.vertices, placement.distance)
    rig = marked_body(
        body, np.zeros(rest.num_betas), attach(latent, rest.vertices(np.zeros(rest.num_betas)), rest.faces)
    )
    pose, trans = start_frames(rig, body.joint_names, trunk_weights(body, placement), observed, prior)
    shape = shape_stage(body, placement, observed, prior, pose, trans, settings)
    start, _ = rest.default_markers(shape.betas, placement.vertices, placement.distance)
    exchanged = crossed_placements(shape.latent_markers, start)
    if exchanged:
        observed = exchange(observed, exchanged)
        shape = shape_stage(body, placement, observed, prior, shape.pose, shape.trans, settings)
    return Subject(shape, marked_body(body, shape.betas, shape.attachment), exchanged, time.perf_counter() - began)


def place(layout: MarkerLayout, body: BodyModel) -> Placement:
    """The layout's markers on this body's template."""
    return Placement(layout.vertices(body), layout.distances(), layout.distance_spreads(), layout.place_spreads())


def trunk_weights(body: BodyModel, placement: Placement) -> np.ndarray:
    """(M,) weight of each marker when the root is aligned: markers on the trunk count."""
    strongest = body.skinning_index.gather(1, body.skinning_value.argmax(dim=1, keepdim=True))[:, 0].cpu().numpy()
    on_trunk = [body.joint_names[joint] in TRUNK for joint in strongest[placement.vertices]]
    return np.where(on_trunk, 1.0, 0.02)


def exchange(observed: np.ndarray, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    """Markers (T, M, 3) with the columns of each pair exchanged."""
    order = np.arange(observed.shape[1])
    for i, j in pairs:
        order[[i, j]] = order[[j, i]]
    return observed[:, order]


def _shape_frames(recordings: Sequence[Recording], settings: MoshSettings) -> np.ndarray:
    together = np.concatenate([r.observed for r in recordings])
    choose = random_frames if settings.frame_choice == "random" else spread_frames
    return together[choose(together, settings.frames, settings.seed)]


def _check(recordings: Sequence[Recording]) -> None:
    most = max((int(np.isfinite(r.observed[..., 0]).sum(axis=1).max(initial=0)) for r in recordings), default=0)
    if most < FEWEST_MARKERS:
        raise HabitusError(
            f"{', '.join(r.name for r in recordings)}: at most {most} known markers are visible in any frame; "
            f"expected at least {FEWEST_MARKERS}; check the labels with `habitus layout check`"
        )


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
    posed, observed, scale, swaps = _pose_stage(subject, observed, prior, settings)
    pose_seconds, began = time.perf_counter() - began, time.perf_counter()
    soft = _soft_tissue_stage(subject, observed, prior, posed, scale, settings) if settings.soft_tissue else None
    soft_seconds = time.perf_counter() - began if soft else None
    final = soft or posed
    predicted = predict(subject.rig, posed.pose, posed.trans)
    distance = np.linalg.norm(observed - predicted, axis=2)
    few = np.isfinite(observed[..., 0]).sum(axis=1) < FEWEST_MARKERS
    always = [(i, j, np.isfinite(observed[:, [i, j], 0]).all(axis=1)) for i, j in subject.exchanged]
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
        soft_tissue=soft.soft_tissue if soft else None,
        pose_stage=(posed.pose, posed.trans),
        observed_markers=observed,
        predicted_pose_stage=predicted,
        predicted_soft_tissue=predict(subject.rig, soft.pose, soft.trans, soft.soft_tissue) if soft else None,
        marker_weights=final.weights,
        marker_noise=marker_noise(distance),
        flagged_frames=few,
        suspects=(*recording.suspects, *suspects(layout.labels, distance, scale, [*always, *swaps])),
        costs={f"shape_{k}": v for k, v in subject.shape.costs.items()} | final.costs,
        stage_seconds={"shape": subject.seconds, "pose": pose_seconds, "soft_tissue": soft_seconds},
        warnings=(*recording.warnings, *_flag_warning(few)),
        settings=asdict(settings),
        status=final.status,
        seed=settings.seed,
    )


def _pose_stage(
    subject: Subject, observed: np.ndarray, prior: PosePrior, settings: MoshSettings
) -> tuple[SequenceResult, np.ndarray, np.ndarray, list]:
    """All frames at once; then each marker's noise is known, exchanged pairs are put right, and it is solved again."""
    scale = np.full(observed.shape[1], settings.robust_scale[1])
    if settings.causal:
        return _causal_stage(subject, observed, prior, scale, settings), observed, scale, []
    lam = sequence_settings(settings)
    pose, trans = start_sequence(subject.rig, subject.shape.pose, ("root", *prior.joint_names), observed)
    result = fit_sequence(subject.rig, observed, None, scale, prior, pose, trans, lam)
    predicted = predict(subject.rig, result.pose, result.trans)
    swaps = find_swaps(observed, predicted)
    observed = undo_swaps(observed, swaps)
    noise = marker_noise(np.linalg.norm(observed - predicted, axis=2))
    scale = np.clip(settings.noise_factor * noise, *settings.robust_scale)
    result = fit_sequence(
        subject.rig, observed, None, scale, prior, result.pose, result.trans, sequence_settings(settings, warm=True)
    )
    return result, observed, scale, swaps


def _causal_stage(
    subject: Subject, observed: np.ndarray, prior: PosePrior, scale: np.ndarray, settings: MoshSettings
) -> SequenceResult:
    """Frame after frame, each from itself and the two before it, as the paper filters; only the shape saw others."""
    names, first = (
        ("root", *prior.joint_names),
        int(np.argmax(np.isfinite(observed[..., 0]).sum(axis=1) >= FEWEST_MARKERS)),
    )
    pose, trans = start_sequence(subject.rig, subject.shape.pose, names, observed[first : first + 1])
    solver = CausalSolver(subject.rig, prior, pose[0], trans[0], sequence_settings(settings), scale)
    frames = [solver.step(markers) for markers in observed]
    pose, trans = np.stack([frame.pose for frame in frames]), np.stack([frame.trans for frame in frames])
    distance = np.linalg.norm(predict(subject.rig, pose, trans) - observed, axis=2)
    weights = np.nan_to_num(geman_mcclure_weight(distance, scale))
    costs = np.array([frame.cost for frame in frames])
    total = float(costs.sum())
    return SequenceResult(pose, trans, None, {"frames": total}, costs, weights, "causal", len(frames), (total,))


def sequence_settings(settings: MoshSettings, warm: bool = False) -> SequenceSettings:
    """The paper's weights in metres; ``warm`` starts are solved at the finest level at once, with little damping."""
    lam = settings.pose
    options = SequenceOptions(strides=(1,), damping=1.0) if warm else SequenceOptions()
    return SequenceSettings(
        PER_CM2 * lam.data, lam.pose, lam.acceleration, soft_tissue=lam.soft_tissue, options=options
    )


def _soft_tissue_stage(
    subject: Subject,
    observed: np.ndarray,
    prior: PosePrior,
    posed: SequenceResult,
    scale: np.ndarray,
    settings: MoshSettings,
) -> SequenceResult:
    """The shape let go in time, beta_t, with E_Delta (eq. 10); begun from the pose stage."""
    still = np.zeros((len(observed), subject.rig.num_betas))
    return fit_sequence(
        subject.rig,
        observed,
        None,
        scale,
        prior,
        posed.pose,
        posed.trans,
        sequence_settings(settings, warm=True),
        soft_tissue=still,
    )


def _flag_warning(few: np.ndarray) -> tuple[str, ...]:
    if not few.any():
        return ()
    return (
        f"{int(few.sum())} of {len(few)} frames hold fewer than {FEWEST_MARKERS} markers; they keep the prior's motion",
    )
