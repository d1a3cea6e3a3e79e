"""An animation on the bones of a rig: names, hierarchy, axes, rest pose; the surface stays."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.export.animation import Animation, Track
from habitus.export.rigs import Rig, rig_named
from habitus.export.skeleton import Skeleton, in_bones, posed_joints, skeleton_of, skin_turns

_LOOSE = 0.5
"""Degrees."""
_CHECKED = 64
"""Frames in which a new rest pose is compared with the old one."""


@dataclass(frozen=True)
class Bones:
    """How a file's bones are made. ``rig``: a name of `habitus.export.rigs.RIGS`, or none for the
    body's own joints; ``axes``: "along" limbs, or turned like the "world" at rest; ``root_bone``:
    with one on the floor, which the pelvis hangs on.
    """

    rig: str | None = None
    axes: str = "along"
    root_bone: bool = False

    @property
    def table(self) -> Rig | None:
        """The rig's table. Raises HabitusError for a name without one."""
        return None if self.rig is None else rig_named(self.rig)


def rigged(animation: Animation, bones: Bones, *, loose: bool = False) -> Animation:
    """The animation on a rig's bones. Raises HabitusError for other names and axes.

    Named rigs, and those with a bone on the floor, rest with the soles at y = 0. Bones in other
    axes show the same surface. A rest pose with hanging arms binds the skin anew: exact where one
    joint carries a vertex, and what it moves others by is added to ``morph_worst`` and
    ``morph_elsewhere``. loose: bones miss those below by `_LOOSE` where joints move: importers of
    FBX connect bones that touch, and then leave out how the lower one moves.
    """
    rig = bones.table
    joints, vertices = animation.rest_joints, animation.rest_vertices
    if rig or bones.root_bone:
        lift = np.array([0.0, -vertices[:, 1].min(), 0.0])
        joints, vertices = joints + lift, vertices + lift
    tilt = _LOOSE if loose and _joints_move(animation) else 0.0
    how = rig, bones.axes, bones.root_bone, tilt
    skeleton = skeleton_of(animation.body, joints, vertices, *how)
    moved = tuple(_on(track, joints, skeleton) for track in animation.tracks)
    result = replace(
        animation, rest_vertices=vertices, rest_joints=joints, tracks=moved, skeleton=skeleton
    )
    if np.array_equal(skeleton.turned, np.tile(np.eye(3), (len(joints), 1, 1))):
        return result
    turns, offsets = skin_turns(animation.body, joints, skeleton.turned)
    posed = np.einsum("vcd,vd->vc", turns, vertices) + offsets
    away = _away(animation, skeleton.turned, joints, vertices, posed)
    return replace(
        result,
        rest_vertices=posed,
        rest_joints=skeleton.rest[skeleton.own, :3, 3],
        morphs=np.einsum("vcd,kvd->kvc", turns, animation.morphs),
        morph_worst=animation.morph_worst + away,
        morph_elsewhere=animation.morph_elsewhere and animation.morph_elsewhere + away,
    )


def _joints_move(animation: Animation) -> bool:
    """Whether soft tissue moves joints against those above them."""
    moved = (np.ptp(track.joint_translations[:, 1:], axis=0) for track in animation.tracks)
    return any(each.max(initial=0.0) > 1e-7 for each in moved)


def _on(track: Track, joints: Float[np.ndarray, "J 3"], skeleton: Skeleton) -> Track:
    turns, places = in_bones(track.quaternions, track.joint_translations, joints, skeleton)
    return replace(track, quaternions=turns, joint_translations=places)


def _away(
    animation: Animation,
    turned: Float[np.ndarray, "J 3 3"],
    joints: Float[np.ndarray, "J 3"],
    vertices: Float[np.ndarray, "V 3"],
    posed: Float[np.ndarray, "V 3"],
) -> float:
    """The largest distance (m) of a vertex that binds to a rest pose from where it was bound to the
    zero pose, without blend shapes, in frames of the first track.
    """
    weights, parents = animation.body.skinning_weights, animation.body.parents
    moved = posed_joints(animation.body, joints, turned)
    quaternions = animation.tracks[0].quaternions
    frames = np.unique(np.linspace(0, len(quaternions) - 1, _CHECKED).astype(int))
    largest = 0.0
    for frame in frames:
        turns = Rotation.from_quat(quaternions[frame]).as_matrix()
        for joint, parent in enumerate(parents):
            turns[joint] = turns[joint] if parent < 0 else turns[parent] @ turns[joint]
        anew = turns @ turned.transpose(0, 2, 1)
        gap = np.einsum("vcd,vd->vc", np.tensordot(weights, turns, 1), vertices)
        gap -= np.einsum("vcd,vd->vc", np.tensordot(weights, anew, 1), posed)
        gap -= weights @ np.einsum("jcd,jd->jc", turns, joints)
        gap += weights @ np.einsum("jcd,jd->jc", anew, moved)
        largest = max(largest, float(np.linalg.norm(gap, axis=1).max()))
    return largest
