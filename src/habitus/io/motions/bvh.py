"""BVH: a tree of joints with offsets and channels, and a table of their values frame by frame.

Biovision's format as programs write it today: any tree, any order and number of channels, end
sites, degrees; the unit is not in the file.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.rig import Rig, RigMotion
from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_NAME_LENGTH, Allowance, check_joints, read_text_file

CHANNELS = tuple(f"{axis}{what}" for what in ("position", "rotation") for axis in "XYZ")
DEPTH = 200
DELTAS = 0.05
"""Position channels below this share of their joint's offset are added to it, not in its place."""


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float]
    channels: list[str] = field(default_factory=list)
    end: bool = False


def read_bvh(path: Path) -> RigMotion:
    """The skeleton of a .bvh in motion, in the file's unit and world; ends of bones are joints,
    too.

    Position channels hold a joint's place in its parent, in place of its offset, as MotionBuilder
    and Blender have it; where they stay near zero they are added to it. Raises HabitusError.
    """
    try:
        text = read_text_file(path)
        return _motion(text, path.stem, path.stat().st_size)
    except OSError as error:
        raise HabitusError(f"{path}: {shown(error.strerror or error)}; expected a BVH") from error
    except UnicodeDecodeError as error:
        raise HabitusError(f"{path}: no text; expected a BVH") from error
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error


def _motion(text: str, name: str, size: int) -> RigMotion:
    head, mark, table = text.partition("MOTION")
    if not mark or not head.lstrip().upper().startswith("HIERARCHY"):
        raise HabitusError("no HIERARCHY and MOTION; expected a BVH")
    joints = _hierarchy(head.split()[1:])
    frames = re.match(r"\s*Frames:\s*(\d{1,12})\s+Frame Time:\s*(\S+)", table, re.IGNORECASE)
    if frames is None:
        raise HabitusError("no Frames and Frame Time below MOTION; expected a BVH")
    step = _number(frames[2], "Frame Time")
    if not 1e-4 < step < 10.0:
        raise HabitusError(f"Frame Time is {shown(frames[2])}; expected seconds a frame")
    count = sum(len(joint.channels) for joint in joints)
    words = table[frames.end() :].split()
    present = len(words) // max(count, 1)
    claimed = int(frames[1])
    if not count or not present or present * count != len(words):
        raise HabitusError(
            f"{len(words)} values below MOTION; expected {claimed} frames of {count} channels"
        )
    Allowance(size).take(present * len(joints), 8 * 12, "its motion")
    try:
        values = np.array(words, float).reshape(present, count)
    except ValueError as error:
        raise HabitusError(f"a value that is no number ({shown(error, 80)})") from error
    if not (np.abs(values) < 1e9).all():
        raise HabitusError("values that are no finite numbers; export it again")
    notes = () if present == claimed else (f"it claims {claimed} frames and holds {present}",)
    return _posed(joints, values, _rate(step), name, notes)


def _rate(step: float) -> float:
    """Frames a second; a whole number where the seconds a frame are one, rounded."""
    rate = 1.0 / step
    return float(round(rate)) if abs(round(rate) - rate) < 2e-5 * rate else rate


def _number(word: str, what: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e9:
        raise HabitusError(f"{what} is {shown(word, 40)}; expected a number")
    return value


def _hierarchy(words: Sequence[str]) -> list[_Joint]:
    """Joints in the order of the file, parents first."""
    joints: list[_Joint] = []
    stack: list[int] = []
    at = 0

    def take(count: int) -> Sequence[str]:
        nonlocal at
        if at + count > len(words):
            raise HabitusError("the HIERARCHY ends in the middle of a joint")
        at += count
        return words[at - count : at]

    while at < len(words):
        word = take(1)[0]
        kind = word.upper()
        if kind in ("ROOT", "JOINT", "END"):
            name = []
            while (part := take(1)[0]) != "{":
                name.append(part)
            if (kind == "ROOT") != (not stack) or (kind == "ROOT" and joints):
                raise HabitusError(f"{word} {shown(' '.join(name))}: expected one ROOT with joints")
            parent = stack[-1] if stack else -1
            title = " ".join(name)[:MAX_NAME_LENGTH]
            joints.append(_Joint("" if kind == "END" else title, parent, [], end=kind == "END"))
            check_joints(len(joints))
            stack.append(len(joints) - 1)
            if len(stack) > DEPTH:
                raise HabitusError("joints nested without end")
        elif kind == "}" and stack:
            if len(joints[stack.pop()].offset) != 3:
                raise HabitusError("a joint without OFFSET")
        elif kind == "OFFSET" and stack:
            joints[stack[-1]].offset = [_number(one, "an OFFSET") for one in take(3)]
        elif kind == "CHANNELS" and stack:
            joints[stack[-1]].channels = _channels(take)
        else:
            raise HabitusError(f"{shown(word, 40)} in the HIERARCHY; expected a BVH")
    if stack or not joints:
        raise HabitusError("the HIERARCHY has no end; expected ROOT { ... }")
    return joints


def _channels(take) -> list[str]:
    known = {channel.lower(): channel for channel in CHANNELS}
    count = take(1)[0]
    number = int(count) if count.isdigit() and len(count) < 3 else 99
    names = [known.get(one.lower(), "") for one in take(number)] if number <= 6 else [""]
    if "" in names or len(set(names)) != len(names):
        raise HabitusError(f"CHANNELS {shown(count, 20)}: expected up to six, such as Zrotation")
    return names


def _posed(
    joints: list[_Joint],
    values: Float[np.ndarray, "T C"],
    rate_hz: float,
    name: str,
    notes: tuple[str, ...],
) -> RigMotion:
    frames = len(values)
    places = np.empty((frames, len(joints), 3))
    turns = np.empty((frames, len(joints), 3, 3))
    rest = np.zeros((len(joints), 3))
    at = 0
    for k, joint in enumerate(joints):
        given = values[:, at : at + len(joint.channels)]
        at += len(joint.channels)
        offset = np.array(joint.offset)
        local = _places(joint, offset, given)
        turned = [(c[0], given[:, i]) for i, c in enumerate(joint.channels) if "rot" in c]
        turn = np.broadcast_to(np.eye(3), (frames, 3, 3))
        if turned:
            angles = np.stack([column for _, column in turned], axis=1)
            order = "".join(axis for axis, _ in turned)
            turn = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        if joint.parent < 0:
            rest[k], places[:, k], turns[:, k] = offset, local, turn
            continue
        above = turns[:, joint.parent]
        rest[k] = rest[joint.parent] + offset
        places[:, k] = places[:, joint.parent] + (above @ local[..., None])[..., 0]
        turns[:, k] = above @ turn
    rig = Rig(
        names=tuple(joint.name for joint in joints),
        parents=tuple(joint.parent for joint in joints),
        places=rest,
        turns=np.tile(np.eye(3), (len(joints), 1, 1)),
        ends=tuple(joint.end for joint in joints),
    )
    return RigMotion(rig, places, turns, rate_hz, name, notes=notes)


def _places(
    joint: _Joint, offset: Float[np.ndarray, " 3"], given: np.ndarray
) -> Float[np.ndarray, "T 3"]:
    """A joint's place in its parent, frame by frame."""
    local = np.tile(offset, (len(given), 1))
    moved = {"XYZ".index(c[0]): given[:, i] for i, c in enumerate(joint.channels) if "pos" in c}
    for axis, column in moved.items():
        local[:, axis] = column
    if joint.parent >= 0 and moved:
        far = np.linalg.norm(np.stack(list(moved.values()), axis=1), axis=1)
        if np.median(far) < DELTAS * np.linalg.norm(offset):
            for axis in moved:
                local[:, axis] += offset[axis]
    return local
