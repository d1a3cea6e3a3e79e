"""The result of a marker fit, put together from what its stages found."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.fit.markers.drift import Drift
from habitus.fit.markers.gaps import Evidence
from habitus.fit.markers.recordings import Recording, few_markers, flag_warning
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.sequence import SequenceResult
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import ShapeFit
from habitus.fit.markers.suspects import lengths, marker_noise, suspects
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import MarkedBody, marked_body, predict
from habitus.observe.markers import default_markers
from habitus.observe.soft_space import parted
from habitus.parallel.blocks import mapped


@dataclass(frozen=True)
class Subject:
    """What is found once for a subject: the shape stage's result, the rig it gives, pairs of
    exchanged labels, and markers (columns) that sit too far from their places to be the ones meant.
    ``sources``: the recordings, by number, whose frames the shape stage looked at.
    """

    shape: ShapeFit
    rig: MarkedBody
    exchanged: tuple[tuple[int, int], ...]
    misplaced: tuple[int, ...]
    seconds: float
    sources: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class PoseStage:
    """What the pose stage found: its result, the markers with exchanged labels put right (T, M, 3),
    what the result was held against, the robust scales (M,) in metres, pairs put back
    (`find_swaps`), and markers that slide.
    """

    result: SequenceResult
    observed: Float[np.ndarray, "T M 3"]
    evidence: Evidence
    scale: Float[np.ndarray, " M"]
    swaps: Sequence[tuple[int, int, Bool[np.ndarray, " T"]]] = ()
    drifts: tuple[Drift, ...] = ()


def assemble(
    body: BodyModel,
    layout: MarkerLayout,
    recording: Recording,
    subject: Subject,
    found: PoseStage,
    soft: SequenceResult | None,
    seconds: Mapping[str, float | None],
    settings: MoshSettings,
) -> MarkerFit:
    """The fit of one capture."""
    posed = found.result
    observed = found.observed
    final = soft or posed
    predicted = predict(subject.rig, posed.pose, posed.trans)
    off = mapped(np.subtract, observed, predicted)
    few = few_markers(observed)
    place = default_markers(body, subject.shape.betas, layout.vertices(body), layout.distances())
    change = None
    moving = None
    moved = None
    if soft is not None and soft.soft_tissue is not None:
        marked = marked_body(
            body, subject.shape.betas, subject.shape.attachment, settings.soft_space
        )
        change, moving = parted(body, settings.soft_space, soft.soft_tissue)
        moved = predict(marked, soft.pose, soft.trans, soft.soft_tissue)
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
        soft_tissue=change,
        dynamics=moving,
        pose_stage=(posed.pose, posed.trans),
        observed_markers=observed,
        predicted_pose_stage=predicted,
        predicted_soft_tissue=moved,
        marker_weights=mapped(_of_the_seen, observed, final.weights),
        marker_noise=marker_noise(lengths(off)),
        flagged_frames=few,
        suspects=(
            *recording.suspects,
            *suspects(layout.labels, off, found.scale, [*always, *found.swaps], found.drifts),
        ),
        costs={f"shape_{k}": v for k, v in subject.shape.costs.items()} | final.costs,
        stage_seconds=seconds,
        warnings=(*recording.warnings, *flag_warning(few)),
        settings=asdict(settings),
        status=final.status,
        seed=settings.seed,
        recorded=recording.recorded,
        layout_confidence=recording.layout_confidence,
        doubts=recording.doubts,
        displaced=np.linalg.norm(subject.shape.latent_markers - place, axis=1)
        / layout.place_spreads(),
    )


def _of_the_seen(observed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(observed[..., 0]), weights, 0.0)
