"""Where on the body do labels sit that no layout knows? Found by fitting: body and places in turn.

1. A few frames; bodies in single ones, from plain poses, in all directions, of several sizes;
   labels softly assigned to
   places on the skin. 2. The cheapest that differ, and each of them turned about, in all frames
   together, where a label
   has one place. 3. The cheapest, and the cheapest other reading of the capture if it costs little
   more, go through
   the shape stage and finer places in turn. 4. Places in words, with how sure they are; what is not
   decided is said.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.fit.discover.description import agreement, describe, named_sides
from habitus.fit.discover.places import Seated, off_body, seated
from habitus.fit.discover.result import Discovery
from habitus.fit.discover.settings import DISCOVER, DiscoverSettings
from habitus.fit.discover.skin import Skin, betas_of_height, known_places, popularity, spread_places
from habitus.fit.discover.starts import bodies_of_single_frames, in_all_frames, settled
from habitus.fit.markers.recordings import ever_seen, spread_frames
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.types import Progress


@dataclass(frozen=True)
class _Reading:
    """One candidate after step 2: its cost and shape, poses and places in all frames, mean places
    of labels (M, 3).
    """

    cost: float
    betas: np.ndarray
    pose: np.ndarray
    trans: np.ndarray
    places: Float[np.ndarray, "M 3"]


def discover(
    body: BodyModel,
    prior: PosePrior,
    labels: Sequence[str],
    markers: Float[np.ndarray, "T M 3"],
    known: Mapping[str, Marker] | None = None,
    usual: Sequence[MarkerLayout] = (),
    progress: Progress = lambda stage, share: None,
    settings: DiscoverSettings = DISCOVER,
) -> Discovery:
    """The layout of labels (M,) with markers (T, M, 3), metres, NaN missing.

    known: what some labels usually mean. usual: layouts by which people place markers: where many
    of them have one, a label is likelier to sit, by as much as a few centimetres of misfit. The
    labels are only identities, but for those known and, where the capture does not decide it, pairs
    such as LX and RX. Places of a poor or undecided discovery come with ``doubts``. Raises
    HabitusError for fewer than ``min_labels`` labels that are ever seen.
    """
    prior = prior.for_joints(body.joint_names)
    coarse = spread_places(body, settings.coarse, settings.skin)
    fine = spread_places(body, settings.fine, settings.skin)
    popular = popularity(body, fine, usual, settings.skin)
    here = ever_seen(markers)
    if here.sum() < settings.min_labels:
        raise HabitusError(
            f"{int(here.sum())} labels are ever seen; discovering where they sit takes at least "
            f"{settings.min_labels}: "
            "write a layout with `habitus layout new`"
        )
    unseen = {label: "never seen" for label, seen in zip(labels, here, strict=True) if not seen}
    labels = [label for label, seen in zip(labels, here, strict=True) if seen]
    frames = markers[:, here][spread_frames(markers[:, here], settings.frames, 0)]
    usually = known_places(body, coarse, labels, known, settings.skin)
    readings = _readings(body, prior, coarse, frames, usually, progress, settings)
    before = popular + known_places(body, fine, labels, known, settings.skin)
    best, margin = _decided(body, prior, labels, fine, frames, readings, before, progress, settings)
    off = off_body(best, settings.off_body)
    if off.any() and (~off).sum() >= settings.min_labels:
        unseen |= {
            x: "lies off the body: no marker on the skin"
            for x, away in zip(labels, off, strict=True)
            if away
        }
        labels = [x for x, away in zip(labels, off, strict=True) if not away]
        frames = frames[:, ~off]
        shape = best.shape
        start = (
            shape.betas,
            shape.pose,
            shape.trans,
            popular + known_places(body, fine, labels, known, settings.skin),
        )
        best = seated(body, fine, frames, prior, *start, settings.place_spreads, settings)
    return describe(body, labels, frames, best, fine, margin, known or {}, unseen, settings)


def _readings(
    body: BodyModel,
    prior: PosePrior,
    skin: Skin,
    frames: np.ndarray,
    known: np.ndarray,
    progress: Progress,
    settings: DiscoverSettings,
) -> list[_Reading]:
    """Steps 1 and 2: candidates, the cheapest first."""
    stature = float(np.ptp(np.asarray(body.v_template)[:, 1]))
    readings = []
    for index, share in enumerate(settings.heights):
        progress("discover: bodies", 0.7 * index / len(settings.heights))
        betas = betas_of_height(body, share * stature)
        rig = skin.on(body, betas)
        single = bodies_of_single_frames(body, rig, skin, frames, prior, known, settings)
        every = in_all_frames(body, rig, frames, single, prior, settings)
        start = (every.pose, every.trans)
        joint = settled(rig, frames, prior, *start, settings.together, known, settings)
        places = (
            joint.posterior
            @ skin.points
            / np.maximum(joint.posterior.sum(axis=2, keepdims=True), 1e-6)
        )
        each = zip(joint.cost, joint.pose, joint.trans, places, strict=True)
        readings += [_Reading(float(cost), betas, *rest) for cost, *rest in each]
    return sorted(readings, key=lambda one: one.cost)


def _decided(
    body: BodyModel,
    prior: PosePrior,
    labels: Sequence[str],
    fine: Skin,
    frames: np.ndarray,
    readings: Sequence[_Reading],
    what: np.ndarray,
    progress: Progress,
    settings: DiscoverSettings,
) -> tuple[Seated, float | None]:
    """Step 3: the best reading, and by what share of its cost the best other one costs more; None
    if it is far off.
    """
    best = readings[0]
    other = [
        bool(np.linalg.norm(reading.places - best.places, axis=1).mean() > settings.other_reading)
        for reading in readings
    ]
    alike = [reading for reading, differs in zip(readings, other, strict=True) if not differs][
        : settings.alike
    ]
    others = [
        reading
        for reading, differs in zip(readings, other, strict=True)
        if differs and reading.cost - best.cost < settings.close * len(labels)
    ][:1]
    results: list[list[Seated]] = [[], []]
    for index, reading in enumerate((*alike, *others)):
        progress("discover: places", 0.6 + 0.3 * index / (len(alike) + len(others)))
        start = (reading.betas, reading.pose, reading.trans, what)
        here = seated(body, fine, frames, prior, *start, settings.place_spreads[:1], settings)
        results[index >= len(alike)].append(here)
    cheapest, rival = (
        min(some, key=lambda reading: reading.cost, default=None) for some in results
    )
    first, margin = _cheaper(body, labels, cheapest, rival, settings)
    progress("discover: places", 0.9)
    shape = first.shape
    start = (shape.betas, shape.pose, shape.trans, what)
    rounds = settings.place_spreads[1:]
    return seated(body, fine, frames, prior, *start, rounds, settings), margin


def _cheaper(
    body: BodyModel,
    labels: Sequence[str],
    best: Seated | None,
    other: Seated | None,
    settings: DiscoverSettings = DISCOVER,
) -> tuple[Seated, float | None]:
    """The cheaper of two readings, or the one that agrees with the labels' names where they cost
    alike; and by what share of its cost the other costs more.
    """
    assert best is not None
    if other is None:
        return best, None
    best, other = sorted((best, other), key=lambda seated: seated.cost)
    margin = other.cost / best.cost - 1.0
    words = settings.description
    sides = named_sides(labels, words)
    across = np.asarray(body.v_template)[:, 0]
    agreements = [agreement(sides, across[seated.vertices], words) for seated in (best, other)]
    if (
        margin < settings.decided
        and agreements[0] is not None
        and agreements[1] is not None
        and agreements[1] > agreements[0]
    ):
        return other, margin
    return best, margin
