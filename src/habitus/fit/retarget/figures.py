"""Motions of skeletons that are built differently, in one form: a figure. Each joint has our name,
a place, and a rotation from a pose in which the figure stands upright and looks along +z.

Where a file's rest pose is a person's (T, A, or anything between), rotations are from there. Some
skeletons, LAFAN1's among them, have all bones along one axis at rest: then the frame of the motion
that is nearest to standing straight stands in.
"""

import re
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.rig import RigMotion
from habitus.errors import HabitusError
from habitus.fit.retarget.legs import skeleton_of
from habitus.fit.retarget.rig_matching import RigMatch, swapped
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation

UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
LEGS = (0.4, 1.3)
"""Metres that a grown person's or a child's thigh and shank have together."""
USUAL_LEG = 0.83
STRAIGHT = 0.7
"""Cosine between legs and the line of the trunk from which a pose counts as standing."""
SNAP = float(np.cos(np.deg2rad(25.0)))
NEAR = float(np.deg2rad(3.0))
"""Radians within which a figure at rest looks along an axis of its world."""
_TRUNK = re.compile(r"(spine|neck)\d*$")


@dataclass(frozen=True, eq=False)
class Figure:
    """T frames of n joints: ``rest`` (n, 3) upright, y up, facing +z; ``places`` (T, n, 3) in a
    world with y up, in metres; ``turns`` (T, n, 3, 3) from rest to that world.
    """

    names: tuple[str, ...]
    rest: Float[np.ndarray, "n 3"]
    turns: Float[np.ndarray, "T n 3 3"]
    places: Float[np.ndarray, "T n 3"]
    rate_hz: float

    def at(self, name: str) -> int:
        """The number of a joint, -1 where the figure lacks it."""
        return self.names.index(name) if name in self.names else -1

    def middle(self, part: str) -> Float[np.ndarray, "T 3"]:
        """Between a joint of the left and that of the right."""
        left, right = (self.at(f"{side}_{part}") for side in ("left", "right"))
        return 0.5 * (self.places[:, left] + self.places[:, right])


class Setting(NamedTuple):
    """How a rig's rest pose lies in its world: ``upright`` (3, 3) takes it to y up, facing +z;
    ``scale`` metres a unit.
    """

    places: Float[np.ndarray, "J 3"]
    turns: Float[np.ndarray, "J 3 3"]
    upright: Float[np.ndarray, "3 3"]
    scale: float


def figure_of_body(motion: BodyMotion) -> Figure:
    """A body's motion in a world with y up as a figure."""
    skeleton = skeleton_of(motion)
    rest = motion.body.rest_joints(np.asarray(motion.betas, np.float64))
    world = skeleton.world
    names = motion.body.joint_names
    return Figure(names, rest, world[..., :3], world[..., 3], motion.rate_hz)


def figure_of_rig(
    motion: RigMotion, match: RigMatch
) -> tuple[Figure, Setting, RigMatch, tuple[str, ...]]:
    """A rig's motion as a figure, its setting, the match with sides, and notes on what was decided.

    Raises HabitusError where neither the rest pose nor any frame stands.
    """
    notes = list(motion.notes)
    places, turns, frame = _reference(motion, match)
    if frame is not None:
        notes.append(f"its rest pose is no person's: frame {frame}, which stands, is taken for it")
    rest_up = _axis(_trunk(places, match))
    up = _world_up(motion, match, None if frame is not None else rest_up)
    if frame is not None:
        rest_up = _vector(up)
    if not match.sided:
        match = _with_sides(places, match, rest_up)
    upright = _upright(places, match, rest_up)
    leg = _leg_length(places, match)
    scale, unit = unit_of(leg)
    notes.append(unit)
    names = tuple(match.joints)
    chosen = list(match.joints.values())
    world = up_rotation(up)
    moved = world @ motion.turns[:, chosen] @ np.swapaxes(turns[chosen], 1, 2) @ upright.T
    figure = Figure(
        names=names,
        rest=scale * places[chosen] @ upright.T,
        turns=moved,
        places=scale * motion.places[:, chosen] @ world.T,
        rate_hz=motion.rate_hz,
    )
    return figure, Setting(places, turns, upright, scale), match, tuple(notes)


def unit_of(leg: float) -> tuple[float, str]:
    """Metres a unit by the length of thigh and shank, and a sentence that says so."""
    likely = min(
        list(UNITS)[:3], key=lambda unit: abs(np.log(max(UNITS[unit] * leg, 1e-12) / USUAL_LEG))
    )
    for unit in (likely, "inches"):
        if LEGS[0] <= UNITS[unit] * leg <= LEGS[1]:
            return UNITS[unit], f"read in {unit}, as legs are {UNITS[unit] * leg:.2f} m long so"
    if not 1e-9 < leg < 1e9:
        raise HabitusError(f"legs of length {leg:g}; expected a person's skeleton")
    scale = USUAL_LEG / leg
    return scale, f"legs of {leg:.3g} fit no unit: scaled to legs of {USUAL_LEG} m"


def _pair(places: np.ndarray, match: RigMatch, part: str) -> tuple[np.ndarray, np.ndarray]:
    joints = match.joints
    return places[..., joints[f"left_{part}"], :], places[..., joints[f"right_{part}"], :]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)


def _trunk(places: Float[np.ndarray, "*batch J 3"], match: RigMatch) -> np.ndarray:
    """The direction from between the hips to between the shoulders."""
    hips, shoulders = (np.add(*_pair(places, match, part)) for part in ("hip", "shoulder"))
    return _unit(shoulders - hips)


def _straightness(places: Float[np.ndarray, "*batch J 3"], match: RigMatch) -> np.ndarray:
    """The least cosine of thighs and shanks with the trunk's line (..., 4), and of forearms with
    upper arms (..., 2).
    """
    trunk = _trunk(places, match)
    parts = [_pair(places, match, part) for part in ("hip", "knee", "ankle")]
    legs = [
        -(_unit(below - above) * trunk).sum(axis=-1)
        for upper, lower in pairwise(parts)
        for above, below in zip(upper, lower, strict=True)
    ]
    return np.stack(legs, axis=-1)


def _reference(motion: RigMotion, match: RigMatch) -> tuple[np.ndarray, np.ndarray, int | None]:
    """Places and rotations of a standing pose, and its frame where it is not the rest pose."""
    rig = motion.rig
    if _straightness(rig.places, match).min() > STRAIGHT:
        return rig.places, rig.turns, None
    straight = _straightness(motion.places, match)
    bent = np.zeros(len(straight))
    joints = match.joints
    for side in ("left", "right"):
        if f"{side}_wrist" in joints:
            arm = [joints[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist")]
            bones = _unit(np.diff(motion.places[:, arm], axis=1))
            bent += 1.0 - (bones[:, 0] * bones[:, 1]).sum(axis=-1)
    worth = straight.sum(axis=1) + 2.0 * straight.min(axis=1) - 0.2 * bent
    frame = int(np.argmax(worth))
    if straight[frame].min() < STRAIGHT:
        raise HabitusError(
            "neither its rest pose nor any frame stands upright; expected a motion in which the "
            "person stands once, or a rest pose in T or A"
        )
    return motion.places[frame], motion.turns[frame], frame


def _axis(direction: np.ndarray) -> Float[np.ndarray, " 3"]:
    """A direction, or the axis that it is near to."""
    axis = np.zeros(3)
    k = int(np.argmax(np.abs(direction)))
    axis[k] = np.sign(direction[k])
    return axis if direction @ axis > SNAP else direction


def _vector(up_axis: str) -> Float[np.ndarray, " 3"]:
    return up_rotation(up_axis).T @ np.array([0.0, 1.0, 0.0])


def _world_up(motion: RigMotion, match: RigMatch, rest_up: np.ndarray | None) -> str:
    """The up axis of the world that the motion happens in: what the file says, else the axis along
    which the trunk mostly is.
    """
    if motion.up_axis:
        return motion.up_axis
    mean = np.median(_trunk(motion.places, match), axis=0)
    for axis in ("+y", "+z"):
        if _vector(axis) @ mean > 0.5:
            return axis
    if rest_up is not None and np.abs(rest_up).max() == 1.0:
        k = int(np.argmax(np.abs(rest_up)))
        return ("+" if rest_up[k] > 0 else "-") + "xyz"[k]
    return "+y"


def _with_sides(places: np.ndarray, match: RigMatch, up: np.ndarray) -> RigMatch:
    """The match with left and right where they are when feet point forward."""
    joints = match.joints
    feet = [side for side in ("left", "right") if f"{side}_foot" in joints]
    if not feet:
        raise HabitusError(
            "joints of unknown names and no toes: left and right cannot be distinguished; rename "
            "its joints as a known skeleton has them"
        )
    forward = sum(places[joints[f"{s}_foot"]] - places[joints[f"{s}_ankle"]] for s in feet)
    across = np.cross(up, forward)
    one, other = _pair(places, match, "hip")
    return replace(match, sided=True) if (one - other) @ across > 0 else swapped(match)


def _upright(places: np.ndarray, match: RigMatch, up: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes a standing pose to y up, facing +z."""
    across = sum(
        one - other for one, other in (_pair(places, match, part) for part in ("hip", "shoulder"))
    )
    x = _unit(across - (across @ up) * up)
    rotation = np.stack([x, up, np.cross(x, up)])
    axes = np.round(rotation)
    orthogonal = np.abs(axes @ axes.T - np.eye(3)).max() == 0.0
    if orthogonal and np.linalg.norm(rotvec_from_matrix(rotation @ axes.T)) < NEAR:
        return axes
    return rotation


def _leg_length(places: np.ndarray, match: RigMatch) -> float:
    parts = [_pair(places, match, part) for part in ("hip", "knee", "ankle")]
    return 0.5 * sum(
        float(np.linalg.norm(below - above))
        for upper, lower in pairwise(parts)
        for above, below in zip(upper, lower, strict=True)
    )


# -- from one figure to another's bones ------------------------------------------------------------


def pose_like(
    figure: Figure, body: BodyModel, rest: Float[np.ndarray, "J 3"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3 3"]]:
    """Local rotations (rad) of a body whose limbs point as the figure's do, and the root's matrix.

    ``rest`` are the body's joints at rest. Trunk and feet turn as the figure's do from upright;
    limbs besides by what their directions at rest differ, by the shortest way; trunks of other
    numbers of joints bend at shares of their length. Joints that the figure lacks keep still.
    """
    names = body.joint_names
    at_rest = _rest_turns(figure, names, rest)
    world = np.empty((len(figure.turns), len(names), 3, 3))
    pose = np.empty((len(figure.turns), len(names), 3))
    for joint, (name, parent) in enumerate(zip(names, body.parents, strict=True)):
        turn = _turn_of(figure, names, name)
        if turn is None:
            above = np.broadcast_to(np.eye(3), (len(world), 3, 3))
            world[:, joint] = world[:, parent] if parent >= 0 else above
        else:
            world[:, joint] = turn @ at_rest.get(name, np.eye(3))
        if parent < 0:
            pose[:, joint] = rotvec_from_matrix(world[:, joint])
        else:
            local = np.swapaxes(world[:, parent], 1, 2) @ world[:, joint]
            pose[:, joint] = rotvec_from_matrix(local)
    return pose, world[:, 0]


def _numbered(names: tuple[str, ...], part: str) -> list[str]:
    """Joints of spine or neck in order, from below."""
    found = [name for name in names if _TRUNK.match(name) and name.startswith(part)]
    return sorted(found, key=lambda name: int(name.removeprefix(part) or 1))


def _turn_of(figure: Figure, names: tuple[str, ...], name: str) -> np.ndarray | None:
    """A joint's rotation from rest, of trunk joints at their share of the way."""
    part = name.rstrip("0123456789")
    if part not in ("spine", "neck"):
        joint = figure.at(name)
        return None if joint < 0 else figure.turns[:, joint]
    spine = _numbered(figure.names, "spine")
    ours = _numbered(names, part)
    if part == "spine":
        chain, share = ["pelvis", *spine], (ours.index(name) + 1) / len(ours)
    else:
        head = ["head"] if figure.at("head") >= 0 else []
        chain = [spine[-1] if spine else "pelvis", *_numbered(figure.names, "neck"), *head]
        share = (ours.index(name) + 1) / (len(ours) + 1)
    at = share * (len(chain) - 1)
    low = min(int(at + 1e-9), len(chain) - 1)
    below = figure.turns[:, figure.at(chain[low])]
    if at - low < 1e-9:
        return below
    above = figure.turns[:, figure.at(chain[low + 1])]
    between = rotvec_from_matrix(np.swapaxes(below, 1, 2) @ above)
    return below @ matrix_from_rotvec((at - low) * between)


def shortest(one: np.ndarray, other: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes one direction to another."""
    a, b = _unit(one), _unit(other)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    return matrix_from_rotvec(axis / sine * np.arctan2(sine, a @ b))


_BONES = (
    ("hip", "knee", ""),
    ("knee", "ankle", "hip"),
    ("shoulder", "elbow", ""),
    ("elbow", "wrist", "shoulder"),
    *(
        (f"{finger}{k}", f"{finger}{k + 1}", f"{finger}{k - 1}" if k > 1 else "wrist")
        for finger in ("thumb", "index", "middle", "ring", "pinky")
        for k in (1, 2)
    ),
)
"""Bones of limbs: from, to, and the joint above."""


def _rest_turns(
    figure: Figure, names: tuple[str, ...], rest: np.ndarray
) -> dict[str, Float[np.ndarray, "3 3"]]:
    """What turns a body's limbs from their rest to the figure's, in axes of the world at rest."""
    ours = dict(zip(names, rest, strict=True))
    theirs = dict(zip(figure.names, figure.rest, strict=True))
    both = ours.keys() & theirs.keys()
    out: dict[str, np.ndarray] = {}
    for side in ("left", "right"):
        for start, end, above in _BONES:
            if start.endswith("1") and above == "wrist" and f"{side}_wrist" not in out:
                out[f"{side}_wrist"] = _hand(side, ours, theirs, out)
            first, last = f"{side}_{start}", f"{side}_{end}"
            turn = out.get(f"{side}_{above}", np.eye(3))
            if {first, last} <= both:
                bone = turn @ (ours[last] - ours[first])
                turn = shortest(bone, theirs[last] - theirs[first]) @ turn
            out[first] = turn
        for finger in ("thumb", "index", "middle", "ring", "pinky"):
            out[f"{side}_{finger}3"] = out[f"{side}_{finger}2"]
        out[f"{side}_hand"] = out[f"{side}_wrist"]
        foot = _yaw(side, ours, theirs)
        out |= {f"{side}_ankle": foot, f"{side}_foot": foot}
    return out


def _yaw(side: str, ours: dict, theirs: dict) -> np.ndarray:
    """The turn about the vertical between feet, which are flat on the ground in both."""
    joints = f"{side}_ankle", f"{side}_foot"
    if not all(joint in each for joint in joints for each in (ours, theirs)):
        return np.eye(3)
    flat = np.array([1.0, 0.0, 1.0])
    one, other = (flat * (each[joints[1]] - each[joints[0]]) for each in (ours, theirs))
    if min(np.linalg.norm(one), np.linalg.norm(other)) < 1e-3:
        return np.eye(3)
    return shortest(one, other)


def _hand(side: str, ours: dict, theirs: dict, turns: dict) -> np.ndarray:
    """The turn of a hand: along its middle finger, and about it as its palms differ."""
    turn = turns.get(f"{side}_elbow", np.eye(3))
    along = [_along(side, each) for each in (ours, theirs)]
    if along[0] is None or along[1] is None:
        return turn
    turn = shortest(turn @ along[0], along[1]) @ turn
    across = [_across(side, each) for each in (ours, theirs)]
    fingers = any(f"{side}_index1" in each and f"{side}_pinky1" in each for each in (ours, theirs))
    if across[0] is None or across[1] is None or not fingers:
        return turn
    axis = _unit(along[1])
    one, other = (each - (each @ axis) * axis for each in (turn @ across[0], across[1]))
    return shortest(one, other) @ turn


def _along(side: str, places: dict) -> np.ndarray | None:
    """The direction of a hand."""
    for end in (f"{side}_middle1", f"{side}_hand"):
        if end in places and f"{side}_wrist" in places:
            return places[end] - places[f"{side}_wrist"]
    return None


def _across(side: str, places: dict) -> np.ndarray | None:
    """From the little to the index finger; forward where a T-pose shows no fingers."""
    ends = f"{side}_index1", f"{side}_pinky1"
    if all(end in places for end in ends):
        return places[ends[0]] - places[ends[1]]
    along = _along(side, places)
    flat = along is not None and abs(_unit(along)[0]) > 0.9
    return np.array([0.0, 0.0, 1.0]) if flat else None
