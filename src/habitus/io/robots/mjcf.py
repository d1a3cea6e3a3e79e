"""MJCF, the format of MuJoCo: bodies within bodies (mujoco.readthedocs.io, XML reference).

Read are the tree, hinges and their limits; geometry, actuators and tendons are left alone.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.robot import Robot
from habitus.errors import HabitusError, shown
from habitus.io.robots.tree import Hinge, Link, numbers, place, robot_of, text_of


@dataclass(frozen=True)
class _Compiler:
    """What ``<compiler>`` says of angles."""

    degrees: bool
    sequence: str
    autolimits: bool


def mjcf_robot(root: Element, source: Path) -> Robot:
    """The robot of a parsed MJCF file. Raises HabitusError.

    The first body of the world is the robot's root, free to move whether or not the file gives it a
    free joint. A body of several hinges becomes as many links, the last of which has its name.
    """
    if root.find(".//include") is not None:
        raise HabitusError(
            f"{source}: includes other files; expected the robot's own file, which holds its bodies"
        )
    world = root.find("worldbody")
    bodies = [] if world is None else world.findall("body")
    bodies = [body for body in bodies if body.find(".//joint") is not None] or bodies
    if not bodies:
        raise HabitusError(f"{source}: no body in worldbody; expected a robot")
    compiler = root.find("compiler")
    compiler = Element("compiler") if compiler is None else compiler
    sequence = compiler.get("eulerseq", "xyz")
    if len(sequence) != 3 or set(sequence.lower()) - set("xyz"):
        raise HabitusError(f"{source}: eulerseq={shown(sequence)}; expected one such as xyz")
    angles = _Compiler(
        compiler.get("angle", "degree") == "degree",
        sequence,
        compiler.get("autolimits", "true") == "true",
    )
    classes = dict(_classes(root))
    links = list(_links(bodies[0], "", classes, angles, source))
    first = links[0]
    links[0] = Link(first.name, "", np.zeros(3), np.eye(3))
    return robot_of(text_of(root, "model", source.stem), links, source)


def _classes(root: Element) -> Iterator[tuple[str, dict[str, str]]]:
    """Attributes of joints that each default class sets, those of the classes around it
    included.
    """
    waiting = [(top, {}) for top in root.findall("default")]
    while waiting:
        default, inherited = waiting.pop()
        joint = default.find("joint")
        own = {**inherited, **({} if joint is None else joint.attrib)}
        yield default.get("class", "main"), own
        waiting.extend((inner, own) for inner in default.findall("default"))


def _links(
    body: Element,
    parent: str,
    classes: dict[str, dict[str, str]],
    compiler: _Compiler,
    source: Path,
) -> Iterator[Link]:
    """Links of a body and of all within it, depth first, as MuJoCo numbers joints."""
    waiting = [(body, parent, "main")]
    count = 0
    while waiting:
        body, parent, kind = waiting.pop()
        kind = body.get("childclass", kind)
        count += 1
        name = text_of(body, "name") or f"body {count}"
        hinges = [] if not parent else list(_hinges(body, kind, classes, compiler, source))
        frame = place(body, "pos", source), _turn(body, compiler, source)
        for k, hinge in enumerate(hinges[:-1]):
            between = f"{name} {k + 1}"
            yield Link(between, parent, *frame, hinge)
            parent, frame = between, (np.zeros(3), np.eye(3))
        yield Link(name, parent, *frame, hinges[-1] if hinges else None)
        waiting.extend((inner, name, kind) for inner in reversed(body.findall("body")))


def _hinges(
    body: Element,
    kind: str,
    classes: dict[str, dict[str, str]],
    compiler: _Compiler,
    source: Path,
) -> Iterator[Hinge]:
    for given in body.findall("joint"):
        defaults = classes.get(given.get("class", kind), {})
        joint = Element("joint", {**defaults, **given.attrib})
        name = text_of(joint, "name") or f"{text_of(body, 'name')}_joint"
        shape = joint.get("type", "hinge")
        if shape != "hinge" or float(numbers(joint, "ref", 1, (0.0,), source)[0]):
            what = f"of type {shown(shape)}" if shape != "hinge" else "with a ref"
            raise HabitusError(f"{source}: joint {name} is {what}; expected hinges without one")
        lower, upper = -math.inf, math.inf
        limited = joint.get("limited", "auto")
        ranged = joint.get("range") is not None and compiler.autolimits
        if limited == "true" or (limited == "auto" and ranged):
            bounds = numbers(joint, "range", 2, (0.0, 0.0), source)
            lower, upper = (np.deg2rad(bounds) if compiler.degrees else bounds).tolist()
        axis = numbers(joint, "axis", 3, (0.0, 0.0, 1.0), source)
        yield Hinge(name, axis, place(joint, "pos", source), lower, upper)


def _turn(body: Element, compiler: _Compiler, source: Path) -> Float[np.ndarray, "3 3"]:
    """The rotation of a body's frame in its parent's, whichever way it is written."""
    if body.get("quat") is not None:
        w, x, y, z = numbers(body, "quat", 4, (1, 0, 0, 0), source)
        if not abs(w) + abs(x) + abs(y) + abs(z) > 1e-9:
            raise HabitusError(f"{source}: body {text_of(body, 'name')}: a quat of zeros")
        return Rotation.from_quat([x, y, z, w]).as_matrix()
    if body.get("euler") is not None:
        angles = numbers(body, "euler", 3, (0, 0, 0), source)
        sequence = compiler.sequence
        # MuJoCo's small letters turn with the frame, capitals about fixed axes; SciPy's the reverse
        return Rotation.from_euler(
            sequence.swapcase(), angles, degrees=compiler.degrees
        ).as_matrix()
    if body.get("axisangle") is not None:
        *axis, angle = numbers(body, "axisangle", 4, (0, 0, 1, 0), source)
        angle = np.deg2rad(angle) if compiler.degrees else angle
        length = max(float(np.linalg.norm(axis)), 1e-12)
        return Rotation.from_rotvec(angle / length * np.array(axis)).as_matrix()
    if body.get("xyaxes") is not None:
        values = numbers(body, "xyaxes", 6, (1, 0, 0, 0, 1, 0), source)
        x = values[:3] / max(float(np.linalg.norm(values[:3])), 1e-12)
        y = values[3:] - (values[3:] @ x) * x
        y = y / max(float(np.linalg.norm(y)), 1e-12)
        return np.column_stack([x, y, np.cross(x, y)])
    if body.get("zaxis") is not None:
        z = numbers(body, "zaxis", 3, (0, 0, 1), source)
        length = float(np.linalg.norm(z))
        if not length > 1e-9:
            raise HabitusError(f"{source}: body {text_of(body, 'name')}: a zaxis of zeros")
        across = np.cross((0.0, 0.0, 1.0), z / length)
        sine = float(np.linalg.norm(across))
        angle = math.atan2(sine, z[2] / length)
        axis = across / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
        return Rotation.from_rotvec(angle * axis).as_matrix()
    return np.eye(3)
