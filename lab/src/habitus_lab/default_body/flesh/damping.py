"""Damp a body's learned pose blend shapes where the trainer had no poses, and make them symmetric.

    python -m habitus_lab.default_body.flesh.damping [female male neutral] [--bodies FOLDER]

The formula is `habitus.learn.posing.rotation_prior`'s. The poses are those of the simulation
(`poses.py`, with their mirror images), without the motions of captures, a tenth of all. A file is
damped once: its description says so. Models that `habitus train` learned with the prior need it
not.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from habitus.body.pose_features import POSE_FEATURES
from habitus.errors import HabitusError
from habitus.learn.posing.rotation_prior import damped, rotation_gram
from habitus_lab.default_body.asset import DAMPED, DESCRIPTION, VERSION, write_asset
from habitus_lab.default_body.flesh.poses import SEXES, mirrored_pose, rounds_of_sessions
from habitus_lab.default_body.rig import JOINT_MIRROR, JOINTS
from habitus_lab.repository import BODIES

MU = 0.003  # simulated poses change by .5 mm RMS, twisted elbows from 64 to 6 mm; .01: 1.0 and 6, and acromia sink
PEOPLE = 20  # of each sex that were simulated
FLIP = np.array([-1.0, 1.0, 1.0])
FEATURES = POSE_FEATURES["rotations"]


def trained_poses(space: str, seed: int = 0) -> np.ndarray:
    """(N, 55, 3) rad: the poses that a space's people were simulated in, and their mirror
    images.
    """
    sexes = SEXES if space == "neutral" else (space,)
    poses = np.concatenate(
        [
            session.poses
            for sex in sexes
            for person in range(PEOPLE)
            for sessions in rounds_of_sessions(seed, person, sex, JOINTS)
            for session in sessions
        ]
    )
    return np.concatenate([poses, mirrored_pose(poses, JOINTS)])


def damped_arrays(arrays: dict[str, np.ndarray], space: str, weight: float = MU) -> dict:
    """A body's arrays with damped, symmetric pose blend shapes.

    Raises HabitusError for arrays that are damped already.
    """
    if DAMPED in str(arrays["description"]):
        raise HabitusError(f"{space}: its pose blend shapes are damped already; expected others")
    joints = arrays["posedirs_joints"]
    features = FEATURES.value(trained_poses(space))[:, joints]
    grams = np.einsum("ndi,ndj->dij", features, features) / len(features)
    posedirs = damped(arrays["posedirs"].astype(float), grams, rotation_gram(FEATURES), weight)
    posedirs = symmetric(posedirs, joints, arrays["mirror"])
    words = DESCRIPTION.format(space=space, pose=DAMPED)
    return arrays | {
        "posedirs": posedirs.astype(np.float16),
        "description": np.array(words),
        "version": np.array(VERSION),
    }


def symmetric(posedirs: np.ndarray, joints: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The mean of pose blend shapes (V, 3, 9 D) and their mirror image: a vertex of the midline
    stays on it in symmetric poses.
    """
    partner = [list(joints).index(JOINT_MIRROR[joint]) for joint in joints]
    blocks = posedirs.reshape(*posedirs.shape[:2], len(joints), 9)
    image = blocks[mirror][:, :, partner] * FLIP[:, None, None] * np.outer(FLIP, FLIP).ravel()
    return ((blocks + image) / 2).reshape(posedirs.shape)


def main() -> None:
    """Rewrite the files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("spaces", nargs="*", default=["female", "male", "neutral"])
    parser.add_argument("--bodies", type=Path, default=BODIES)
    options = parser.parse_args()
    for space in options.spaces:
        path = options.bodies / f"{space}.npz"
        with np.load(path) as own:
            arrays = dict(own)
        write_asset(damped_arrays(arrays, space), path)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
