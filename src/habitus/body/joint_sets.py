"""One skeleton seen with more joints or fewer: SMPL's 24, SMPL-H's 52 with fingers, SMPL-X's 55
with jaw and eyes.

Folding lets a joint that a set lacks ride on the one that it hangs on: fingers on SMPL's hand,
which stands where the middle finger begins; jaw and eyes on the head. What hangs on a joint that
does not turn is not moved by this.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.joint_layouts import LAYOUTS, JointLayout
from habitus.errors import HabitusError

STANDS_AT = {"left_hand": "left_middle1", "right_hand": "right_middle1"}
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
    stands = [places.get(name, places.get(STANDS_AT.get(name, ""))) for name in layout.joint_names]
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
        carrier = name if name in layout.joint_names else _hand(name)
        found = carrier in layout.joint_names
        carries.append(layout.joint_names.index(carrier) if found else carries[parent])
    kept = {places[name]: k for k, name in enumerate(layout.joint_names) if name in places}
    return Fold(layout, tuple(stands), tuple(carries), kept)  # pyright: ignore[reportArgumentType]


def _hand(name: str) -> str:
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
