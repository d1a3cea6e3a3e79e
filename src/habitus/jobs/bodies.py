"""The body of a fit: the one that is asked for, with fingers where markers tell how they bend."""

import os
from collections import Counter
from collections.abc import Sequence

from habitus.body.model import BodyModel
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.jobs.ages import at_age
from habitus.jobs.subjects import Person, person
from habitus.types import PathLike

FEWEST = 3
"""Markers on the fingers of one hand from which on a body that comes along is taken with finger
joints by itself.
"""


def loaded(body: PathLike | BodyModel, joints: str = "auto", age: float | None = None) -> BodyModel:
    """The body itself, or the one that this names, with these joints, at an age in years. Raises
    HabitusError.
    """
    wanted = None if joints == "auto" else joints
    if not isinstance(body, BodyModel):
        found = load_body(os.fspath(body), joints=wanted)
    else:
        found = body if wanted is None else body.with_joints(wanted)
    return at_age(found, age)


def with_fingers(
    people: Sequence[Person], body: BodyModel, given: PathLike | BodyModel, joints: str
) -> tuple[list[Person], BodyModel]:
    """The people with their markers on fingers, and a body that has fingers; both as they are where
    there are none.

    A body that has finger joints uses the markers on fingers. With ``joints`` "auto", a body
    ``given`` by one of the names of those that come along gets finger joints where somebody has
    `FEWEST` markers on the fingers of one hand.
    """
    named = joints == "auto" and str(given) in SHIPPED
    if not any(one.left_fingers for one in people) or not (named or has_fingers(body)):
        return list(people), body
    found = [person(one.captures, one.wanted, fingers=True) for one in people]
    if has_fingers(body):
        return found, body
    if max(map(_on_one_hand, found)) < FEWEST:
        return list(people), body
    return found, loaded(str(given), "smplh", body.age)


def has_fingers(body: BodyModel) -> bool:
    """Whether a body has finger joints."""
    return "left_index1" in body.joint_names


def _on_one_hand(one: Person) -> int:
    """The most markers on the fingers of a hand."""
    sides = Counter(
        marker.place.partition("_")[0] for marker in one.layout.markers if marker.on_finger
    )
    return max(sides.values(), default=0)
