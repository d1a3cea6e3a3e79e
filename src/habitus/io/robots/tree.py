"""What descriptions of robots are made of: links, hinges, and numbers in attributes."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from habitus.body.robot import Robot
from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_JOINTS, MAX_NAME_LENGTH

MAX_LENGTH = 10.0  # metres between the frames of two links


@dataclass(frozen=True)
class Hinge:
    """A joint about an axis (any length but zero) through an anchor, both in its link's frame."""

    name: str
    axis: Float[np.ndarray, " 3"]
    anchor: Float[np.ndarray, " 3"]
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf


@dataclass(frozen=True)
class Link:
    """A link: its frame in its parent's (a name, "" for the root), and the hinge that turns it."""

    name: str
    parent: str
    offset: Float[np.ndarray, " 3"]
    turn: Float[np.ndarray, "3 3"]
    hinge: Hinge | None = None


def robot_of(name: str, links: list[Link], source: object) -> Robot:
    """The robot of links in which parents come first. Raises HabitusError for what is none."""
    if not links:
        raise HabitusError(f"{source}: no links; expected a robot (MJCF or URDF)")
    if len(links) > MAX_JOINTS:
        raise HabitusError(f"{source}: {len(links)} links; expected at most {MAX_JOINTS}")
    index: dict[str, int] = {}
    for k, link in enumerate(links):
        if link.name in index:
            raise HabitusError(f"{source}: two links are called {shown(link.name)}")
        index[link.name] = k
    jointed = [(k, link.hinge) for k, link in enumerate(links) if link.hinge is not None]
    if not jointed:
        raise HabitusError(f"{source}: no hinge joints; expected a robot with joints that turn")
    hinges = [hinge for _, hinge in jointed]
    for hinge in hinges:
        if not hinge.lower <= hinge.upper or not hinge.velocity > 0.0:
            raise HabitusError(
                f"{source}: joint {shown(hinge.name)}: limits {hinge.lower:g} to {hinge.upper:g} "
                f"rad, {hinge.velocity:g} rad/s; expected lower <= upper and a speed above 0"
            )
    return Robot(
        name=name[:MAX_NAME_LENGTH],
        link_names=tuple(index),
        parents=tuple(index[link.parent] if link.parent else -1 for link in links),
        offsets=np.array([link.offset for link in links]),
        turns=np.array([link.turn for link in links]),
        joint_names=tuple(hinge.name for hinge in hinges),
        joint_links=np.array([k for k, _ in jointed]),
        axes=np.array([_unit(hinge, source) for hinge in hinges]),
        anchors=np.array([hinge.anchor for hinge in hinges]),
        lower=np.array([hinge.lower for hinge in hinges]),
        upper=np.array([hinge.upper for hinge in hinges]),
        velocity=np.array([hinge.velocity for hinge in hinges]),
    )


def _unit(hinge: Hinge, source: object) -> Float[np.ndarray, " 3"]:
    length = float(np.linalg.norm(hinge.axis))
    if not length > 1e-9:
        raise HabitusError(f"{source}: joint {shown(hinge.name)}: its axis is 0 0 0")
    return hinge.axis / length


def numbers(
    element: Element, key: str, count: int, default: Iterable[float], source: object
) -> Float[np.ndarray, " count"]:
    """The numbers of an attribute. Raises HabitusError unless there are ``count`` finite ones."""
    text = element.get(key)
    if text is None:
        return np.array(list(default), dtype=float)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.abs(values) < 1e6).all():
        raise HabitusError(
            f"{source}: {element.tag} {shown(element.get('name', ''))}: {key}={shown(text)}; "
            f"expected {count} number{'s' * (count > 1)}"
        )
    return values


def place(element: Element, key: str, source: object) -> Float[np.ndarray, " 3"]:
    """A place in metres. Raises HabitusError for what is farther than a robot is long."""
    values = numbers(element, key, 3, (0.0, 0.0, 0.0), source)
    if np.abs(values).max() > MAX_LENGTH:
        raise HabitusError(
            f"{source}: {element.tag} {shown(element.get('name', ''))}: {key} of "
            f"{np.abs(values).max():g}; expected metres, at most {MAX_LENGTH:g}"
        )
    return values


def text_of(element: Element, key: str, default: Any = "") -> str:
    """An attribute as a name that can be shown."""
    return shown(element.get(key, default))
