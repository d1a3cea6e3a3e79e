"""What marker positions alone say of a body: directions of trunk and limbs, and which marker of a
pair is which.

Roles are landmark names, so nothing here knows a marker set. Directions are unit vectors (T, 3) in
the capture's world, NaN where a marker is missing or the pose says nothing (a straight elbow has no
flexion axis), None where markers lack.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

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
        found = [self.markers[:, self.columns[name]] for name in names if name in self.columns]
        return np.mean(found, axis=0) if found else None


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
    found = [direction for pair in pairs if (direction := toward(*pair)) is not None]
    return unit(np.mean(found, axis=0)) if found else None


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
