"""URDF: links joined by joints (wiki.ros.org/urdf/XML)."""

import math
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from habitus.body.robot import Robot
from habitus.errors import HabitusError, shown
from habitus.io.robots.tree import Hinge, Link, numbers, place, robot_of, text_of

TURNING = ("revolute", "continuous")


def urdf_robot(root: Element, source: Path) -> Robot:
    """The robot of a parsed URDF file. Raises HabitusError.

    A floating or fixed joint from a world link without geometry leaves the robot's own root link
    free. Joints that mimic others stay at zero.
    """
    joints = root.findall("joint")
    children: dict[str, list[Element]] = {}
    below = set()
    for joint in joints:
        children.setdefault(_end(joint, "parent", source), []).append(joint)
        below.add(_end(joint, "child", source))
    names = [text_of(link, "name") for link in root.findall("link")]
    tops = [name for name in names if name not in below]
    if len(tops) != 1:
        raise HabitusError(
            f"{source}: {len(tops)} links without a parent; expected one, the robot's root"
        )
    top = tops[0]
    first = children.get(top, [])
    if len(first) == 1 and first[0].get("type") == "floating":
        top = _end(first[0], "child", source)
    links = [Link(top, "", np.zeros(3), np.eye(3))]
    waiting = list(reversed(children.get(top, [])))
    seen = {top}
    while waiting:
        joint = waiting.pop()
        link = _link(joint, source)
        if link.name in seen:
            raise HabitusError(f"{source}: link {shown(link.name)} hangs from two joints")
        seen.add(link.name)
        links.append(link)
        waiting.extend(reversed(children.get(link.name, [])))
    return robot_of(text_of(root, "name", source.stem), links, source)


def _end(joint: Element, which: str, source: Path) -> str:
    found = joint.find(which)
    if found is None or not found.get("link"):
        raise HabitusError(f"{source}: joint {text_of(joint, 'name')} names no {which} link")
    return text_of(found, "link")


def _link(joint: Element, source: Path) -> Link:
    """The child link of a joint."""
    name = text_of(joint, "name")
    kind = joint.get("type", "")
    origin = joint.find("origin")
    origin = Element("origin") if origin is None else origin
    turn = Rotation.from_euler("xyz", numbers(origin, "rpy", 3, (0, 0, 0), source)).as_matrix()
    hinge = None
    if kind in TURNING and joint.find("mimic") is None:
        hinge = _hinge(joint, name, kind, source)
    elif kind not in (*TURNING, "fixed"):
        raise HabitusError(
            f"{source}: joint {name} is {kind or 'of no type'}; expected revolute, continuous or "
            "fixed joints"
        )
    offset = place(origin, "xyz", source)
    parent = _end(joint, "parent", source)
    return Link(_end(joint, "child", source), parent, offset, turn, hinge)


def _hinge(joint: Element, name: str, kind: str, source: Path) -> Hinge:
    axis = joint.find("axis")
    axis = Element("axis") if axis is None else axis
    limit = joint.find("limit")
    limit = Element("limit") if limit is None else limit
    infinite = (math.inf,)
    lower, upper = -math.inf, math.inf
    if kind == "revolute":
        lower = float(numbers(limit, "lower", 1, (0.0,), source)[0])
        upper = float(numbers(limit, "upper", 1, (0.0,), source)[0])
    velocity = float(numbers(limit, "velocity", 1, infinite, source)[0])
    direction = numbers(axis, "xyz", 3, (1.0, 0.0, 0.0), source)
    return Hinge(name, direction, np.zeros(3), lower, upper, velocity or math.inf)
