"""The bones of a file: how they rest, which joint carries each, and a motion in their own axes.

A joint of the body turns by L against its parent, in the body's axes. A bone with axes B (columns,
at zero pose) on a parent with axes A turns by A^T L B against it, and lies at A^T t where the joint
lies at t. Skins bind to the bones as they rest, so that the posed surface stays the same.

Bones have +y along the limb, as Blender, Mixamo and glTF's tools have it; z is forward for trunk,
arms and legs, up for feet and towards the palm for hands and fingers. Elbows, wrists and fingers
bend about +x, knees about -x.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, shown
from habitus.export.rigs import Rig

AXES = ("along", "world")
NO_JOINT = -1
FLOOR_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Of a bone on the floor: z up, y backwards, so that it is not turned where z is up."""
_SIDES = ("left", "right")
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_MAIN: Mapping[str, str] = MappingProxyType(
    {
        "pelvis": "spine1",
        "spine3": "neck",
        **{f"{side}_wrist": f"{side}_middle1" for side in _SIDES},
    }
)
"""The child that a bone points to, where its joint has several."""
_ENDS = frozenset({"head"})
"""Bones that point to the end of what they carry, although joints hang on them."""
_FORWARD = frozenset(f"{side}_eye_smplhf" for side in _SIDES)
_PALMS = frozenset(
    f"{side}_{part}"
    for side in _SIDES
    for part in ("wrist", "hand", *(f"{finger}{k}" for finger in _FINGERS for k in (1, 2, 3)))
)
_TIP = 0.05
"""Length (m) of what carries no skin."""
_STEEP = 0.7
"""A bone that points forward by more than this cosine has its z up."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """N bones, parents first, of a body of J joints.

    carriers: the joint that each bone moves with, `NO_JOINT` for one on the floor; own: the bone of
    each joint; places (m) and axes: at the body's zero pose, in its axes; turned: how the rest pose
    turns each joint, and rest: how bones rest then.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    carriers: tuple[int, ...]
    own: Int[np.ndarray, " J"]
    places: Float[np.ndarray, "N 3"]
    axes: Float[np.ndarray, "N 3 3"]
    turned: Float[np.ndarray, "J 3 3"]
    rest: Float[np.ndarray, "N 4 4"]

    @property
    def local_rest(self) -> Float[np.ndarray, "N 4 4"]:
        """How bones rest against their parents."""
        return np.stack(
            [
                self.rest[k] if parent < 0 else np.linalg.solve(self.rest[parent], self.rest[k])
                for k, parent in enumerate(self.parents)
            ]
        )

    @property
    def is_plain(self) -> bool:
        """Whether all bones rest turned like the world."""
        return np.array_equal(self.rest[:, :3, :3], np.tile(np.eye(3), (len(self.names), 1, 1)))


def check_axes(axes: str) -> None:
    """Raises HabitusError for axes that bones cannot have."""
    if axes not in AXES:
        raise HabitusError(f"bones is {shown(axes)}; expected {' or '.join(AXES)}")


def plain_skeleton(body: BodyModel, joints: Float[np.ndarray, "J 3"]) -> Skeleton:
    """A bone a joint, under its name, turned like the world."""
    count = len(body.parents)
    rest = np.tile(np.eye(4), (count, 1, 1))
    rest[:, :3, 3] = joints
    still = rest[:, :3, :3].copy()
    own = np.arange(count)
    parents = tuple(int(parent) for parent in body.parents)
    carriers = tuple(range(count))
    return Skeleton(body.joint_names, parents, carriers, own, joints, still, still, rest)


def bone_axes(
    body: BodyModel, joints: Float[np.ndarray, "J 3"], vertices: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "J 3 3"]:
    """The axes of the joints' bones (columns) at zero pose, as this module's text has them."""
    found = np.zeros((len(joints), 3, 3))
    for joint, name in enumerate(body.joint_names):
        parent = body.parents[joint]
        way = _way(body, joints, vertices, joint)
        length = np.linalg.norm(way)
        above = found[parent, :, 1] if parent >= 0 else np.array([0.0, 1.0, 0.0])
        y = way / length if length > 1e-6 else above
        found[joint] = _aimed(y, name)
    return found


def _aimed(y: Float[np.ndarray, " 3"], name: str) -> Float[np.ndarray, "3 3"]:
    """A bone's axes: along y, rolled as becomes the joint that carries it."""
    up = name in _FORWARD or y[2] > _STEEP
    aim = np.array([0.0, -1.0, 0.0] if name in _PALMS else [0.0, 1.0, 0.0] if up else [0, 0, 1])
    across = np.cross(y, aim)
    if np.linalg.norm(across) < 0.1:  # along the limb: any other
        across = np.cross(y, np.roll(aim, 1))
    x = across / np.linalg.norm(across)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _way(body: BodyModel, joints: np.ndarray, vertices: np.ndarray, joint: int) -> np.ndarray:
    """Where a bone points, from its joint (m)."""
    name = body.joint_names[joint]
    if name in _FORWARD:
        return np.array([0.0, 0.0, 1.0])
    below = [child for child, parent in enumerate(body.parents) if parent == joint]
    main = [child for child in below if body.joint_names[child] == _MAIN.get(name)]
    if below and name not in _ENDS:
        return joints[main or below].mean(axis=0) - joints[joint]
    return tip(body, joints, vertices, joint)


def tip(
    body: BodyModel,
    joints: Float[np.ndarray, "J 3"],
    vertices: Float[np.ndarray, "V 3"],
    joint: int,
) -> Float[np.ndarray, " 3"]:
    """Where a limb ends (m from its joint): twice as far as the middle of what it carries."""
    carried = body.skinning_weights[:, joint]
    if carried.max() < 0.5:
        way = joints[joint] - joints[max(body.parents[joint], 0)]
        return _TIP * way / max(float(np.linalg.norm(way)), 1e-9)
    return 2.0 * (np.average(vertices, axis=0, weights=carried) - joints[joint])


def skeleton_of(
    body: BodyModel,
    joints: Float[np.ndarray, "J 3"],
    vertices: Float[np.ndarray, "V 3"],
    rig: Rig | None = None,
    axes: str = "along",
    root_bone: bool = False,
    tilt: float = 0.0,
) -> Skeleton:
    """The bones that a file has of a body that rests so (m, zero pose).

    rig: their names, those between and beyond joints, and the rest pose; by itself the body's own
    joints. axes: "along", or "world" for bones that rest turned like the world. root_bone: with a
    bone on the floor that the pelvis hangs on. tilt: degrees by which bones miss their limbs.
    Raises HabitusError for other axes and for names
    that two bones would have.
    """
    check_axes(axes)
    frames = np.tile(np.eye(3), (len(joints), 1, 1))
    if axes == "along":
        frames = bone_axes(body, joints, vertices)
    bones = _Bones(body, joints, frames, axes == "along")
    tilted = Rotation.from_euler("x", tilt if axes == "along" else 0.0, degrees=True).as_matrix()
    if root_bone:
        bones.add(rig.root if rig else "root", NO_JOINT, NO_JOINT, np.zeros(3), FLOOR_AXES)
    for joint, name in enumerate(body.joint_names):
        parent = body.parents[joint]
        above = (0 if root_bone else NO_JOINT) if parent < 0 else bones.towards(parent, joint, rig)
        called = rig.bones.get(name, name) if rig else name
        bones.own[joint] = bones.add(called, above, joint, joints[joint], frames[joint])
    for name, called in (rig.tips or {}).items() if rig else ():
        if name in body.joint_names:
            joint = body.joint_names.index(name)
            end = joints[joint] + tip(body, joints, vertices, joint)
            bones.add(called, bones.own[joint], joint, end, frames[joint])
    return bones.skeleton(_turned(body, rig), tilted)


class _Bones:
    """Bones as they are added."""

    def __init__(
        self, body: BodyModel, joints: np.ndarray, frames: np.ndarray, aimed: bool
    ) -> None:
        self.body, self.joints, self.frames, self.aimed = body, joints, frames, aimed
        self.own: dict[int, int] = {}
        self._rows: list[tuple[str, int, int, np.ndarray, np.ndarray]] = []

    def add(self, name: str, parent: int, carrier: int, place: np.ndarray, axes: np.ndarray) -> int:
        self._rows.append((name, parent, carrier, place, axes))
        return len(self._rows) - 1

    def towards(self, start: int, end: int, rig: Rig | None) -> int:
        """The bone that a joint hangs on: that of the joint above, or one between the two."""
        names = self.body.joint_names
        for each in rig.between if rig else ():
            if (each.start, each.end) == (names[start], names[end]):
                way = self.joints[end] - self.joints[start]
                place = self.joints[start] + each.fraction * way
                axes = _aimed(way / np.linalg.norm(way), names[start])
                axes = axes if self.aimed else self.frames[start]
                return self.add(each.name, self.own[start], start, place, axes)
        return self.own[start]

    def skeleton(self, turned: np.ndarray, tilted: np.ndarray) -> Skeleton:
        names, parents, carriers, places, rows = zip(*self._rows, strict=True)
        axes = [
            row if carrier < 0 else row @ tilted
            for row, carrier in zip(rows, carriers, strict=True)
        ]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise HabitusError(f"two bones would be called {twice}; choose another rig")
        rest = np.tile(np.eye(4), (len(names), 1, 1))
        rest[:, :3, :3], rest[:, :3, 3] = axes, places
        posed = posed_joints(self.body, self.joints, turned)
        for k, carrier in enumerate(carriers):
            if carrier >= 0:
                turn = turned[carrier]
                rest[k, :3, :3] = turn @ axes[k]
                rest[k, :3, 3] = posed[carrier] + turn @ (places[k] - self.joints[carrier])
        own = np.array([self.own[joint] for joint in range(len(self.joints))])
        return Skeleton(
            names, parents, carriers, own, np.array(places), np.array(axes), turned, rest
        )


def _turned(body: BodyModel, rig: Rig | None) -> Float[np.ndarray, "J 3 3"]:
    """How a rig's rest pose turns joints against the world: arms that hang."""
    local = np.zeros((body.num_joints, 3))
    for side, sign in zip(_SIDES, (-1.0, 1.0), strict=True):
        if rig and f"{side}_shoulder" in body.joint_names:
            joint = body.joint_names.index(f"{side}_shoulder")
            local[joint, 2] = sign * np.deg2rad(rig.arms_down)
    turns = Rotation.from_rotvec(local).as_matrix()
    for joint, parent in enumerate(body.parents):
        turns[joint] = turns[joint] if parent < 0 else turns[parent] @ turns[joint]
    return turns


def posed_joints(
    body: BodyModel, joints: Float[np.ndarray, "J 3"], turned: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "J 3"]:
    """Joints (m) where each is turned so against the world, and the root stays."""
    posed = joints.copy()
    for joint, parent in enumerate(body.parents):
        if parent >= 0:
            posed[joint] = posed[parent] + turned[parent] @ (joints[joint] - joints[parent])
    return posed


def in_bones(
    turns: Float[np.ndarray, "T J 4"],
    places: Float[np.ndarray, "T J 3"],
    joints: Float[np.ndarray, "J 3"],
    skeleton: Skeleton,
) -> tuple[Float[np.ndarray, "T N 4"], Float[np.ndarray, "T N 3"]]:
    """Quaternions (x, y, z, w) and places (m) of a body's joints against their parents, as those of
    a skeleton's bones.

    joints: where they rest at zero pose (m). A bone on the floor follows the root joint in x and z,
    and does not turn.
    """
    frames, count = len(turns), len(skeleton.names)
    quaternions, moved = np.empty((frames, count, 4)), np.empty((frames, count, 3))
    floor = places[:, 0] * np.array([1.0, 0.0, 1.0])
    for bone, (above, carrier) in enumerate(zip(skeleton.parents, skeleton.carriers, strict=True)):
        axes = skeleton.axes[above] if above >= 0 else np.eye(3)
        below = skeleton.axes[bone]
        if carrier == NO_JOINT:
            quaternions[:, bone], moved[:, bone] = Rotation.from_matrix(below).as_quat(), floor
        elif skeleton.own[carrier] != bone:
            quaternions[:, bone] = Rotation.from_matrix(axes.T @ below).as_quat()
            moved[:, bone] = (skeleton.places[bone] - skeleton.places[above]) @ axes
        else:
            start = np.zeros(3)
            if above >= 0 and skeleton.carriers[above] == NO_JOINT:
                start = floor
            elif above >= 0:
                start = skeleton.places[above] - joints[skeleton.carriers[above]]
            quaternions[:, bone] = _turns(turns[:, carrier], axes, below)
            moved[:, bone] = (places[:, carrier] - start) @ axes
    return quaternions, moved


def _turns(
    quaternions: Float[np.ndarray, "T 4"], axes: np.ndarray, below: np.ndarray
) -> Float[np.ndarray, "T 4"]:
    """A joint's turns between a bone's axes and those of its parent, without jumps of sign."""
    if np.array_equal(axes, np.eye(3)) and np.array_equal(below, np.eye(3)):
        return quaternions
    # Linear in the quaternion: the products of 1, i, j and k make those of all.
    products = Rotation.from_matrix(axes).inv() * Rotation.from_quat(np.eye(4))
    found = quaternions @ (products * Rotation.from_matrix(below)).as_quat()
    flips = np.sum(found[1:] * found[:-1], axis=-1) < 0
    found[1:] *= np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)[:, None]
    return found


def skin_turns(
    body: BodyModel,
    joints: Float[np.ndarray, "J 3"],
    turned: Float[np.ndarray, "J 3 3"],
) -> tuple[Float[np.ndarray, "V 3 3"], Float[np.ndarray, "V 3"]]:
    """What linear blend skinning does to each vertex where joints are turned so: x -> M x + t."""
    weights = body.skinning_weights
    moved = posed_joints(body, joints, turned) - np.einsum("jcd,jd->jc", turned, joints)
    return np.tensordot(weights, turned, 1), weights @ moved


def names_of(rig: Rig | None, joint_names: Sequence[str]) -> tuple[str, ...]:
    """Joints by a rig's names, for files of skeletons alone."""
    return tuple(rig.bones.get(name, name) if rig else name for name in joint_names)
