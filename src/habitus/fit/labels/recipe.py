"""Labels for unlabelled points: tracklets, single frames registered, the person's shape, and votes
over time. All constants are in `LabelSettings`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.labels.clouds import Clouds, telling_frames, tracklets
from habitus.fit.labels.clusters import separated
from habitus.fit.labels.exchanges import resolve_exchanges
from habitus.fit.labels.people import nearest_bodies, only, people_on_ground
from habitus.fit.labels.registration import (
    SINGLE_FRAMES,
    Registered,
    at_height,
    plain_poses,
    register,
)
from habitus.fit.labels.settings import LABELS, LabelSettings
from habitus.fit.labels.votes import (
    assign,
    averaged,
    best_seeds,
    distances,
    judged,
    seed_votes,
    without_duplicates,
)
from habitus.fit.markers.energy import Placement, place
from habitus.fit.markers.sequence import WORST_FIRST, SequenceResult, fit_long
from habitus.fit.markers.settings import MoshSettings, sequence_settings
from habitus.fit.markers.shape import shape_stage
from habitus.fit.markers.start import start_long
from habitus.kernels.threads import one_blas_thread
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import MarkedBody, marked_body, predict
from habitus.observe.markers import MarkerAttachment, attach, default_markers


@dataclass(frozen=True)
class Known:
    """A person whose shape and marker places are known: betas (B,), the attachment of the layout's
    markers, and poses (N, J, 3) that they have been seen in; sure (M,): how well the places
    separate each marker from its nearest rival.
    """

    betas: Float[np.ndarray, " B"]
    attachment: MarkerAttachment
    poses: Float[np.ndarray, "N J 3"]
    sure: Float[np.ndarray, " M"] | None = None


class Convergence(NamedTuple):
    """How the solves of labelling ended: status and iterations of the last fit of all frames, as of
    a marker fit's pose stage; how many frames were registered by themselves, and how many of these
    ended with a step below `RegistrationSettings.tolerance`.
    """

    status: str
    iterations: int
    registered_frames: int
    converged_frames: int

    @staticmethod
    def of(result: SequenceResult, seeds: Registered, tolerance: float) -> "Convergence":
        """Of one person."""
        converged = int((seeds.last_step <= tolerance).sum())
        return Convergence(result.status, result.iterations, len(seeds.frames), converged)

    @staticmethod
    def of_all(each: Sequence["Convergence"]) -> "Convergence":
        """Of several people: the worst status, and sums."""
        status = min((convergence.status for convergence in each), key=WORST_FIRST.index)
        return Convergence(status, *(sum(column) for column in list(zip(*each, strict=True))[1:]))


@dataclass(frozen=True)
class Named:
    """Names of points: label (P,) of each, an index into the layout's markers, -1 for none.

    confidence (P,), 0..1, of that label, and for points without one, of the best that was refused;
    tracklet (P,); sure (M,): how well each label is separated from its nearest rival; convergence:
    how the solves ended. Of several people, the labels of one follow another's.
    """

    label: Int[np.ndarray, " P"]
    confidence: Float[np.ndarray, " P"]
    tracklet: Int[np.ndarray, " P"]
    sure: Float[np.ndarray, " M"]
    convergence: Convergence


@dataclass(frozen=True)
class Labels(Named):
    """Result of `label_points`; known: the person; result: the poses that the labels were judged
    by.
    """

    known: Known
    result: SequenceResult

    def predicted(self, body: BodyModel) -> Float[np.ndarray, "T M 3"]:
        """Where the person's markers are in every frame, metres."""
        rig = marked_body(body, self.known.betas, self.known.attachment)
        return predict(rig, self.result.pose, self.result.trans)


def label_points(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    clouds: Clouds,
    known: Known | None = None,
    settings: LabelSettings = LABELS,
) -> Labels:
    """Which of the layout's markers each point is.

    known: the person, where another capture gave it; else shape and places are found here. Raises
    HabitusError where no frame holds enough points.
    """
    prior = prior.for_joints(body.joint_names)
    max_points = int(np.diff(clouds.start).max(initial=0))
    if max_points < settings.min_points:
        raise HabitusError(
            f"at most {max_points} points are there in any frame; expected at least "
            f"{settings.min_points}"
        )
    with one_blas_thread():
        pieces = tracklets(clouds, settings.tracklets)
        frames = telling_frames(clouds, settings.seeds)
        placement = place(layout, body)
        if known is None:
            known = _person(body, prior, placement, clouds, pieces, frames, settings)
        return _voted(body, prior, placement, clouds, pieces, frames, known, settings)


def label_people(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    clouds: Clouds,
    people: int,
    settings: LabelSettings = LABELS,
) -> Named:
    """Which of the markers of which of several people in one layout each point is; people stand
    apart on the whole.

    Labels of person k are those of the layout plus k times their number. Raises HabitusError as
    `label_points`.
    """
    pieces = tracklets(clouds, settings.tracklets)
    known = [None] * people
    who = people_on_ground(clouds, pieces, people, settings.people)
    for _ in range(settings.people_rounds):
        parts = [only(clouds, who == k) for k in range(people)]
        labels = [
            label_points(body, prior, layout, p, k, settings)
            for p, k in zip(parts, known, strict=True)
        ]
        before = who
        who = nearest_bodies(clouds, pieces, [each.predicted(body) for each in labels])
        if (who == before).all():
            break
        known = [each.known for each in labels]
    label = np.full(len(who), -1)
    confidence = np.zeros(len(who))
    for k, each in enumerate(labels):
        label[before == k] = np.where(each.label >= 0, each.label + k * len(layout), -1)
        confidence[before == k] = each.confidence
    sure = np.concatenate([each.sure for each in labels])
    solved = Convergence.of_all([each.convergence for each in labels])
    return Named(label, confidence, pieces, sure, solved)


def misfit(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    clouds: Clouds,
    frames: Int[np.ndarray, " F"],
    settings: LabelSettings = LABELS,
) -> float:
    """What single frames cost on a layout, at the likeliest height, markers and points without each
    other included.
    """
    prior = prior.for_joints(body.joint_names)
    placement = place(layout, body)
    bank = plain_poses(body.joint_names)
    search = settings.registration
    lone = (
        0.5
        * SINGLE_FRAMES.data
        * settings.registration.firm[-1] ** 2
        * np.abs(np.diff(clouds.start)[frames] - len(layout))
    )
    tries = [
        register(_default(body, placement, at_height(body, h)), prior, clouds, frames, bank, search)
        for h in settings.heights[1:]
    ]
    return float(min(np.median(each.cost + lone) for each in tries))


def _person(
    body: BodyModel,
    prior: PosePrior,
    placement: Placement,
    clouds: Clouds,
    pieces: np.ndarray,
    frames: np.ndarray,
    settings: LabelSettings,
) -> Known:
    """Shape and marker places from single frames on a body of the likeliest height."""
    bank = plain_poses(body.joint_names)
    search = settings.registration
    few = frames[:: max(1, len(frames) // settings.sizing_frames)]
    tries = [
        register(_default(body, placement, at_height(body, h)), prior, clouds, few, bank, search)
        for h in settings.heights
    ]
    typical = [np.sort(each.cost)[: max(1, len(few) // 2)].mean() for each in tries]
    betas = at_height(body, settings.heights[int(np.argmin(typical))])
    rig = _default(body, placement, betas)
    seeds = register(rig, prior, clouds, frames, bank, settings.registration)
    label, agreed = seed_votes(clouds, seeds, pieces, len(placement.vertices), settings.votes)
    best = seeds.of(best_seeds(seeds, agreed, settings.votes.shape_seeds))
    state = (best.pose, best.trans)
    weights = _place_weights(placement, settings.place_weight)
    label, _ = resolve_exchanges(
        rig, prior, clouds, pieces, label, best.frames, state, weights, settings.exchanges
    )
    for _ in range(settings.shape_rounds):
        observed = clouds.labelled(label, len(placement.vertices))[best.frames]
        shape = shape_stage(body, placement, observed, prior, *state, settings.fit)
        state = (shape.pose, shape.trans)
        rig = _default(body, placement, shape.betas)
        before = label
        label, sure = resolve_exchanges(
            rig, prior, clouds, pieces, label, best.frames, state, weights, settings.exchanges
        )
        if (label == before).all():
            break
    attachment = separated(
        body,
        shape.betas,
        shape.attachment,
        placement,
        clouds,
        label,
        best.frames,
        state,
        settings.clusters,
    )
    return Known(shape.betas, attachment, shape.pose, sure)


def _voted(
    body: BodyModel,
    prior: PosePrior,
    placement: Placement,
    clouds: Clouds,
    pieces: np.ndarray,
    frames: np.ndarray,
    known: Known,
    settings: LabelSettings,
) -> Labels:
    """Seeds on the person's own body, all frames fitted to what they say, and each tracklet called
    by what is near.
    """
    rig = marked_body(body, known.betas, known.attachment)
    count = len(placement.vertices)
    bank = np.concatenate([plain_poses(body.joint_names), known.poses])
    seeds = register(rig, prior, clouds, frames, bank, settings.registration)
    label, _ = seed_votes(clouds, seeds, pieces, count, settings.votes)
    result = None
    looked = telling_frames(clouds, settings.exchange_frames)
    for gate in settings.gates:
        result = _fitted(rig, prior, clouds.labelled(label, count), known, result, settings.fit)
        squared = distances(clouds, predict(rig, result.pose, result.trans), settings.votes)
        label = assign(averaged(squared, pieces), clouds, np.full(len(pieces), gate**2))
        state = result.pose[looked], result.trans[looked]
        weights = np.full(count, settings.unlabelled_weight)
        label, sure = resolve_exchanges(
            rig, prior, clouds, pieces, label, looked, state, weights, settings.exchanges
        )
        label = without_duplicates(label, -np.min(squared, axis=1), clouds)
    result = _fitted(rig, prior, clouds.labelled(label, count), known, result, settings.fit)
    squared = distances(clouds, predict(rig, result.pose, result.trans), settings.votes)
    sure = sure if known.sure is None else np.minimum(sure, known.sure)
    label, confidence = judged(squared, label, pieces, clouds, sure, settings.votes)
    solved = Convergence.of(result, seeds, settings.registration.tolerance)
    return Labels(label, confidence, pieces, sure, solved, known, result)


def _fitted(
    rig: MarkedBody,
    prior: PosePrior,
    observed: Float[np.ndarray, "T M 3"],
    known: Known,
    before: SequenceResult | None,
    settings: MoshSettings,
) -> SequenceResult:
    """Poses of all frames, from the fit before or from poses that are known."""
    if before is None:
        start = start_long(
            rig, known.poses, ("root", *prior.joint_names), observed, settings.longest
        )
    else:
        start = before.pose, before.trans
    stage_settings = sequence_settings(settings, warm=before is not None)
    scale = np.full(rig.num_markers, settings.robust_scale[1])
    return fit_long(
        rig, observed, None, scale, prior, *start, stage_settings, longest=settings.longest
    )


def _default(body: BodyModel, placement: Placement, betas: np.ndarray) -> MarkedBody:
    """A body with its markers where the layout has them."""
    latent = default_markers(body, betas, placement.vertices, placement.distance)
    return marked_body(body, betas, attach(latent, body.rest_vertices(betas), body.faces))


def _place_weights(placement: Placement, weight: float) -> Float[np.ndarray, " M"]:
    return weight * (0.02 / np.maximum(placement.place_spread, 0.015)) ** 2
