"""Joint layouts of the SMPL family, as data (S 3 and the models' papers), and folding one into a
smaller one: SMPL's 24 joints, SMPL-H's 52 with fingers, SMPL-X's 55 with jaw and eyes.

Folding attaches a joint that a layout lacks to its parent: fingers to SMPL's hand, which is at the
base of the middle finger; jaw and eyes to the head.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError


@dataclass(frozen=True)
class JointLayout:
    """Names and parents (-1 for the root) of a family of bodies, in the order of its pose."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]


_BODY = (
    ("pelvis", None),
    ("left_hip", "pelvis"),
    ("right_hip", "pelvis"),
    ("spine1", "pelvis"),
    ("left_knee", "left_hip"),
    ("right_knee", "right_hip"),
    ("spine2", "spine1"),
    ("left_ankle", "left_knee"),
    ("right_ankle", "right_knee"),
    ("spine3", "spine2"),
    ("left_foot", "left_ankle"),
    ("right_foot", "right_ankle"),
    ("neck", "spine3"),
    ("left_collar", "spine3"),
    ("right_collar", "spine3"),
    ("head", "neck"),
    ("left_shoulder", "left_collar"),
    ("right_shoulder", "right_collar"),
    ("left_elbow", "left_shoulder"),
    ("right_elbow", "right_shoulder"),
    ("left_wrist", "left_elbow"),
    ("right_wrist", "right_elbow"),
)


def _chain(start: str, *names: str) -> tuple[tuple[str, str], ...]:
    """Joints that hang one on the other, the first on ``start``."""
    return tuple(zip(names, (start, *names), strict=False))


def _hand(wrist: str, prefix: str) -> tuple[tuple[str, str], ...]:
    """Fifteen finger joints of a hand: three a finger."""
    fingers = ("index", "middle", "pinky", "ring", "thumb")
    return tuple(
        bone
        for finger in fingers
        for bone in _chain(wrist, *(f"{prefix}{finger}{k}" for k in (1, 2, 3)))
    )


def _layout(name: str, bones: tuple[tuple[str, str | None], ...]) -> JointLayout:
    names = tuple(bone for bone, _ in bones)
    return JointLayout(
        name, names, tuple(-1 if parent is None else names.index(parent) for _, parent in bones)
    )


_HANDS = _hand("left_wrist", "left_") + _hand("right_wrist", "right_")
_FACE = (("jaw", "head"), ("left_eye_smplhf", "head"), ("right_eye_smplhf", "head"))
_SMAL = (
    ("pelvis", None),
    ("pelvis0", "pelvis"),
    ("spine", "pelvis0"),
    ("spine0", "spine"),
    ("spine1", "spine0"),
    ("spine2", "spine1"),
    ("spine3", "spine2"),
    *_chain("spine3", "left_fore_leg1", "left_fore_leg2", "left_fore_leg3", "left_fore_foot"),
    *_chain("spine3", "right_fore_leg1", "right_fore_leg2", "right_fore_leg3", "right_fore_foot"),
    ("neck", "spine3"),
    ("head", "neck"),
    *_chain("pelvis", "left_hind_leg1", "left_hind_leg2", "left_hind_leg3", "left_hind_foot"),
    *_chain("pelvis", "right_hind_leg1", "right_hind_leg2", "right_hind_leg3", "right_hind_foot"),
    *_chain("pelvis", *(f"tail{k}" for k in range(1, 8))),
    ("mouth", "head"),
)

SMPL = _layout("smpl", (*_BODY, ("left_hand", "left_wrist"), ("right_hand", "right_wrist")))
SMPLH = _layout("smplh", (*_BODY, *_HANDS))
SMPLX = _layout("smplx", (*_BODY, *_FACE, *_HANDS))
MANO = _layout("mano", (("wrist", None), *_hand("wrist", "")))
SMAL = _layout("smal", _SMAL)

LAYOUTS = {layout.name: layout for layout in (SMPL, SMPLH, SMPLX, MANO, SMAL)}


def find_layout(parents: tuple[int, ...]) -> JointLayout | None:
    """The known layout with these parents, or None."""
    return next((layout for layout in LAYOUTS.values() if layout.parents == parents), None)


SAME_PLACE = {"left_hand": "left_middle1", "right_hand": "right_middle1"}
"""Joints of a set that stand where a finer skeleton has another."""
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")


@dataclass(frozen=True)
class Fold:
    """How a skeleton becomes the joint set ``layout``: where each joint stands, and who carries
    each of its own.
    """

    layout: JointLayout
    stands: tuple[int, ...]
    """Of each joint of the set, the body's joint at its place."""
    carries: tuple[int, ...]
    """Of each joint of the body, the set's joint that carries it."""
    kept: Mapping[int, int]
    """Of the body's joints that stay what they are, their numbers in the set."""


def fold(joint_names: tuple[str, ...], parents: tuple[int, ...], joints: str, body: str) -> Fold:
    """The way from a body's joints to the set of that name. Raises HabitusError for a set that it
    has no joints for.
    """
    if joints not in LAYOUTS:
        raise HabitusError(f"joints are {joints!r}; expected one of {', '.join(LAYOUTS)}")
    layout = LAYOUTS[joints]
    places = {name: k for k, name in enumerate(joint_names)}
    stands = [places.get(name, places.get(SAME_PLACE.get(name, ""))) for name in layout.joint_names]
    missing = [
        name for name, place in zip(layout.joint_names, stands, strict=True) if place is None
    ]
    if missing:
        raise HabitusError(
            f"{body} has no joint {missing[0]!r}, which {joints} has; it has {len(joint_names)} "
            "joints"
        )
    carries: list[int] = []
    for name, parent in zip(joint_names, parents, strict=True):
        carrier = name if name in layout.joint_names else _hand_of_finger(name)
        has_carrier = carrier in layout.joint_names
        carries.append(layout.joint_names.index(carrier) if has_carrier else carries[parent])
    kept = {places[name]: k for k, name in enumerate(layout.joint_names) if name in places}
    return Fold(layout, tuple(stands), tuple(carries), kept)  # pyright: ignore[reportArgumentType]


def _hand_of_finger(name: str) -> str:
    """The hand that a finger belongs to."""
    side, _, finger = name.partition("_")
    return f"{side}_hand" if finger.startswith(_FINGERS) else ""


def folded_weights(
    carries: tuple[int, ...], index: Int[np.ndarray, "V K"], value: Float[np.ndarray, "V K"]
) -> tuple[Int[np.ndarray, "V K"], Float[np.ndarray, "V K"]]:
    """Influences with the joints' carriers in their place: each joint once, strongest first."""
    index = np.asarray(carries)[index]
    value = value.copy()
    for later in range(1, index.shape[1]):
        for earlier in range(later):
            again = index[:, later] == index[:, earlier]
            value[again, earlier] += value[again, later]
            value[again, later] = 0.0
    order = np.argsort(-np.abs(value), axis=1, kind="stable")
    return np.take_along_axis(index, order, 1), np.take_along_axis(value, order, 1)
