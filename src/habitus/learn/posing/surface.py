"""Posing in training: given pose, W and P, a posed surface is linear in the rest surface and the
rest joints.

With either skinning, vertex v stands at ``turn_v (t_v + P_v f) + sum_k B_vk (L_k J) + trans``:
``turn`` blends the joints' rotations, ``L_k J = p_k - R_k J_k`` is the translation of joint k's
motion, linear in the rest joints J, and ``translation_blend`` B_vk is the weight ``w_vk`` in linear
blend skinning. In dual quaternion skinning the dual part is linear in the translations as well, so
that B_vk is a 3x3 matrix (Kavan et al. 2008). Hence the rest surface, the joints and the pose blend
shapes are linear least squares each; S 4.1 descends on them.

`pose_normalized` inverts it (S 4.2): the rest surface that, posed, is a registration.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_array

from habitus.arrays import flatten
from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.posing.kernels import apply_blends, dual_quaternion_blends, translation_jacobian
from habitus.learn.posing.rig import RestPerson, Rig
from habitus.mesh.laplacian import fill_holes
from habitus.rotations import matrix_from_rotvec, quaternion_from_matrix


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Rotations relative to the parent and in the world, and the maps L_k from rest joints to
    motions' translations.
    """

    local: Float[np.ndarray, "J 3 3"]
    world: Float[np.ndarray, "J 3 3"]
    above: Float[np.ndarray, "J 3 3"]
    maps: Float[np.ndarray, "J 3 C"]

    def positions(self, joints: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
        """Posed joint positions (m), without ``trans``."""
        return self.translations(joints) + (self.world @ joints[..., None])[..., 0]

    def translations(self, joints: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
        """p_k - R_k J_k: the translations of the motions that translation_blend rest vertices along
        (m).
        """
        return self.maps @ joints.ravel()


@dataclass(frozen=True, eq=False)
class Posed:
    """A pose applied to a rig: the linear map from rest surface and rest joints to the posed
    surface.
    """

    rig: Rig
    skeleton: Skeleton
    turn: Float[np.ndarray, "V 3 3"]
    translation_blend: Float[np.ndarray, "V K 3 3"]

    def vertices(
        self, rest: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> Float[np.ndarray, "V 3"]:
        """The surface (m) without ``trans``; ``rest`` holds the pose blend shapes already."""
        return apply_blends(
            self.turn,
            rest,
            self.translation_blend,
            self.rig.index,
            self.skeleton.translations(joints),
        )

    def joint_jacobian(self) -> Float[np.ndarray, "V 3 C"]:
        """Derivative of the surface by the rest joints, C = 3 J."""
        return translation_jacobian(self.translation_blend, self.rig.index, self.skeleton.maps)


def skeleton(parents: tuple[int, ...], pose: Float[np.ndarray, "J 3"]) -> Skeleton:
    """The rotations (S 3, eq. 4) of a pose (rotation vectors, rad) and the joints' part in them."""
    local = matrix_from_rotvec(np.asarray(pose, dtype=np.float64))
    count = len(parents)
    unit = np.eye(3 * count).reshape(count, 3, 3 * count)
    world = np.empty_like(local)
    above = np.empty_like(local)
    positions = np.empty((count, 3, 3 * count))
    world[0], above[0], positions[0] = local[0], np.eye(3), unit[0]
    for joint, parent in enumerate(parents[1:], 1):
        above[joint] = world[parent]
        world[joint] = world[parent] @ local[joint]
        positions[joint] = positions[parent] + world[parent] @ (unit[joint] - unit[parent])
    return Skeleton(local, world, above, positions - world @ unit)


def posed(rig: Rig, pose: Float[np.ndarray, "J 3"]) -> Posed:
    """Apply a pose (rotation vectors, rad) to a rig."""
    bones = skeleton(rig.parents, pose)
    return Posed(rig, bones, *SKINNING[rig.skinning](rig, bones))


def pose_feature(rig: Rig, pose: Float[np.ndarray, "*batch J 3"]) -> Float[np.ndarray, "*batch G"]:
    """Pose features of all joints but the root, before they are multiplied with shape features."""
    value = POSE_FEATURES[rig.pose_features].value(np.asarray(pose, dtype=np.float64))
    return flatten(value[..., 1:, :], -2)


def rest_surface(
    rig: Rig, person: RestPerson, pose: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "V 3"]:
    """The person's rest surface with the pose blend shapes of this pose (m)."""
    posedirs = rig.posedirs_for(person.descriptor)
    return (
        person.template
        if posedirs is None
        else person.template + posedirs @ pose_feature(rig, pose)
    )


def surface(
    rig: Rig, person: RestPerson, pose: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "V 3"]:
    """The person in a pose (m), without ``trans``."""
    return posed(rig, pose).vertices(rest_surface(rig, person, pose), person.joints)


def _linear(rig: Rig, bones: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    turn = (rig.weights @ bones.world.reshape(-1, 9)).reshape(-1, 3, 3)
    return turn, rig.value[..., None, None] * np.eye(3)


def _dual_quaternion(rig: Rig, bones: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    quaternions = world_quaternions(bones)
    return dual_quaternion_blends(rig.index, signed_value(rig, quaternions), quaternions)


def world_quaternions(bones: Skeleton) -> Float[np.ndarray, "J 4"]:
    """The joints' rotations in the world as unit quaternions."""
    return quaternion_from_matrix(bones.world)


def signed_value(rig: Rig, quaternions: Float[np.ndarray, "J 4"]) -> Float[np.ndarray, "V K"]:
    """Weights with the sign that turns each joint's quaternion to the side of the vertex' strongest
    joint's.
    """
    sides = np.where(quaternions @ quaternions.T < 0, -1.0, 1.0)
    return rig.value * sides[rig.index, rig.strongest[:, None]]


SKINNING = {"lbs": _linear, "dqbs": _dual_quaternion}


_HOLD = 1e-6  # keeps what a pose squeezes flat at the general person's


def pose_normalized(
    rig: Rig,
    regressor: Float[np.ndarray, "J V"],
    general: RestPerson,
    pose: Float[np.ndarray, "J 3"],
    target: Float[np.ndarray, "V 3"],
    seen: Bool[np.ndarray, " V"] | None = None,
    laplacian: csr_array | None = None,
) -> Float[np.ndarray, "V 3"]:
    """The rest surface T (m) with W(T + B(pose), J T, pose) = target: as many equations as
    unknowns.

    Joints are regressed from T, so that vertex by vertex ``T = A^-1 (r - C j)``: 3 J equations for
    j = J T are left. The surface is placed so that its root joint is the ``general`` person's.
    Where not all vertices are ``seen``, what the surface differs by from the general person's is
    carried on into the holes (`fill_holes`, of the mesh's graph ``laplacian``): the others are
    solved for as before.
    """
    applied = posed(rig, pose)
    turn = applied.turn
    joint_jacobian = applied.joint_jacobian()
    posedirs = rig.posedirs_for(general.descriptor)
    offset = np.zeros_like(target) if posedirs is None else posedirs @ pose_feature(rig, pose)
    away = target - applied.vertices(general.template + offset, general.joints)
    target = target - (away if seen is None else away[seen]).mean(0)
    right = target - (turn @ (general.template + offset)[..., None])[..., 0]
    back = np.linalg.solve(
        turn.transpose(0, 2, 1) @ turn + _HOLD * np.eye(3), turn.transpose(0, 2, 1)
    )
    own = (back @ right[..., None])[..., 0]
    shared = back @ joint_jacobian
    if seen is not None and laplacian is not None:
        own, shared = (fill_holes(laplacian, seen, each) for each in (own, shared))
    columns = joint_jacobian.shape[-1]
    matrix = np.eye(columns) + np.tensordot(regressor, shared, 1).reshape(columns, columns)
    joints = np.linalg.solve(matrix, (regressor @ (general.template + own)).ravel())
    surface = general.template + own - shared @ joints
    return surface + (general.joints[0] - regressor[0] @ surface)
