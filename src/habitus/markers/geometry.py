"""What marker positions alone say of a body: directions of trunk and limbs, and which marker of a
pair is which.

Roles are landmark names, so nothing here knows a marker set. Directions are unit vectors (T, 3) in
the capture's world, NaN where a marker is missing or the pose says nothing (a straight elbow has no
flexion axis), None where markers lack.

Laboratories exchange the labels of a pair, throughout a capture or for a while. Anatomy says which
is which: elbows and knees bend one way only, the thumb stays on its side of the forearm, and front
and back follow from left and up. So does time: a pair that reverses from one frame to the next has
changed labels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.markers.layouts import Marker, MarkerLayout

SIDES = ("left", "right")
FREE = 0.05  # a place this unsure (metres) is one that technicians choose freely
_BENT = np.sin(np.radians(25.0))  # a joint bent less says nothing sure of its axis
_UPPER = (
    0.65,
    2.2,
)  # an upper arm or thigh against the rest of its limb; else a marker of it is somewhere else
_STRETCH = 0.25  # parts of limbs keep their lengths to that: else a marker is on its way
_HANGING = np.cos(np.radians(35.0))  # an arm this near to the trunk's direction hangs

Points = Float[np.ndarray, "T 3"]
Cosines = Float[np.ndarray, " T"]


@dataclass(frozen=True)
class Scene:
    """Markers (T, M, 3), metres, NaN missing, and which column is at which landmark."""

    markers: Float[np.ndarray, "T M 3"]
    columns: Mapping[str, int]

    @classmethod
    def of(cls, layout: MarkerLayout, markers: Float[np.ndarray, "T M 3"]) -> Scene:
        """The first marker of the layout at or near each landmark, the surer ones first."""
        columns: dict[str, int] = {}
        for column in sorted(range(len(layout)), key=lambda k: layout.markers[k].place_spread):
            role = _role(layout.markers[column])
            if role is not None and np.isfinite(markers[:, column, 0]).any():
                columns.setdefault(role, column)
        return cls(markers, columns)

    def at(self, name: str) -> Points | None:
        """(T, 3) the marker at a landmark, or None."""
        return self.markers[:, self.columns[name]] if name in self.columns else None

    def middle(self, *names: str) -> Points | None:
        """(T, 3) middle of the markers that there are at these landmarks, or None if there are
        none.
        """
        points = [self.markers[:, self.columns[name]] for name in names if name in self.columns]
        return np.mean(points, axis=0) if points else None


def _role(marker: Marker) -> str | None:
    """The landmark that a marker stands for: its own, or the nearer one of two, unless it is placed
    freely.
    """
    if marker.between is None:
        return marker.landmark
    first, second, share = marker.between
    return None if marker.place_spread >= FREE else first if share < 0.5 else second


def unit(vector: Points) -> Points:
    """(T, 3) the same directions at length 1, NaN for length 0."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.where(length > 1e-9, length, np.nan)


def toward(start: Points | None, end: Points | None) -> Points | None:
    """(T, 3) unit direction from one marker to another, or None if one lacks."""
    return None if start is None or end is None else unit(end - start)


def along(first: Points | None, second: Points | None) -> Float[np.ndarray, " _"]:
    """(T,) cosine between directions; an empty array where one lacks."""
    return np.empty(0) if first is None or second is None else np.sum(first * second, axis=-1)


def trunk_left(scene: Scene) -> Points | None:
    """The body's left: mean of the right-to-left directions of pelvis and shoulders."""
    pairs = [
        (scene.at(f"right_{name}"), scene.at(f"left_{name}"))
        for name in ("asis", "psis", "acromion", "shoulder_back")
    ]
    directions = [direction for pair in pairs if (direction := toward(*pair)) is not None]
    return unit(np.mean(directions, axis=0)) if directions else None


def trunk_up(scene: Scene) -> Points | None:
    """Up along the trunk: from the pelvis to the base of the neck."""
    front = scene.middle("left_asis", "right_asis")
    back = scene.middle("left_psis", "right_psis", "sacrum", "waist_back")
    pelvis = back if front is None else front if back is None else (front + back) / 2
    return toward(
        pelvis, scene.middle("c7", "t2", "jugular_notch", "left_acromion", "right_acromion")
    )


def trunk_front(scene: Scene) -> Points | None:
    """The body's front, as left and up say it (not as front and back markers do)."""
    left = trunk_left(scene)
    up = trunk_up(scene)
    return None if left is None or up is None else unit(np.cross(left, up))


def _limb(scene: Scene, side: str, joint: str) -> tuple[Points, Points] | None:
    """Directions of the upper and the lower part of a limb, towards its end, NaN where lengths are
    no limb's.
    """
    names = {
        "elbow": (
            ("acromion", "shoulder_front", "shoulder_back"),
            ("elbow_lateral", "elbow_medial"),
            ("wrist_radial", "wrist_ulnar", "wrist_dorsal"),
        ),
        "knee": (
            ("trochanter",) if f"{side}_trochanter" in scene.columns else ("asis",),
            ("knee_lateral", "knee_medial"),
            ("ankle_lateral", "ankle_medial"),
        ),
    }[joint]
    root, middle, end = (scene.middle(*(f"{side}_{name}" for name in part)) for part in names)
    if root is None or middle is None or end is None:
        return None
    upper, lower = (
        np.linalg.norm(part, axis=-1, keepdims=True) for part in (middle - root, end - middle)
    )
    limb = (upper > _UPPER[0] * lower) & (upper < _UPPER[1] * lower) & _usual(upper) & _usual(lower)
    return unit(np.where(limb, middle - root, np.nan)), unit(np.where(limb, end - middle, np.nan))


def _usual(length: Float[np.ndarray, "T 1"]) -> Bool[np.ndarray, "T 1"]:
    """Where a part of a limb is about as long as it usually is in a capture."""
    usual = np.nanmedian(length) if np.isfinite(length).any() else np.nan
    return np.abs(length - usual) < _STRETCH * usual


def flexion_axis(scene: Scene, side: str, joint: str) -> Points | None:
    """The outward (lateral) end of the hinge axis of elbow or knee, NaN while the joint is nearly
    straight.

    A hinge bends one way only: forearm x upper arm points inwards, shank x thigh outwards, whatever
    the shoulder does.
    """
    limb = _limb(scene, side, joint)
    if limb is None:
        return None
    axis = np.cross(*limb)
    outward = (1.0 if joint == "knee" else -1.0) * (1.0 if side == "left" else -1.0)
    return outward * unit(
        np.where(np.linalg.norm(axis, axis=-1, keepdims=True) > _BENT, axis, np.nan)
    )


def thumb_direction(scene: Scene, side: str) -> Points | None:
    """Where the thumb side of the wrist points while forearm rotation is neutral: away from the
    upper arm's end.

    Forearm rotation turns it by at most about 90 degrees to either side, so its cosine stays above
    zero.
    """
    limb = _limb(scene, side, "elbow")
    if limb is None:
        return None
    upper, lower = limb
    across = -upper + lower * np.sum(upper * lower, axis=-1, keepdims=True)
    return unit(np.where(np.linalg.norm(across, axis=-1, keepdims=True) > _BENT, across, np.nan))


def hanging_elbow_outward(scene: Scene, side: str) -> Points | None:
    """The outer side of the elbow while the arm hangs beside the trunk, NaN while it does not.

    Turning the upper arm in or out moves the lateral epicondyle to the front or the back, never to
    the trunk's side.
    """
    limb = _limb(scene, side, "elbow")
    left = trunk_left(scene)
    up = trunk_up(scene)
    if limb is None or left is None or up is None:
        return None
    upper = limb[0]
    hangs = np.sum(upper * up, axis=-1, keepdims=True) < -_HANGING
    outward = left if side == "left" else -left
    across = outward - upper * np.sum(upper * outward, axis=-1, keepdims=True)
    return unit(np.where(hangs, across, np.nan))


def foot_outward(scene: Scene, side: str) -> Points | None:
    """The outer (little-toe) side of a foot, from shank and foot directions."""
    part = lambda *names: scene.middle(*(f"{side}_{name}" for name in names))  # noqa: E731
    shank = toward(part("ankle_lateral", "ankle_medial"), part("knee_lateral", "knee_medial"))
    fore = part("mt1_head", "mt5_head")
    if f"{side}_mt1_head" not in scene.columns or f"{side}_mt5_head" not in scene.columns:
        fore = next(
            (
                points
                for points in map(part, ("mt2_head", "toe_tip", "big_toe"))
                if points is not None
            ),
            None,
        )
    foot = toward(part("heel"), fore)
    if shank is None or foot is None:
        return None
    return (1.0 if side == "left" else -1.0) * unit(np.cross(shank, foot))


def leg_outward(scene: Scene, side: str) -> Points | None:
    """The outer side of a leg as the pelvis says it (hip rotation turns it by less than 90
    degrees).
    """
    left = toward(scene.at("right_asis"), scene.at("left_asis"))
    return None if left is None else left if side == "left" else -left


@dataclass(frozen=True)
class Exchange:
    """Two markers whose labels change places for a while: their columns and the frames (T,) in
    which they do.
    """

    first: int
    second: int
    frames: np.ndarray


@dataclass(frozen=True)
class Correction:
    """What one check found: its name, what to tell a person, the markers it changes, frames whose
    labels are exchanged.

    ``quiet`` marks a refinement (a distance or a place measured) that needs no warning.
    """

    check: str
    text: str
    markers: tuple[Marker, ...] = ()
    exchange: Exchange | None = None
    quiet: bool = False


Check = Callable[[Scene, MarkerLayout], Iterator[Correction]]


def exchange_columns(markers: Float[np.ndarray, "T M 3"], exchange: Exchange) -> None:
    """Put two markers back in their own columns, in place, in the frames in which they are
    exchanged.
    """
    frames = exchange.frames
    first = exchange.first
    second = exchange.second
    held = markers[frames, first]
    markers[frames, first] = markers[frames, second]
    markers[frames, second] = held


def exchange_text(first: str, second: str, frames: np.ndarray) -> str:
    """What to tell a person of two labels that change places in some frames (T,)."""
    count = int(frames.sum())
    start = int(np.argmax(frames)) + 1
    which = (
        "all frames"
        if count == len(frames)
        else f"{count} of {len(frames)} frames (from frame {start})"
    )
    return f"{first} and {second} change places in {which}: put back"


def _elbow(scene: Scene, side: str) -> list[Points | None]:
    return [flexion_axis(scene, side, "elbow"), hanging_elbow_outward(scene, side)]


def _knee(scene: Scene, side: str) -> list[Points | None]:
    ankle = toward(scene.at(f"{side}_ankle_medial"), scene.at(f"{side}_ankle_lateral"))
    return [flexion_axis(scene, side, "knee"), leg_outward(scene, side) if ankle is None else ankle]


# (first place, second place, directions in which the first lies from the second); ankles before the
# knees they judge
PAIRS: tuple[tuple[str, str, Callable[[Scene, str], list[Points | None]]], ...] = (
    ("ankle_lateral", "ankle_medial", lambda scene, side: [foot_outward(scene, side)]),
    ("mt5_head", "mt1_head", lambda scene, side: [foot_outward(scene, side)]),
    ("little_toe", "big_toe", lambda scene, side: [foot_outward(scene, side)]),
    ("knee_lateral", "knee_medial", _knee),
    ("elbow_lateral", "elbow_medial", _elbow),
    ("wrist_radial", "wrist_ulnar", lambda scene, side: [thumb_direction(scene, side)]),
    ("hand_radial", "hand_ulnar", lambda scene, side: [thumb_direction(scene, side)]),
    ("shoulder_front", "shoulder_back", lambda scene, side: [trunk_front(scene)]),
    ("temple", "back_head", lambda scene, side: [trunk_front(scene)]),
)


def _exchanged(
    scene: Scene,
    layout: MarkerLayout,
    first: str,
    second: str,
    expect: Callable[[Scene, str], list[Points | None]],
) -> Iterator[Correction]:
    for side in SIDES:
        a = scene.columns.get(f"{side}_{first}")
        b = scene.columns.get(f"{side}_{second}")
        if a is None or b is None:
            continue
        expected = [direction for direction in expect(scene, side) if direction is not None]
        order = pair_order(scene.markers[:, a], scene.markers[:, b], expected)
        marker = layout.markers[a]
        two = layout.markers[b]
        if order.swapped:
            text = (
                f"{marker.label} and {two.label} are exchanged ({marker.label} is at {two.place}): "
                "so are their places"
            )
            yield Correction("exchanged pair", text, (marker.moved_to(two), two.moved_to(marker)))
        if order.odd_frames.any():
            text = exchange_text(marker.label, two.label, order.odd_frames)
            yield Correction("pair changes places", text, exchange=Exchange(a, b, order.odd_frames))


PAIR_CHECKS = tuple(
    partial(_exchanged, first=first, second=second, expect=expect)
    for first, second, expect in PAIRS
)


@dataclass(frozen=True)
class PairOrder:
    """Whether a pair is ``swapped`` in all frames that tell, and the frames (T,) that are against
    the rest.
    """

    swapped: bool
    odd_frames: np.ndarray


def pair_order(
    first: Points, second: Points, expected: list[Points], *, fewest: int = 10, surely: float = 0.6
) -> PairOrder:
    """Whether two markers are exchanged, throughout or for a while.

    ``expected``: directions that point from the second to the first marker where the labels are
    right. Between neighbouring frames the pair can only turn a little: a sudden reversal is a
    change of labels, and what gaps leave connected is judged as one run. A run is judged wrong only
    where its evidence is strong, plentiful and agrees.
    """
    order = unit(first - second)
    seen = np.nonzero(np.isfinite(order[:, 0]))[0]
    odd = np.zeros(len(order), dtype=bool)
    if len(seen) < 2:
        return PairOrder(False, odd)
    run, parity = _runs(first[seen], second[seen], order[seen], np.diff(seen))
    evidence = _agreement(order, expected)[seen] * parity
    state = np.zeros(len(seen))
    for index in np.unique(run):
        inside = run == index
        sure = _verdict(evidence[inside], fewest, surely)
        state[inside] = sure * parity[inside]
    swapped = bool((state < 0).any() and not (state > 0).any())
    for index in np.unique(run[state == 0]):
        inside = run == index
        usual = 1.0 if parity[inside].sum() >= 0 else -1.0
        state[inside] = (-usual if swapped else usual) * parity[inside]
    odd[seen] = state > 0 if swapped else state < 0
    return PairOrder(swapped, odd)


def _agreement(order: Points, expected: list[Points]) -> Cosines:
    cosines = np.array([np.sum(order * direction, axis=-1) for direction in expected])
    counts = np.isfinite(cosines).sum(axis=0) if len(cosines) else np.zeros(len(order))
    sums = np.nansum(cosines, axis=0) if len(cosines) else np.zeros(len(order))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _verdict(evidence: Cosines, fewest: int, surely: float) -> float:
    """+1 right, -1 exchanged, 0 not sure."""
    known = evidence[np.isfinite(evidence)]
    if len(known) < fewest:
        return 0.0
    middle = float(np.median(known))
    agreeing = float(np.mean(np.sign(known) == np.sign(middle)))
    if middle > 0:
        return 1.0 if middle > 0.2 and agreeing > 0.7 else 0.0
    return -1.0 if middle < -surely and agreeing > 0.9 else 0.0


def _runs(
    first: Points, second: Points, order: Points, gaps: Int[np.ndarray, " T-1"]
) -> tuple[Int[np.ndarray, " T"], Cosines]:
    """Run number of each seen frame, and +1 or -1: how its order relates to the start of its
    run.
    """
    turn = np.sum(order[1:] * order[:-1], axis=-1)
    stay = np.linalg.norm(first[1:] - first[:-1], axis=-1) + np.linalg.norm(
        second[1:] - second[:-1], axis=-1
    )
    cross = np.linalg.norm(first[1:] - second[:-1], axis=-1) + np.linalg.norm(
        second[1:] - first[:-1], axis=-1
    )
    flips = (turn < -0.7) & (cross < 0.5 * stay) & (gaps <= 5)
    broken = ~flips & (((gaps > 1) & (turn < 0.5)) | (gaps > 25) | (turn < -0.7))
    run = np.concatenate([[0], np.cumsum(broken)])
    return run, np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])
