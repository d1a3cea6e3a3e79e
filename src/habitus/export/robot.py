"""A robot's motion as files that programs for robots read."""

import pickle
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.errors import HabitusError, shown
from habitus.export.animation import continuous_quaternions
from habitus.files import atomic_write
from habitus.fit.retarget.robots import RobotMotion
from habitus.gait.dynamics import angular_velocity
from habitus.types import PathLike

ENDINGS = (".npz", ".csv", ".pkl")
STYLES = ("habitus", "loco-mujoco", "isaac-lab")
"""Forms of an npz."""
FREE, HINGE = 0, 3
"""MuJoCo's numbers of kinds of joints."""


def check_robot_path(path: PathLike) -> Path:
    """The path, where its ending is known. Raises HabitusError for another."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise HabitusError(
            f"{shown(path)}: a robot's motion is written as {', '.join(ENDINGS)}; choose one"
        )
    return Path(path)


def write_robot(motion: RobotMotion, path: PathLike, style: str = "habitus") -> None:
    """Write a motion atomically, in the form that the path's ending names.

    .npz in ``style`` "habitus": ``fps``, ``joint_names`` (n), ``root_pos`` (T, 3; m),
    ``root_rot`` (T, 4; x, y, z, w), ``dof_pos`` (T, n; rad), ``dof_vel`` (T, n; rad/s),
    ``body_names`` (L), ``body_pos`` (T, L, 3), ``body_rot`` (T, L, 4; x, y, z, w). "loco-mujoco":
    LocoMuJoCo's trajectory (qpos with w, x, y, z; qvel with the angular velocity in the root's
    frame). "isaac-lab": Isaac Lab's AMP motion files (quaternions w, x, y, z).
    .csv: a row a frame without a head, as BeyondMimic and the LAFAN1 retargeting set have them:
    root place, quaternion x, y, z, w, then joints in the order of the robot's file.
    .pkl: GMR's dictionary (root_rot x, y, z, w). Raises HabitusError.
    """
    target = check_robot_path(path)
    if style not in STYLES:
        raise HabitusError(f"style {shown(style)}; expected one of {', '.join(STYLES)}")
    ending = target.suffix.lower()
    if ending == ".csv":
        rows = np.column_stack([motion.root, _quaternions(motion.turn), motion.angles])
        with atomic_write(target) as temporary:
            np.savetxt(temporary, rows, fmt="%.6f", delimiter=",")
        return
    if ending == ".pkl":
        with atomic_write(target) as temporary:
            temporary.write_bytes(pickle.dumps(_gmr(motion)))
        return
    arrays = {"habitus": _own, "loco-mujoco": _loco_mujoco, "isaac-lab": _isaac_lab}[style](motion)
    with atomic_write(target) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _quaternions(turns: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Quaternions x, y, z, w that change their signs nowhere along time."""
    out = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat()
    return continuous_quaternions(out.reshape(*turns.shape[:-2], 4))


def _velocities(values: Float[np.ndarray, "T *n"], rate: float) -> Float[np.ndarray, "T *n"]:
    return np.gradient(values, axis=0) * rate if len(values) > 1 else np.zeros_like(values)


def _gmr(motion: RobotMotion) -> dict:
    return {
        "fps": float(motion.rate_hz),
        "root_pos": motion.root,
        "root_rot": _quaternions(motion.turn),
        "dof_pos": motion.angles,
        "local_body_pos": None,
        "link_body_list": None,
    }


def _own(motion: RobotMotion) -> dict[str, np.ndarray]:
    links = motion.links()
    return {
        "robot": np.array(motion.robot.name),
        "fps": np.array(motion.rate_hz),
        "joint_names": np.array(motion.robot.joint_names),
        "root_pos": motion.root,
        "root_rot": _quaternions(motion.turn),
        "dof_pos": motion.angles,
        "dof_vel": _velocities(motion.angles, motion.rate_hz),
        "body_names": np.array(motion.robot.link_names),
        "body_pos": links.origins,
        "body_rot": _quaternions(links.rotations),
    }


def _loco_mujoco(motion: RobotMotion) -> dict[str, np.ndarray]:
    rate = motion.rate_hz
    spin = angular_velocity(motion.turn[:, None], rate)[:, 0]
    local = (np.swapaxes(motion.turn, -1, -2) @ spin[..., None])[..., 0]
    count = motion.robot.num_joints
    return {
        "joint_names": np.array(["root", *motion.robot.joint_names]),
        "frequency": np.array(float(rate)),
        "njnt": np.array(count + 1),
        "jnt_type": np.array([FREE, *[HINGE] * count]),
        "qpos": np.column_stack([motion.root, _wxyz(motion.turn), motion.angles]),
        "qvel": np.column_stack(
            [_velocities(motion.root, rate), local, _velocities(motion.angles, rate)]
        ),
        "split_points": np.array([0, motion.num_frames]),
    }


def _isaac_lab(motion: RobotMotion) -> dict[str, np.ndarray]:
    rate = motion.rate_hz
    links = motion.links()
    single = np.float32
    return {
        "fps": np.array(round(rate)),
        "dof_names": np.array(motion.robot.joint_names),
        "body_names": np.array(motion.robot.link_names),
        "dof_positions": motion.angles.astype(single),
        "dof_velocities": _velocities(motion.angles, rate).astype(single),
        "body_positions": links.origins.astype(single),
        "body_rotations": _wxyz(links.rotations).astype(single),
        "body_linear_velocities": _velocities(links.origins, rate).astype(single),
        "body_angular_velocities": angular_velocity(links.rotations, rate).astype(single),
    }


def _wxyz(turns: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    return np.roll(_quaternions(turns), 1, axis=-1)
