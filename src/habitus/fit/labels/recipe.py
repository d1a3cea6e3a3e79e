"""Names for points that have none: tracklets, single frames registered, the person's shape, and
votes in time.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.labels.clouds import Clouds, telling_frames, tracklets
from habitus.fit.labels.clusters import told_apart
from habitus.fit.labels.exchanges import untangle
from habitus.fit.labels.people import heaps, nearest_bodies, only
from habitus.fit.labels.registration import APART, FIRM, at_height, plain_poses, register
from habitus.fit.labels.votes import (
    assign,
    averaged,
    best_seeds,
    distances,
    judged,
    once,
    seed_votes,
)
from habitus.fit.markers.energy import Placement, place
from habitus.fit.markers.sequence import SequenceResult, fit_long
from habitus.fit.markers.settings import MoshSettings, sequence_settings
from habitus.fit.markers.shape import shape_stage
from habitus.fit.markers.start import start_long
from habitus.markers.layouts import MarkerLayout
from habitus.observe.marker_prediction import MarkedBody, marked_body, predict
from habitus.observe.markers import MarkerAttachment, attach, default_markers

HEIGHTS = (1.25, 1.45, 1.6, 1.75, 1.9)  # metres: bodies that single frames are tried on
SIZING_FRAMES = 8  # frames that the height is found from
SEEDS = 24  # frames that are registered by themselves and vote
LOOKED_AT = 30  # frames in which exchanges of near markers are tried
PARTINGS = 2  # rounds of labels for several people, who are parted anew by the bodies found
SHAPES = 2  # rounds of shape and exchanges, at most
GATES = (0.20, 0.15)  # metres: a tracklet further from every marker has no label, round by round
FEWEST_POINTS = 6  # in the fullest frame
PLACE_WEIGHT = 800.0
OWN_WEIGHT = 2500.0  # per m^2, of markers where a layout has them and where they were found


@dataclass(frozen=True)
class Known:
    """A person whose shape and marker places are known: betas (B,), the attachment of the layout's
    markers, and poses (N, J, 3) that they have been seen in; sure (M,): how well the places tell
    each marker from its nearest rival.
    """

    betas: Float[np.ndarray, " B"]
    attachment: MarkerAttachment
    poses: Float[np.ndarray, "N J 3"]
    sure: Float[np.ndarray, " M"] | None = None


@dataclass(frozen=True)
class Named:
    """Names of points: label (P,) of each, an index into the layout's markers, -1 for none.

    confidence (P,), 0..1, of that label, and for points without one, of the best that was refused;
    tracklet (P,); sure (M,): how well each label is told from its nearest rival. Of several people,
    the labels of one follow another's.
    """

    label: Int[np.ndarray, " P"]
    confidence: Float[np.ndarray, " P"]
    tracklet: Int[np.ndarray, " P"]
    sure: Float[np.ndarray, " M"]


@dataclass(frozen=True)
class Labels(Named):
    """What `label_points` found; known: the person; result: the poses that the labels were judged
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
    settings: MoshSettings | None = None,
) -> Labels:
    """Which of the layout's markers each point is.

    known: the person, where another capture told; else shape and places are found here. Raises
    HabitusError where no frame holds enough points.
    """
    settings = settings or MoshSettings()
    prior = prior.for_joints(body.joint_names)
    most = int(np.diff(clouds.start).max(initial=0))
    if most < FEWEST_POINTS:
        raise HabitusError(
            f"at most {most} points are there in any frame; expected at least {FEWEST_POINTS}"
        )
    with threadpool_limits(1, user_api="blas"):
        pieces = tracklets(clouds)
        frames = telling_frames(clouds, SEEDS)
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
    settings: MoshSettings | None = None,
) -> Named:
    """Which of the markers of which of several people in one layout each point is; people stand
    apart on the whole.

    Labels of person k are those of the layout plus k times their number. Raises HabitusError as
    `label_points`.
    """
    pieces = tracklets(clouds)
    known = [None] * people
    who = heaps(clouds, pieces, people)
    for _ in range(PARTINGS):
        parts = [only(clouds, who == k) for k in range(people)]
        found = [
            label_points(body, prior, layout, p, k, settings)
            for p, k in zip(parts, known, strict=True)
        ]
        before = who
        who = nearest_bodies(clouds, pieces, [each.predicted(body) for each in found])
        if (who == before).all():
            break
        known = [each.known for each in found]
    label = np.full(len(who), -1)
    confidence = np.zeros(len(who))
    for k, each in enumerate(found):
        label[before == k] = np.where(each.label >= 0, each.label + k * len(layout), -1)
        confidence[before == k] = each.confidence
    return Named(label, confidence, pieces, np.concatenate([each.sure for each in found]))


def misfit(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    clouds: Clouds,
    frames: Int[np.ndarray, " F"],
) -> float:
    """What single frames cost on a layout, at the likeliest height, markers and points without each
    other included.
    """
    prior = prior.for_joints(body.joint_names)
    placement = place(layout, body)
    bank = plain_poses(body.joint_names)
    lone = 0.5 * APART.data * FIRM[-1] ** 2 * np.abs(np.diff(clouds.start)[frames] - len(layout))
    tries = [
        register(_default(body, placement, at_height(body, h)), prior, clouds, frames, bank)
        for h in HEIGHTS[1:]
    ]
    return float(min(np.median(found.cost + lone) for found in tries))


def _person(
    body: BodyModel,
    prior: PosePrior,
    placement: Placement,
    clouds: Clouds,
    pieces: np.ndarray,
    frames: np.ndarray,
    settings: MoshSettings,
) -> Known:
    """Shape and marker places from single frames on a body of the likeliest height."""
    bank = plain_poses(body.joint_names)
    few = frames[:: max(1, len(frames) // SIZING_FRAMES)]
    tries = [
        register(_default(body, placement, at_height(body, h)), prior, clouds, few, bank)
        for h in HEIGHTS
    ]
    typical = [np.sort(found.cost)[: max(1, len(few) // 2)].mean() for found in tries]
    betas = at_height(body, HEIGHTS[int(np.argmin(typical))])
    rig = _default(body, placement, betas)
    seeds = register(rig, prior, clouds, frames, bank)
    label, agreed = seed_votes(clouds, seeds, pieces, len(placement.vertices))
    best = seeds.of(best_seeds(seeds, agreed))
    state = (best.pose, best.trans)
    weights = _place_weights(placement)
    label, _ = untangle(rig, prior, clouds, pieces, label, best.frames, state, weights)
    for _ in range(SHAPES):
        observed = clouds.labelled(label, len(placement.vertices))[best.frames]
        shape = shape_stage(body, placement, observed, prior, *state, settings)
        state = (shape.pose, shape.trans)
        rig = _default(body, placement, shape.betas)
        before = label
        label, sure = untangle(rig, prior, clouds, pieces, label, best.frames, state, weights)
        if (label == before).all():
            break
    attachment = told_apart(
        body, shape.betas, shape.attachment, placement, clouds, label, best.frames, state
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
    settings: MoshSettings,
) -> Labels:
    """Seeds on the person's own body, all frames fitted to what they say, and each tracklet called
    by what is near.
    """
    rig = marked_body(body, known.betas, known.attachment)
    count = len(placement.vertices)
    bank = np.concatenate([plain_poses(body.joint_names), known.poses])
    seeds = register(rig, prior, clouds, frames, bank)
    label, _ = seed_votes(clouds, seeds, pieces, count)
    result = None
    looked = telling_frames(clouds, LOOKED_AT)
    for gate in GATES:
        result = _fitted(rig, prior, clouds.labelled(label, count), known, result, settings)
        squared = distances(clouds, predict(rig, result.pose, result.trans))
        label = assign(averaged(squared, pieces), clouds, np.full(len(pieces), gate**2))
        state = result.pose[looked], result.trans[looked]
        label, sure = untangle(
            rig, prior, clouds, pieces, label, looked, state, np.full(count, OWN_WEIGHT)
        )
        label = once(label, -np.min(squared, axis=1), clouds)
    result = _fitted(rig, prior, clouds.labelled(label, count), known, result, settings)
    squared = distances(clouds, predict(rig, result.pose, result.trans))
    sure = sure if known.sure is None else np.minimum(sure, known.sure)
    label, confidence = judged(squared, label, pieces, clouds, sure)
    return Labels(label, confidence, pieces, sure, known, result)


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
    lam = sequence_settings(settings, warm=before is not None)
    scale = np.full(rig.num_markers, settings.robust_scale[1])
    return fit_long(rig, observed, None, scale, prior, *start, lam, longest=settings.longest)


def _default(body: BodyModel, placement: Placement, betas: np.ndarray) -> MarkedBody:
    """A body with its markers where the layout has them."""
    latent = default_markers(body, betas, placement.vertices, placement.distance)
    return marked_body(body, betas, attach(latent, body.rest_vertices(betas), body.faces))


def _place_weights(placement: Placement) -> Float[np.ndarray, " M"]:
    return PLACE_WEIGHT * (0.02 / np.maximum(placement.place_spread, 0.015)) ** 2
