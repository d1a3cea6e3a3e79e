"""A generic OpenSim model scaled to a person: factors from pairs of like landmarks, and the body of
the model that carries each of the person's markers.

A model's joints are other points than a fit's, so that distances of joints scale nothing. The one
points that are not on the skin are the hips: the person's are Harrington's regression from the
pelvis' landmarks, as a width between the iliac spines says little of the hips below.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.anatomy import SACRUM, SIDES
from habitus.errors import HabitusError, listed
from habitus.export.opensim_engine import body_names, scaled, track

Point = Float[np.ndarray, "3"]
TO_OPENSIM = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""From body space (left, up, forward) to OpenSim's axes (forward, up, right)."""
ROUNDS = 4
"""Of posing the model as the person and scaling: pairs across a joint depend on the pose; the last
round changes factors by less than a thousandth."""
REFINEMENTS = 4
"""Rounds of inverse kinematics and placing markers; more do not lower the error of other trials."""
ENDS = {"left": "l", "right": "r"}
"""How names of OpenSim's bodies end."""


class Measure(NamedTuple):
    """A length of the body: pairs of landmarks (without the side: both), whose ratios between
    person and model are averaged, and the bodies (without the side) and axes that it scales.
    """

    name: str
    pairs: tuple[tuple[str, str], ...]
    bodies: tuple[str, ...]
    axes: str = "xyz"
    needed: bool = False


MEASURES = (
    Measure("pelvis depth", (("asis", "psis"), ("asis", SACRUM)), ("pelvis",), "x", True),
    Measure("hip width", (("left_hip", "right_hip"),), ("pelvis",), "z", True),
    Measure(
        "thigh",
        (("asis", "knee_lateral"), ("asis", "knee_medial")),
        ("femur", "patella"),
        needed=True,
    ),
    Measure(
        "shank",
        (("knee_lateral", "ankle_lateral"), ("knee_medial", "ankle_medial")),
        ("tibia",),
        needed=True,
    ),
    Measure(
        "foot",
        tuple(("heel", far) for far in ("mt5_head", "mt1_head", "mt2_head", "big_toe", "toe_tip")),
        ("talus", "calcn", "toes"),
    ),
    Measure(
        "trunk",
        tuple(("c7", low) for low in ("psis", SACRUM))
        + tuple(("acromion", low) for low in ("psis", SACRUM)),
        ("torso",),
        "xy",
    ),
    Measure("shoulder width", (("left_acromion", "right_acromion"),), ("torso",), "z"),
    Measure(
        "upper arm", (("acromion", "elbow_lateral"), ("acromion", "elbow_medial")), ("humerus",)
    ),
    Measure(
        "forearm",
        (("elbow_lateral", "wrist_radial"), ("elbow_medial", "wrist_ulnar")),
        ("ulna", "radius", "hand"),
    ),
)
LANDMARKS = frozenset(
    end.removeprefix("left_").removeprefix("right_")
    for measure in MEASURES
    for pair in measure.pairs
    for end in pair
) - {"hip"}
"""Landmarks that are compared, without the side."""
OF_JOINT = {
    "pelvis": "pelvis", "hip": "femur", "knee": "tibia", "ankle": "calcn", "foot": "calcn",
    "spine1": "torso", "spine2": "torso", "spine3": "torso", "collar": "torso",
    "shoulder": "humerus", "elbow": "radius", "wrist": "hand", "neck": "head", "head": "head",
}  # fmt: skip
"""The model's body that moves with the skin of each of the fit's joints. Toes are on the calcaneus:
one marker does not determine the joint between them."""
OF_LANDMARK = {
    "asis": "pelvis", "psis": "pelvis", SACRUM: "pelvis", "iliac_crest": "pelvis",
    "trochanter": "femur", "knee_lateral": "femur", "knee_medial": "femur", "patella": "femur",
    "fibula_head": "tibia", "tibial_tuberosity": "tibia", "ankle_lateral": "tibia",
    "ankle_medial": "tibia", "heel": "calcn", "c7": "torso", "t10": "torso",
    "jugular_notch": "torso", "clavicle_medial": "torso", "acromion": "torso",
    "elbow_lateral": "humerus", "elbow_medial": "humerus", "wrist_radial": "radius",
    "wrist_ulnar": "radius",
}  # fmt: skip
"""Markers between two bodies lie on the bone that their landmark is of."""
NEEDED_BODIES = (
    "pelvis",
    *(f"{name}_{end}" for name in ("femur", "tibia", "calcn") for end in "rl"),
)


class Scaling(NamedTuple):
    """A model scaled to a person: factors x, y, z by body; measures: lengths (m) of the person and
    of the generic model by name; pose: turns (B, 3, 3) and origins (B, 3) of ``bodies`` where the
    model's landmarks are nearest to the person's, and their RMS distance then (m).
    """

    model: Any
    factors: Mapping[str, tuple[float, float, float]]
    measures: Mapping[str, tuple[float, float]]
    bodies: tuple[str, ...]
    turns: Float[np.ndarray, "B 3 3"]
    origins: Float[np.ndarray, "B 3"]
    landmark_error: float


def scale_to(
    model: Any, landmarks: Mapping[str, str], person: Mapping[str, Point], mass: float, name: str
) -> Scaling:
    """A generic model scaled to a person of this mass (kg).

    landmarks: of the model's markers by label, the landmark's name; person: places (m) of landmarks
    and hips, in OpenSim's axes and one stance. ``name`` names the model in errors. Raises
    HabitusError for a model without the bodies or the markers that the legs' scale needs.
    """
    names = body_names(model)
    lacking = [body for body in NEEDED_BODIES if body not in names]
    if lacking:
        raise HabitusError(
            f"{name} has no body {listed(lacking)}; expected bodies named as in OpenSim's gait2392 "
            f"or Rajagopal's model ({', '.join(NEEDED_BODIES)})"
        )
    known = {label: place for label, place in landmarks.items() if place in person}
    labels = tuple(known)
    _refuse_unmeasured(set(known.values()), set(person), name)
    target = np.stack([person[known[label]] for label in labels])
    factors = {body: np.ones(3) for body in names}
    first: dict[str, tuple[float, float]] = {}
    own = model
    for turn in range(ROUNDS + 1):
        own = scaled(model, factors, mass) if turn else model
        posed = track(own, labels, target[None], 1.0, names)
        places = dict(zip(known.values(), posed.markers[0], strict=True)) | {
            f"{side}_hip": posed.origins[0, names.index(f"femur_{end}")]
            for side, end in ENDS.items()
        }
        places.setdefault(SACRUM, _between(places, "left_psis", "right_psis"))
        lengths = measured(person, places)
        first = first or lengths
        if turn < ROUNDS:
            factors = _rescaled(factors, lengths)
    off = np.linalg.norm(posed.markers[0] - target, axis=1)
    return Scaling(
        own,
        {body: (float(x), float(y), float(z)) for body, (x, y, z) in factors.items()},
        first,
        names,
        posed.turns[0],
        posed.origins[0],
        float(np.sqrt(np.mean(off**2))),
    )


def _between(places: Mapping[str, Point], one: str, other: str) -> Point:
    if one in places and other in places:
        return 0.5 * (places[one] + places[other])
    return np.full(3, np.nan)


def _sided(pair: tuple[str, str]) -> set[tuple[str, str]]:
    """A pair on both sides; of names that have a side already, itself."""
    if pair[0].startswith(SIDES):
        return {pair}

    def of_side(name: str, side: str) -> str:
        return name if name in ("c7", SACRUM) else f"{side}_{name}"

    one, other = pair
    return {(of_side(one, side), of_side(other, side)) for side in SIDES}


def measured(
    person: Mapping[str, Point], model: Mapping[str, Point]
) -> dict[str, tuple[float, float]]:
    """By measure the mean lengths (m) of its pairs on the person and on the model, of those pairs
    that both have.
    """
    out = {}
    for measure in MEASURES:
        lengths = [
            [float(np.linalg.norm(of[one] - of[other])) for of in (person, model)]
            for pair in measure.pairs
            for one, other in sorted(_sided(pair))
            if all(end in of for end in (one, other) for of in (person, model))
        ]
        whole = [pair for pair in lengths if np.isfinite(pair).all() and min(pair) > 0.0]
        if whole:
            mine, its = np.mean(whole, axis=0)
            out[measure.name] = (float(mine), float(its))
    return out


def _rescaled(
    factors: Mapping[str, np.ndarray], lengths: Mapping[str, tuple[float, float]]
) -> dict[str, np.ndarray]:
    """Factors after another round. An axis that no pair measures follows the other axes of its
    body, a body without any the mean of the legs.
    """
    ratios: dict[str, np.ndarray] = {body: np.full(3, np.nan) for body in factors}
    for measure in MEASURES:
        if measure.name in lengths:
            mine, its = lengths[measure.name]
            for body in factors:
                if body.removesuffix("_r").removesuffix("_l") in measure.bodies:
                    for axis in measure.axes:
                        ratios[body]["xyz".index(axis)] = mine / its
    whole = np.nanmean([ratios[body] * factors[body] for body in ("femur_r", "tibia_r")])
    out = {}
    for body, ratio in ratios.items():
        new = factors[body] * ratio
        known = np.isfinite(new)
        out[body] = np.where(known, new, new[known].mean() if known.any() else whole)
    return out


def _refuse_unmeasured(model: set[str], person: set[str], name: str) -> None:
    hips = {f"{side}_hip" for side in SIDES}
    own = model | hips | ({SACRUM} if {"left_psis", "right_psis"} <= model else set())
    for measure in MEASURES:
        pairs = [pair for both in measure.pairs for pair in _sided(both)]
        if measure.needed and not any(set(pair) <= own & person for pair in pairs):
            wanted = " or ".join(f"{one} and {other}" for one, other in measure.pairs)
            raise HabitusError(
                f"{name}: no markers measure its {measure.name} ({wanted}, on a side); expected a "
                "model with a marker set of known labels, or one beside it (--opensim-markers)"
            )


def carriers(
    joints: Sequence[str], places: Sequence[str], own: Sequence[str | None], bodies: Iterable[str]
) -> list[str | None]:
    """The model's body that carries each marker; None where the model has no such body.

    joints: of the fit, that the skin under each marker moves with; places: of markers on landmarks
    these, else anything; own: the body where the model has a marker of this label.
    """
    known = set(bodies)
    out: list[str | None] = []
    for joint, place, body in zip(joints, places, own, strict=True):
        side = next((side for side in SIDES if joint.startswith(side)), "")
        landmark = place.removeprefix("left_").removeprefix("right_")
        plain = OF_LANDMARK.get(landmark, OF_JOINT.get(joint.removeprefix(f"{side}_"), ""))
        sided = next((each for each in SIDES if place.startswith(each)), side)
        end = "" if plain in ("pelvis", "torso", "head") or not sided else f"_{ENDS[sided]}"
        found = body or f"{plain}{end}"
        out.append(found if found in known else None)
    return out


def placed(
    turns: Float[np.ndarray, "T B 3 3"],
    origins: Float[np.ndarray, "T B 3"],
    observed: Float[np.ndarray, "T M 3"],
    carrier: Sequence[int],
) -> Float[np.ndarray, "M 3"]:
    """Where each marker was on average in the axes of its body (m); NaN where it was never seen."""
    rows = np.asarray(carrier, int)
    inside = np.einsum("tmji,tmj->tmi", turns[:, rows], observed - origins[:, rows])
    seen = np.isfinite(inside[..., :1])
    total = np.where(seen, inside, 0.0).sum(0)
    count = seen.sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
