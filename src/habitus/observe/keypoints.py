"""Keypoints as points that ride on bones: where a detector's keypoints are on a body.

    q_k = W_b (o_k(betas) + d_k) + x_b(betas, pose) + trans

b is the bone of keypoint k (`habitus.body.keypoints.keypoint_place`), o_k its place in the bone's
rest frame, by the joints and landmarks that define it and a learned offset, and d_k what the
detector's own definition adds (m). A joint's keypoint rides on the bone above it: the elbow on the
upper arm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.keypoints import CONVENTIONS, keypoint_bone, keypoint_place
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.rotations import left_jacobian, matrix_from_rotvec


@dataclass(frozen=True, eq=False)
class KeypointRig:
    """A body's skeleton and K keypoints on it, all affine in the betas (m; rest pose).

    ``rest_joints`` (J, 3) and ``places`` (K, 3; from the joint of ``bone`` (K,)) at zero betas,
    ``joint_dirs`` and ``place_dirs`` how they change. ``definition`` (m): spread of people's and
    detectors' own places about these; ``noise``: of one detection, as a share of the person's
    height.
    """

    names: tuple[str, ...]
    parents: Int[np.ndarray, " J"]
    bone: Int[np.ndarray, " K"]
    definition: Float[np.ndarray, " K"]
    noise: Float[np.ndarray, " K"]
    rest_joints: Float[np.ndarray, "J 3"]
    joint_dirs: Float[np.ndarray, "J 3 B"]
    places: Float[np.ndarray, "K 3"]
    place_dirs: Float[np.ndarray, "K 3 B"]

    @staticmethod
    def of(body: BodyModel, names: Sequence[str], convention: str = "") -> "KeypointRig":
        """The keypoints of these names on a body, where the convention's detector puts them as far
        as that was learned. Raises HabitusError where the body has no such places.
        """
        regressor = np.asarray(body.joint_regressor, float)
        template = np.asarray(body.v_template, float)
        directions = np.asarray(body.shapedirs, float)
        joints = regressor @ template
        joint_dirs = (regressor @ directions.reshape(len(template), -1)).reshape(len(joints), 3, -1)
        number = {name: k for k, name in enumerate(body.joint_names)}
        places, place_dirs, bones = [], [], []
        table = [keypoint_place(name, convention) for name in names]
        for name, place in zip(names, table, strict=True):
            at, slope = [], []
            for part in place.parts:
                if part in number:
                    at.append(joints[number[part]])
                    slope.append(joint_dirs[number[part]])
                elif part in body.landmarks:
                    at.append(template[body.landmarks[part]])
                    slope.append(directions[body.landmarks[part]])
                else:
                    raise HabitusError(
                        f"{body.name} has neither a joint nor a landmark {part!r}, where "
                        f"{convention or 'the keypoints'} have {name}"
                    )
            bone = keypoint_bone(name, body.joint_names, body.parents)
            places.append(np.mean(at, axis=0) - joints[bone] + place.offset)
            place_dirs.append(np.mean(slope, axis=0) - joint_dirs[bone])
            bones.append(bone)
        return KeypointRig(
            tuple(names),
            np.array(body.parents, np.int64),
            np.array(bones, np.int64),
            np.array([place.definition for place in table]),
            np.array([place.noise for place in table]),
            joints,
            joint_dirs,
            np.array(places),
            np.array(place_dirs),
        )

    def shaped(
        self, betas: Float[np.ndarray, " B"], offsets: Float[np.ndarray, "K 3"]
    ) -> "ShapedKeypoints":
        """The rig of one person, with the detector's offsets."""
        count = len(betas)
        return ShapedKeypoints(
            self.parents,
            self.bone,
            self.rest_joints + self.joint_dirs[..., :count] @ betas,
            self.places + self.place_dirs[..., :count] @ betas + offsets,
        )

    def derivatives(
        self,
        betas: Float[np.ndarray, " B"],
        offsets: Float[np.ndarray, "K 3"],
        pose: Float[np.ndarray, "F J 3"],
        trans: Float[np.ndarray, "F 3"],
    ) -> "KeypointDerivatives":
        """Keypoints in F poses and their derivatives."""
        shaped = self.shaped(betas, offsets)
        frames, joints = pose.shape[:2]
        world, at = shaped.skeleton(pose, trans)
        above = np.concatenate([[0], np.maximum(self.parents[1:], 0)])
        axes = left_jacobian(pose).copy()
        axes[:, 1:] = world[:, above[1:]] @ axes[:, 1:]
        points = at[:, self.bone] + np.einsum("fkij,kj->fki", world[:, self.bone], shaped.places)
        descends = np.eye(joints, dtype=bool)
        for k, parent in enumerate(self.parents):
            if parent >= 0:
                descends[k] |= descends[parent]
        arm = points[:, :, None] - at[:, None]
        turned = np.cross(axes.transpose(0, 1, 3, 2)[:, None], arm[:, :, :, None, :])
        turned = turned * descends[self.bone][None, :, :, None, None]
        count = len(betas)
        bones = self.joint_dirs[..., :count].copy()
        bones[1:] -= self.joint_dirs[above[1:], :, :count]
        joint_motion = np.einsum("fjab,jbc->fjac", world[:, above], bones)
        joint_motion[:, 0] = bones[0]
        for k in range(1, joints):
            joint_motion[:, k] += joint_motion[:, self.parents[k]]
        by_betas = joint_motion[:, self.bone] + np.einsum(
            "fkab,kbc->fkac", world[:, self.bone], self.place_dirs[..., :count]
        )
        return KeypointDerivatives(
            points,
            turned.transpose(0, 1, 4, 2, 3).reshape(frames, len(self.bone), 3, -1),
            by_betas,
            world[:, self.bone],
        )


class KeypointDerivatives(NamedTuple):
    """Points (F, K, 3; m) and their derivatives by pose, betas, and offsets (or their bones'
    rotations).
    """

    points: Float[np.ndarray, "F K 3"]
    by_pose: Float[np.ndarray, "F K 3 N"]
    by_betas: Float[np.ndarray, "F K 3 B"]
    by_offsets: Float[np.ndarray, "F K 3 3"]


class ShapedKeypoints(NamedTuple):
    """The skeleton of one person at rest (m), and the keypoints in their bones' frames."""

    parents: Int[np.ndarray, " J"]
    bone: Int[np.ndarray, " K"]
    joints: Float[np.ndarray, "J 3"]
    places: Float[np.ndarray, "K 3"]

    def skeleton(
        self, pose: Float[np.ndarray, "F J 3"], trans: Float[np.ndarray, "F 3"]
    ) -> tuple[Float[np.ndarray, "F J 3 3"], Float[np.ndarray, "F J 3"]]:
        """World rotations and places of all joints."""
        world = matrix_from_rotvec(pose).copy()
        at = np.empty_like(pose)
        at[:, 0] = self.joints[0] + trans
        for k in range(1, len(self.parents)):
            parent = self.parents[k]
            at[:, k] = at[:, parent] + world[:, parent] @ (self.joints[k] - self.joints[parent])
            world[:, k] = world[:, parent] @ world[:, k]
        return world, at

    def points(
        self, pose: Float[np.ndarray, "F J 3"], trans: Float[np.ndarray, "F 3"]
    ) -> Float[np.ndarray, "F K 3"]:
        """Keypoints (m) in F poses."""
        world, at = self.skeleton(pose, trans)
        return at[:, self.bone] + np.einsum("fkij,kj->fki", world[:, self.bone], self.places)


def convention_names(convention: str) -> tuple[str, ...]:
    """The keypoints of a convention. Raises HabitusError for an unknown one."""
    if convention not in CONVENTIONS:
        raise HabitusError(f"keypoints {convention!r}; expected one of {', '.join(CONVENTIONS)}")
    return CONVENTIONS[convention]
