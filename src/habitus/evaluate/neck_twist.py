"""The twist of the neck, on which raw joint angles fail as features of pose blend shapes (T 5.6,
Fig. 5-16).

Blend skinning shrinks a neck that is turned, to either side. Pose blend shapes that are linear in
an angle can only thicken it on one side and thin it on the other; entries of rotation matrices can
thicken it on both. Measured is the neck's girth: how far its vertices are from the axis on which
the head turns, against the angle.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.body.skinning import descends
from habitus.errors import HabitusError

ANGLES = tuple(range(-90, 91, 10))
"""Head rotations (degrees); positive is to the body's left."""
_SHARED = 0.1  # vertices of the neck go along with a turning joint by this share to 1 minus it


@dataclass(frozen=True, eq=False)
class NeckTwist:
    """A body's neck while its head turns.

    ``girth`` is the mean distance of the neck's vertices from the axis relative to that at rest,
    ``radius`` (m). ``angles`` are in degrees.
    """

    model: str
    joints: tuple[str, ...]
    angles: tuple[int, ...]
    radius: float
    girth: Float[np.ndarray, " A"]

    @property
    def asymmetry(self) -> float:
        """Mean difference of girth between turns to the left and to the right by the same angle."""
        pairs = [
            (k, self.angles.index(-a))
            for k, a in enumerate(self.angles)
            if a > 0 and -a in self.angles
        ]
        return (
            float(np.mean([abs(self.girth[k] - self.girth[other]) for k, other in pairs]))
            if pairs
            else 0.0
        )

    @property
    def shrink(self) -> float:
        """Share of its girth that the neck loses at the widest turns, mean of both sides; negative
        where it gains.
        """
        widest = max(map(abs, self.angles))
        return float(
            1
            - np.mean([g for a, g in zip(self.angles, self.girth, strict=True) if abs(a) == widest])
        )


def twist_joints(joint_names: Sequence[str], parents: Sequence[int]) -> tuple[int, ...]:
    """The joints that turn a head: all of the neck and the head on it, or whichever there is; none
    without either.
    """
    words = [name.lower() for name in joint_names]
    for part in ("neck", "head"):
        joints = [k for k, word in enumerate(words) if part in word and parents[k] >= 0]
        if joints:
            heads = [
                k for k, word in enumerate(words) if "head" in word and parents[k] == joints[-1]
            ]
            return (*joints, *heads[:1])
    return ()


def neck_twist(
    bodies: Sequence[BodyModel], angles: Sequence[int] = ANGLES
) -> tuple[NeckTwist, ...]:
    """Turn the mean person's head by each of ``angles`` (degrees), in equal parts at each of
    `twist_joints`.

    Bodies of one topology are measured on the same vertices: those that, on average over the
    bodies, go along with a turning joint in part. Raises HabitusError for bodies that differ in
    topology or have no neck.
    """
    if not bodies:
        return ()
    if len({body.num_vertices for body in bodies}) > 1:
        raise HabitusError(
            f"bodies have {', '.join(str(b.num_vertices) for b in bodies)} vertices; expected as "
            "many"
        )
    joints = [_joints(body) for body in bodies]
    vertices = neck_vertices(bodies)
    return tuple(
        _measured(body, turned, vertices, tuple(angles))
        for body, turned in zip(bodies, joints, strict=True)
    )


def neck_vertices(bodies: Sequence[BodyModel]) -> Int[np.ndarray, " n"]:
    """Vertices that a turn of the head carries along in part: where a twist can thin the
    surface.
    """
    shares = np.mean([_shares(body, _joints(body)) for body in bodies], axis=0)
    return np.flatnonzero(((shares > _SHARED) & (shares < 1 - _SHARED)).any(1))


def twist_pose(body: BodyModel, angle: float) -> Float[np.ndarray, "J 3"]:
    """The rest pose with the head turned by ``angle`` (degrees): rotation vectors (rad)."""
    joints = _joints(body)
    pose = np.zeros((body.num_joints, 3))
    pose[list(joints)] = np.radians(angle) / len(joints) * _axis(body, joints)[1]
    return pose


def turned_head(
    body: BodyModel, angle: float, vertices: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " n"]]:
    """The mean person's surface (m) with the head turned (degrees), and how much further from the
    axis ``vertices`` are than at rest, as a share of that distance: for pictures.
    """
    axis = _axis(body, _joints(body))
    poses = np.stack([twist_pose(body, 0), twist_pose(body, angle)])
    surfaces = body(pose=poses).vertices
    rest, turned = _distances(surfaces[:, vertices], *axis)
    return surfaces[1], turned / rest - 1


def twist_axis(body: BodyModel) -> Float[np.ndarray, " 3"]:
    """The unit direction of the axis that a head turns about, from the body to the head."""
    return _axis(body, _joints(body))[1]


def head_and_neck(body: BodyModel) -> Int[np.ndarray, " n"]:
    """Vertices that a turn of the head carries along."""
    return np.flatnonzero(_shares(body, _joints(body))[:, 0] > _SHARED)


def _measured(
    body: BodyModel,
    joints: tuple[int, ...],
    vertices: Int[np.ndarray, " n"],
    angles: tuple[int, ...],
) -> NeckTwist:
    through, along = _axis(body, joints)
    poses = np.stack([twist_pose(body, angle) for angle in (0, *angles)])
    surfaces = body(pose=poses, vertices=vertices).vertices
    radii = _distances(surfaces, through, along).mean(1)
    names = tuple(body.joint_names[k] for k in joints)
    return NeckTwist(body.name, names, angles, float(radii[0]), radii[1:] / radii[0])


def _distances(
    points: Float[np.ndarray, "*batch 3"],
    through: Float[np.ndarray, " 3"],
    along: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "*batch"]:
    away = points - through
    return np.linalg.norm(away - (away @ along)[..., None] * along, axis=-1)


def _axis(
    body: BodyModel, joints: tuple[int, ...]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """A point (m) and the unit direction of the axis: from the first turning joint to the last, or
    to what it carries.

    It points up, so that positive angles are turns to the left.
    """
    start = body.joint_template[joints[0]]
    end = (
        body.joint_template[joints[-1]]
        if len(joints) > 1
        else body.v_template[_shares(body, joints)[:, 0] > 0.5].mean(0)
    )
    along = end - start
    return start, along / np.linalg.norm(along)


def _shares(body: BodyModel, joints: tuple[int, ...]) -> Float[np.ndarray, "V j"]:
    """Share of each joint's rotation that each vertex follows: its weights of the joint and all
    below it.
    """
    return (body.skinning_weights @ descends(body.parents).T)[:, list(joints)]


def _joints(body: BodyModel) -> tuple[int, ...]:
    joints = twist_joints(body.joint_names, body.parents)
    if not joints:
        raise HabitusError(
            f"{body.name} has no joint called neck or head; its joints: "
            f"{', '.join(body.joint_names)}"
        )
    return joints
