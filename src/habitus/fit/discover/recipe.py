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
from habitus.fit.discover.description import DECIDED, agreement, describe, named_sides
from habitus.fit.discover.places import ROUNDS, Seated, off_body, seated
from habitus.fit.discover.result import Discovery
from habitus.fit.discover.skin import Skin, betas_of_height, known_places, popularity, spread_places
from habitus.fit.discover.starts import Schedule, bodies_of_single_frames, in_all_frames, settled
from habitus.fit.markers.recordings import ever_seen, spread_frames
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.types import Progress

FEWEST = 12
"""Labels; fewer do not tell a body from another that is turned."""
TOGETHER: Schedule = tuple(
    (sigma, firmness)
    for sigma, firmnesses in (
        (0.12, (20, 10)),
        (0.10, (6, 6)),
        (0.08, (4, 4)),
        (0.06, (3, 3)),
        (0.05, (2, 2)),
        (0.04, (2, 2)),
    )
    for firmness in firmnesses
)
HEIGHTS = (0.91, 1.04)
"""Sizes that are tried, as shares of the mean person's height."""
COARSE = 150
FINE = 1200
FRAMES = 12
# metres: places that differ by more than this on average are another reading of the capture
_OTHER = 0.15
_ALIKE = 3  # readings that are nearly the same and go through a first round of step 3
# of the cost in step 2, a label: another reading that costs less more than this is gone after
_CLOSE = 0.6
_OFF = 0.08  # metres: a label further than this from the body is no marker on its skin


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
) -> Discovery:
    """The layout of labels (M,) with markers (T, M, 3), metres, NaN missing.

    known: what some labels usually mean. usual: layouts by which people place markers: where many
    of them have one, a label is likelier to sit, by as much as a few centimetres of misfit. The
    labels are only identities, but for those known and, where the capture does not decide it, pairs
    such as LX and RX. Places of a poor or undecided discovery come with ``doubts``. Raises
    HabitusError for fewer than `FEWEST` labels that are ever seen.
    """
    prior = prior.for_joints(body.joint_names)
    coarse = spread_places(body, COARSE)
    fine = spread_places(body, FINE)
    popular = popularity(body, fine, usual)
    here = ever_seen(markers)
    if here.sum() < FEWEST:
        raise HabitusError(
            f"{int(here.sum())} labels are ever seen; discovering where they sit takes at least "
            f"{FEWEST}: "
            "write a layout with `habitus layout new`"
        )
    unseen = {label: "never seen" for label, seen in zip(labels, here, strict=True) if not seen}
    labels = [label for label, seen in zip(labels, here, strict=True) if seen]
    frames = markers[:, here][spread_frames(markers[:, here], FRAMES, 0)]
    readings = _readings(
        body, prior, coarse, frames, known_places(body, coarse, labels, known), progress
    )
    before = popular + known_places(body, fine, labels, known)
    found, margin = _decided(body, prior, labels, fine, frames, readings, before, progress)
    off = off_body(found, _OFF)
    if off.any() and (~off).sum() >= FEWEST:
        unseen |= {
            x: "lies off the body: no marker on the skin"
            for x, away in zip(labels, off, strict=True)
            if away
        }
        labels = [x for x, away in zip(labels, off, strict=True) if not away]
        frames = frames[:, ~off]
        shape = found.shape
        start = (
            shape.betas,
            shape.pose,
            shape.trans,
            popular + known_places(body, fine, labels, known),
        )
        found = seated(body, fine, frames, prior, *start)
    return describe(body, labels, frames, found, fine, margin, known or {}, unseen)


def _readings(
    body: BodyModel,
    prior: PosePrior,
    skin: Skin,
    frames: np.ndarray,
    known: np.ndarray,
    progress: Progress,
) -> list[_Reading]:
    """Steps 1 and 2: candidates, the cheapest first."""
    stature = float(np.ptp(np.asarray(body.v_template)[:, 1]))
    found = []
    for index, share in enumerate(HEIGHTS):
        progress("discover: bodies", 0.7 * index / len(HEIGHTS))
        betas = betas_of_height(body, share * stature)
        rig = skin.on(body, betas)
        single = bodies_of_single_frames(body, rig, skin, frames, prior, known)
        every = in_all_frames(body, rig, frames, single, prior)
        joint = settled(rig, frames, prior, every.pose, every.trans, TOGETHER, known)
        places = (
            joint.posterior
            @ skin.points
            / np.maximum(joint.posterior.sum(axis=2, keepdims=True), 1e-6)
        )
        each = zip(joint.cost, joint.pose, joint.trans, places, strict=True)
        found += [_Reading(float(cost), betas, *rest) for cost, *rest in each]
    return sorted(found, key=lambda one: one.cost)


def _decided(
    body: BodyModel,
    prior: PosePrior,
    labels: Sequence[str],
    fine: Skin,
    frames: np.ndarray,
    readings: Sequence[_Reading],
    what: np.ndarray,
    progress: Progress,
) -> tuple[Seated, float | None]:
    """Step 3: the best reading, and by what share of its cost the best other one costs more; None
    if it is far off.
    """
    best = readings[0]
    other = [
        bool(np.linalg.norm(one.places - best.places, axis=1).mean() > _OTHER) for one in readings
    ]
    alike = [one for one, differs in zip(readings, other, strict=True) if not differs][:_ALIKE]
    others = [
        one
        for one, differs in zip(readings, other, strict=True)
        if differs and _near(one, best, labels)
    ][:1]
    results: list[list[Seated]] = [[], []]
    for index, one in enumerate((*alike, *others)):
        progress("discover: places", 0.6 + 0.3 * index / (len(alike) + len(others)))
        here = seated(body, fine, frames, prior, one.betas, one.pose, one.trans, what, ROUNDS[:1])
        results[index >= len(alike)].append(here)
    first, margin = _cheaper(
        body, labels, *(min(some, key=lambda one: one.cost, default=None) for some in results)
    )
    progress("discover: places", 0.9)
    shape = first.shape
    return seated(
        body, fine, frames, prior, shape.betas, shape.pose, shape.trans, what, ROUNDS[1:]
    ), margin


def _near(one: _Reading, best: _Reading, labels: Sequence[str]) -> bool:
    return one.cost - best.cost < _CLOSE * len(labels)


def _cheaper(
    body: BodyModel, labels: Sequence[str], best: Seated | None, other: Seated | None
) -> tuple[Seated, float | None]:
    """The cheaper of two readings, or the one that agrees with the labels' names where they cost
    alike; and by what share of its cost the other costs more.
    """
    assert best is not None
    if other is None:
        return best, None
    best, other = sorted((best, other), key=lambda one: one.cost)
    margin = other.cost / best.cost - 1.0
    said = [
        agreement(named_sides(labels), np.asarray(body.v_template)[one.vertices, 0])
        for one in (best, other)
    ]
    if margin < DECIDED and said[0] is not None and said[1] is not None and said[1] > said[0]:
        return other, margin
    return best, margin
