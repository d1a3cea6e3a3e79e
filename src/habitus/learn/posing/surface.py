"""Posing as training sees it: given pose, W and P, a posed surface is linear in the rest surface and the rest joints.

With either skinning, vertex v stands at ``turn_v (t_v + P_v f) + sum_k carry_vk (L_k J) + trans``: ``turn`` blends the
joints' rotations, ``L_k J = p_k - R_k J_k`` is where joint k puts the origin, linear in the rest joints J, and
``carry`` is the weight ``w_vk`` in linear blend skinning. In dual quaternion skinning the dual part is linear in the
translations as well, so that ``carry`` is a matrix (Kavan et al. 2008). Hence the rest surface, the joints and the pose
blend shapes are linear least squares each; S 4.1 descends on them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.arrays import flatten
from habitus.body.pose_features import POSE_FEATURES
from habitus.learn.posing.kernels import carry_by_quaternions, move_along, spread_carry
from habitus.learn.posing.rig import Person, Rig
from habitus.rotations import matrix_from_rotvec, quaternion_from_matrix


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Rotations relative to the parent and in the world, and the maps L_k from rest joints to motions' translations."""

    local: Float[np.ndarray, "J 3 3"]
    world: Float[np.ndarray, "J 3 3"]
    above: Float[np.ndarray, "J 3 3"]
    maps: Float[np.ndarray, "J 3 C"]

    def places(self, joints: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
        """Where the joints stand (m)."""
        return self.shifts(joints) + (self.world @ joints[..., None])[..., 0]

    def shifts(self, joints: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "J 3"]:
        """p_k - R_k J_k: the translations of the motions that carry rest vertices along (m)."""
        return self.maps @ joints.ravel()


@dataclass(frozen=True, eq=False)
class Posed:
    """A pose applied to a rig: everything that the posed surface is linear in."""

    rig: Rig
    skeleton: Skeleton
    turn: Float[np.ndarray, "V 3 3"]
    carry: Float[np.ndarray, "V K 3 3"]

    def vertices(self, rest: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "V 3"]:
        """The surface (m) without ``trans``; ``rest`` holds the pose blend shapes already."""
        return move_along(self.turn, rest, self.carry, self.rig.index, self.skeleton.shifts(joints))

    def by_joints(self) -> Float[np.ndarray, "V 3 C"]:
        """Derivative of the surface by the rest joints, C = 3 J."""
        return spread_carry(self.carry, self.rig.index, self.skeleton.maps)


def skeleton(parents: tuple[int, ...], pose: Float[np.ndarray, "J 3"]) -> Skeleton:
    """The rotations (S 3, eq. 4) of a pose (rotation vectors, rad) and the joints' part in them."""
    local = matrix_from_rotvec(np.asarray(pose, dtype=np.float64))
    count = len(parents)
    unit = np.eye(3 * count).reshape(count, 3, 3 * count)
    world, above, places = np.empty_like(local), np.empty_like(local), np.empty((count, 3, 3 * count))
    world[0], above[0], places[0] = local[0], np.eye(3), unit[0]
    for joint, parent in enumerate(parents[1:], 1):
        above[joint] = world[parent]
        world[joint] = world[parent] @ local[joint]
        places[joint] = places[parent] + world[parent] @ (unit[joint] - unit[parent])
    return Skeleton(local, world, above, places - world @ unit)


def posed(rig: Rig, pose: Float[np.ndarray, "J 3"]) -> Posed:
    """Apply a pose (rotation vectors, rad) to a rig."""
    bones = skeleton(rig.parents, pose)
    return Posed(rig, bones, *SKINNING[rig.skinning](rig, bones))


def pose_feature(rig: Rig, pose: Float[np.ndarray, "*batch J 3"]) -> Float[np.ndarray, "*batch G"]:
    """What pose blend shapes are linear in, of all joints but the root; for everybody alike."""
    value = POSE_FEATURES[rig.pose_features].value(np.asarray(pose, dtype=np.float64))
    return flatten(value[..., 1:, :], -2)


def rest_surface(rig: Rig, person: Person, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "V 3"]:
    """The person's rest surface with the pose blend shapes of this pose (m)."""
    posedirs = rig.posedirs_for(person.descriptor)
    return person.template if posedirs is None else person.template + posedirs @ pose_feature(rig, pose)


def surface(rig: Rig, person: Person, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "V 3"]:
    """The person in a pose (m), without ``trans``."""
    return posed(rig, pose).vertices(rest_surface(rig, person, pose), person.joints)


def _linear(rig: Rig, bones: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    turn = (rig.weights @ bones.world.reshape(-1, 9)).reshape(-1, 3, 3)
    return turn, rig.value[..., None, None] * np.eye(3)


def _dual_quaternion(rig: Rig, bones: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    quaternions = world_quaternions(bones)
    return carry_by_quaternions(rig.index, signed_value(rig, quaternions), quaternions)


def world_quaternions(bones: Skeleton) -> Float[np.ndarray, "J 4"]:
    """The joints' rotations in the world as unit quaternions."""
    return quaternion_from_matrix(bones.world)


def signed_value(rig: Rig, quaternions: Float[np.ndarray, "J 4"]) -> Float[np.ndarray, "V K"]:
    """Weights with the sign that turns each joint's quaternion to the side of the vertex' strongest joint's."""
    sides = np.where(quaternions @ quaternions.T < 0, -1.0, 1.0)
    return rig.value * sides[rig.index, rig.strongest[:, None]]


SKINNING = {"lbs": _linear, "dqbs": _dual_quaternion}
