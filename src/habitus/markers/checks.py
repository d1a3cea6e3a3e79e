"""Small checks of a layout against the geometry of a capture; each says what it found and what it
changes.

A wrong correction is worse than none: a check changes a layout only where the evidence is strong
and plentiful, and every change is reported. The numbers were measured on real captures of many
laboratories.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.markers.geometry import (
    FREE,
    PAIR_CHECKS,
    SIDES,
    Correction,
    Points,
    Scene,
    along,
    exchange_columns,
    toward,
    trunk_front,
    trunk_left,
)
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.parallel.blocks import drop_pages, mapped

_WAND = 0.043  # a shank marker farther than this from the line knee to ankle stands on a wand
_KNUCKLE = 0.085  # from the middle of the wrist to the knuckles
_FINGER = 0.112  # a hand marker farther than this from the wrist is on a finger


def checked(
    layout: MarkerLayout, markers: Float[np.ndarray, "T M 3"]
) -> tuple[MarkerLayout, tuple[Correction, ...]]:
    """The layout corrected by all checks in turn, and what they found. ``markers``: metres, NaN
    missing, its order.
    """
    corrections: list[Correction] = []
    markers = mapped(lambda part: np.array(part, dtype=float), markers)
    for check in CHECKS:
        for correction in check(Scene.of(layout, markers), layout):
            corrections.append(correction)
            changed = {marker.label: marker for marker in correction.markers}
            layout = replace(
                layout,
                markers=tuple(changed.get(marker.label, marker) for marker in layout.markers),
            )
            if correction.exchange is not None:
                exchange_columns(markers, correction.exchange)
        drop_pages(markers)
    return layout, tuple(corrections)


# -- left and right --------------------------------------------------------------------------------


MIRRORED = "mirrored capture"
"""Name of the check that exchanges left and right throughout."""


def mirrored_capture(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """Left and right labels are exchanged throughout, or the capture is mirrored: front contradicts
    left and up.
    """
    front = trunk_front(scene)
    pairs = [
        (
            scene.middle("left_psis", "right_psis", "sacrum", "waist_back"),
            scene.middle("left_asis", "right_asis"),
        ),
        (scene.at("c7"), scene.at("jugular_notch")),
        (scene.at("t10"), scene.at("xiphoid")),
        (
            scene.middle("left_back_head", "right_back_head"),
            scene.middle("left_temple", "right_temple"),
        ),
        *(
            (
                scene.at(f"{s}_heel"),
                scene.middle(f"{s}_mt2_head", f"{s}_toe_tip", f"{s}_mt5_head", f"{s}_little_toe"),
            )
            for s in SIDES
        ),
    ]
    cosines = [
        values for pair in pairs if np.isfinite(values := along(toward(*pair), front)).sum() >= 5
    ]
    if len(cosines) < 3 or any(np.nanmedian(values) > -0.3 for values in cosines):
        return
    yield Correction(
        MIRRORED,
        "left and right labels are exchanged throughout (or the capture is mirrored): all places "
        "changed sides",
        tuple(other_side(marker) for marker in layout.markers),
    )


def other_side(marker: Marker) -> Marker:
    """The same marker at the mirrored place."""

    def flip(name: str) -> str:
        for side, other in (SIDES, SIDES[::-1]):
            if name.startswith(f"{side}_"):
                return other + name[len(side) :]
        return name

    landmark = None if marker.landmark is None else flip(marker.landmark)
    between = (
        None
        if marker.between is None
        else (flip(marker.between[0]), flip(marker.between[1]), marker.between[2])
    )
    direction = None if marker.direction is None else (-marker.direction[0], *marker.direction[1:])
    shift = None if marker.shift is None else (-marker.shift[0], *marker.shift[1:])
    return replace(marker, landmark=landmark, between=between, shift=shift, direction=direction)


def single_marker_side(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """The lone shoulder-blade or head-side marker sits on the other side than its name says."""
    left = trunk_left(scene)
    for name, middle in (("scapula_mid", ("c7", "t10")), ("head_side", ("head_top", "forehead"))):
        here = [side for side in SIDES if f"{side}_{name}" in scene.columns]
        origin = scene.middle(*middle)
        if len(here) != 1 or left is None or origin is None:
            continue
        side = here[0]
        other = SIDES[1 - SIDES.index(here[0])]
        offset = np.sum(
            (scene.markers[:, scene.columns[f"{side}_{name}"]] - origin) * left, axis=-1
        )
        offset = offset[np.isfinite(offset)] * (1.0 if side == "left" else -1.0)
        if len(offset) >= 10 and np.median(offset) < -0.03 and np.mean(offset < 0) > 0.9:
            marker = layout.markers[scene.columns[f"{side}_{name}"]]
            text = (
                f"{marker.label} sits {-np.median(offset) * 1e3:.0f} mm on the {other} side: "
                "placed there"
            )
            yield Correction("side of a single marker", text, (other_side(marker),))


# -- distances from the skin -----------------------------------------------------------------------


def wands(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """Shank (and with it thigh) markers of unsure distance: on the skin or on wands, by the shank
    marker's distance.
    """
    for side in SIDES:
        knee = scene.at(f"{side}_knee_lateral")
        shank = _unsure(
            scene, layout, f"{side}_shank_lateral", knee, scene.at(f"{side}_ankle_lateral")
        )
        thigh = _unsure(scene, layout, f"{side}_thigh_lateral", scene.at(f"{side}_asis"), knee)
        if shank is None:
            continue
        on_wand = shank[1] > _WAND
        for bone, skin in ((shank, 0.014), (thigh, 0.026)):
            if bone is None:
                continue
            marker, offset = bone
            distance, spread = (
                (max(0.02, offset - skin), 0.015) if on_wand else (Marker.distance, 0.003)
            )
            kind = f"stands on a wand, {distance * 1e3:.0f} mm off" if on_wand else "is on the skin"
            change = replace(marker, distance=round(distance, 4), distance_spread=spread)
            yield Correction("wand or skin", f"{marker.label} {kind}", (change,), quiet=True)


def _unsure(
    scene: Scene, layout: MarkerLayout, name: str, top: Points | None, bottom: Points | None
) -> tuple[Marker, float] | None:
    """The marker at a landmark and its distance from a line, where the layout is unsure of its
    distance from skin.
    """
    column = scene.columns.get(name)
    if column is None or layout.markers[column].distance_spread < 0.02:
        return None
    measured = _beside(scene.markers[:, column], top, bottom)
    return None if measured is None else (layout.markers[column], measured[1])


def wrist_width(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """Wrist markers on the skin, on a band or on a bar: by the distance between them."""
    for side in SIDES:
        columns = [scene.columns.get(f"{side}_wrist_{name}") for name in ("radial", "ulnar")]
        if columns[0] is None or columns[1] is None:
            continue
        gap = np.linalg.norm(scene.markers[:, columns[0]] - scene.markers[:, columns[1]], axis=-1)
        if np.isfinite(gap).sum() < 5 or not 0.02 < (width := float(np.nanmedian(gap))) < 0.3:
            continue
        if width > 0.085:
            kind = "on a bar"
            distance = (width - 0.060) / 2
            spread = 0.012
            place = 0.03
        elif width > 0.062:
            kind = "on a band"
            distance = 0.012
            spread = 0.005
            place = 0.02
        else:
            kind = "on the skin"
            distance = Marker.distance
            spread = 0.003
            place = 0.02
        pair = [layout.markers[column] for column in columns if column is not None]
        if all(abs(m.distance - distance) < 0.004 and m.distance_spread <= spread for m in pair):
            continue
        text = f"{pair[0].label} and {pair[1].label} are {kind} ({width * 1e3:.0f} mm apart)"
        changed = (
            replace(m, distance=round(distance, 4), distance_spread=spread, place_spread=place)
            for m in pair
        )
        yield Correction("wrist width", text, tuple(changed), quiet=True)


# -- places ----------------------------------------------------------------------------------------


def waist_middle(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """A pair named left and right middle of the waist that is really its front and back middle."""
    starts = [marker.landmarks[:1] for marker in layout.markers]
    sides = [
        starts.index((name,))
        for name in ("left_iliac_crest", "right_iliac_crest")
        if (name,) in starts
    ]
    left = toward(scene.at("right_asis"), scene.at("left_asis"))
    front = trunk_front(scene)
    if len(sides) < 2 or left is None or front is None:
        return
    across = scene.markers[:, sides[0]] - scene.markers[:, sides[1]]
    if not np.isfinite(across).any():
        return
    distance = np.nanmedian(np.abs(along(across, left)))
    ahead = np.nanmedian(along(across, front))
    if not (distance < 0.06 and abs(ahead) > 0.12):
        return
    names = ("waist_front", "waist_back") if ahead > 0 else ("waist_back", "waist_front")
    markers = [layout.markers[column] for column in sides]
    text = (
        f"{markers[0].label} and {markers[1].label} are the {names[0][6:]} and {names[1][6:]} "
        "middle of the waist"
    )
    changed = (
        marker.measured_at(landmark=name, between=None)
        for marker, name in zip(markers, names, strict=True)
    )
    yield Correction("middle of the waist", text, tuple(changed))


def finger_not_knuckle(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """A hand marker too far from the wrist for a knuckle sits on the middle finger."""
    for side in SIDES:
        column = scene.columns.get(f"{side}_hand_back")
        wrist = scene.middle(f"{side}_wrist_radial", f"{side}_wrist_ulnar", f"{side}_wrist_dorsal")
        if column is None or wrist is None:
            continue
        away = np.linalg.norm(scene.markers[:, column] - wrist, axis=-1)
        if np.isfinite(away).sum() < 5 or not _FINGER < (far := float(np.nanmedian(away))) < 0.22:
            continue
        marker = layout.markers[column]
        share = round(min(1.0, (far - _KNUCKLE) / 0.095), 2)
        text = f"{marker.label} is {far * 1e3:.0f} mm from the wrist, on a finger: placed there"
        place = (f"{side}_hand_back", f"{side}_middle_tip", share)
        change = marker.measured_at(landmark=None, between=place, place_spread=0.03)
        yield Correction("finger, not knuckle", text, (change,))


def free_places(scene: Scene, layout: MarkerLayout) -> Iterator[Correction]:
    """Markers that are placed freely along a limb: how far along they are is measured, and so is
    their start place.

    Left and right differ by up to 0.4 of the segment in real laboratories, so the middle is a poor
    guess.
    """
    corrections = []
    for column, marker in enumerate(layout.markers):
        side, _, name = (marker.landmark or "").partition("_")
        if side in SIDES and name in _SEGMENTS and marker.place_spread >= FREE:
            ends, (first, second), skip = _SEGMENTS[name]
            ends = [_first_known(scene, side, groups) for groups in ends]
            measured = _beside(scene.markers[:, column], *ends)
            if measured is not None and 0.03 < (share := (measured[0] - skip) / (1 - skip)) < 0.97:
                place = (f"{side}_{first}", f"{side}_{second}", round(share, 2))
                corrections.append(
                    marker.measured_at(landmark=None, between=place, place_spread=FREE)
                )
    if corrections:
        text = ", ".join(
            f"{marker.label} {marker.between[2]:.0%}" for marker in corrections if marker.between
        )
        yield Correction(
            "places along limbs",
            f"measured along their limbs: {text}",
            tuple(corrections),
            quiet=True,
        )


def _first_known(scene: Scene, side: str, groups: tuple[tuple[str, ...], ...]) -> Points | None:
    """Middle of the first group of places of which there are markers."""
    middles = (scene.middle(*(f"{side}_{name}" for name in group)) for group in groups)
    return next((points for points in middles if points is not None), None)


_SHOULDER = (("acromion",), ("shoulder_front", "shoulder_back"))
_WRIST = (("wrist_radial", "wrist_ulnar"), ("wrist_dorsal",))
_ELBOW = (("elbow_lateral",),)
_ASIS = (("asis",),)
_KNEE = (("knee_lateral",),)
_ANKLE = (("ankle_lateral",),)

# limb: its measured ends, the landmarks that the place lies between, and how far down the first of
# these lies
_ARM = ((_SHOULDER, _ELBOW), ("acromion", "elbow_lateral"), 0.0)
_FOREARM = ((_ELBOW, _WRIST), ("elbow_lateral", "wrist_dorsal"), 0.0)
_THIGH = (
    (_ASIS, _KNEE),
    ("trochanter", "knee_lateral"),
    0.18,
)  # the trochanter lies 18 % down from the ASIS
_SHANK = ((_KNEE, _ANKLE), ("knee_lateral", "ankle_lateral"), 0.0)
_SEGMENTS = {
    "upper_arm": _ARM,
    "upper_arm_high": _ARM,
    "forearm": _FOREARM,
    "forearm_low": _FOREARM,
    "thigh_lateral": _THIGH,
    "thigh_lateral_low": _THIGH,
    "shank_lateral": _SHANK,
    "shank_lateral_high": _SHANK,
}


def _beside(
    marker: Points, top: Points | None, bottom: Points | None
) -> tuple[float, float] | None:
    """(share of the way from top to bottom, distance from that line), over the frames in which the
    limb is longest.

    Those frames have the hip extended and the shoulder low, so that the line follows the bone.
    """
    if top is None or bottom is None:
        return None
    line = bottom - top
    length = np.linalg.norm(line, axis=-1)
    whole = np.isfinite(length) & np.isfinite(marker[:, 0]) & (length > 0.05)
    if whole.sum() < 5:
        return None
    chosen = whole & (length >= np.quantile(length[whole], 0.7))
    share = np.sum((marker - top) * line, axis=-1)[chosen] / length[chosen] ** 2
    beside = np.linalg.norm((marker - top)[chosen] - share[:, None] * line[chosen], axis=-1)
    if np.subtract(*np.quantile(share, [0.75, 0.25])) > 0.1:
        return None
    return float(np.median(share)), float(np.median(beside))


CHECKS: tuple[Callable[[Scene, MarkerLayout], Iterator[Correction]], ...] = (
    mirrored_capture,
    *PAIR_CHECKS,
    single_marker_side,
    waist_middle,
    wands,
    wrist_width,
    finger_not_knuckle,
    free_places,
)
