"""Pairs of markers whose labels laboratories exchange, throughout a capture or for a while.

Anatomy tells which is which: elbows and knees bend one way only, the thumb stays on its side of the
forearm, and front and back follow from left and up. Time tells when: a pair that reverses from one
frame to the next has changed labels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from habitus.markers.geometry import (
    SIDES,
    Cosines,
    Points,
    Scene,
    flexion_axis,
    foot_outward,
    hanging_elbow_outward,
    leg_outward,
    thumb_direction,
    toward,
    trunk_front,
    unit,
)
from habitus.markers.layouts import Marker, MarkerLayout


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
        one = layout.markers[a]
        two = layout.markers[b]
        if order.swapped:
            text = (
                f"{one.label} and {two.label} are exchanged ({one.label} is at {two.place}): "
                "so are their places"
            )
            yield Correction("exchanged pair", text, (one.moved_to(two), two.moved_to(one)))
        if order.odd_frames.any():
            text = exchange_text(one.label, two.label, order.odd_frames)
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
