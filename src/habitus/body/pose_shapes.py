"""Which joints drive pose blend shapes: all but the root, as in SMPL, or some, such as those that
limbs twist about.
"""

import numpy as np
from jaxtyping import Float

from habitus.body.pose_features import PoseFeatures
from habitus.errors import HabitusError


def check_pose_shapes(
    posedirs: np.ndarray | None,
    features: PoseFeatures,
    joints: int,
    betas: int,
    shape_features: int,
    pose_joints: tuple[int, ...] | None = None,
) -> None:
    """HabitusError where pose blend shapes do not fit the joints and shape coefficients that drive
    them.
    """
    if not 0 <= shape_features <= betas:
        raise HabitusError(
            f"shape_features is {shape_features}; expected 0 to {betas} shape coefficients"
        )
    if pose_joints is not None and not (
        set(pose_joints) <= set(range(1, joints)) and _differ(pose_joints)
    ):
        raise HabitusError(
            f"pose_joints are {pose_joints}; expected different joints from 1 to {joints - 1}"
        )
    drivers = joints - 1 if pose_joints is None else len(pose_joints)
    count = features.count(1 + drivers, shape_features)
    if posedirs is not None and posedirs.shape[-1] != count:
        raise HabitusError(
            f"posedirs has {posedirs.shape[-1]} directions; expected {count}: {features.name!r} "
            f"of {drivers} "
            f"joints, with {shape_features} shape_features"
        )


def _differ(numbers: tuple[int, ...]) -> bool:
    return len(set(numbers)) == len(numbers)


def of_joints(
    posedirs: Float[np.ndarray, "N 3 F"],
    per_joint: int,
    drivers: tuple[int, ...],
    wanted: tuple[int, ...],
    shape_features: int = 0,
) -> Float[np.ndarray, "N 3 G"]:
    """The same pose blend shapes for other driving joints: zeros for joints that had none, left out
    for others' own.
    """
    if drivers == wanted:
        return posedirs
    blocks = posedirs.reshape(*posedirs.shape[:2], 1 + shape_features, len(drivers), per_joint)
    found = np.zeros((*blocks.shape[:3], len(wanted), per_joint), posedirs.dtype)
    both = [(wanted.index(joint), k) for k, joint in enumerate(drivers) if joint in wanted]
    if both:
        there, here = map(list, zip(*both, strict=True))
        found[..., there, :] = blocks[..., here, :]
    return found.reshape(*posedirs.shape[:2], -1)
