"""A person as a program holds it after an import: bones with axes of their own, in a space turned
or mirrored.
"""

import json
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from hinged_body import with_hinges
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.export.animation import animate, one_sided
from habitus.export.driven import drivers

UNITY = np.diag([-1.0, 1.0, 1.0])
"""From the body's axes to those of a mesh that Unity imported."""
SIDES = ("left", "right")
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(eq=False)
class Exported:
    """The default body at random betas as a file of so many blend shapes has it, and poses (T, J,
    3) it never took; ``folds``: with made-up folds, and knees bent deep.
    """

    correctives: str
    folds: bool = False

    def __post_init__(self):
        rng = np.random.default_rng(8)
        self.body = hb.load_body("default")
        if self.folds:
            self.body = replace(with_hinges(self.body), finer=None)
        self.betas = rng.normal(size=self.body.num_betas)
        joints = self.body.num_joints
        still = BodyMotion(self.body, self.betas, np.zeros((2, joints, 3)), np.zeros((2, 3)), 30.0)
        self.animation = one_sided(animate(still, correctives=self.correctives, body=self.body))
        self.poses = rng.normal(0, 0.5, (2, joints, 3))
        if self.folds:
            self.poses[:, [self.body.joint_names.index(f"{s}_knee") for s in SIDES], 0] = 2.0
        self.rest_turns = Rotation.random(joints, rng).as_matrix()

    @cached_property
    def known(self) -> np.ndarray:
        """The body's own surface in the poses (T, V, 3)."""
        return self.body(
            np.broadcast_to(self.betas, (len(self.poses), len(self.betas))), self.poses
        ).vertices

    @cached_property
    def bare(self) -> np.ndarray:
        """How far (m) the surface is from that without any blend shape (T, V)."""
        return self.off(np.zeros((len(self.poses), len(self.animation.morphs))))

    @cached_property
    def weights(self) -> np.ndarray:
        """What the blend shapes should be given (T, K)."""
        names = self.body.joint_names
        columns = []
        for channel in drivers(self.animation)["channels"]:
            vectors = self.poses[:, names.index(channel["joint"])]
            turned = (Rotation.from_rotvec(vectors).as_matrix() - np.eye(3)).reshape(-1, 9)
            driven = turned @ channel["row"] - channel.get("bias", 0.0)
            columns.append(np.clip(driven, 0, 1) ** channel.get("power", 1.0))
        return np.stack(columns, 1)

    def off(self, weights: np.ndarray) -> np.ndarray:
        """How far (m) the surface with these weights (T, K) of blend shapes is from the body's own
        (T, V).
        """
        rests = self.animation.rest_vertices + np.tensordot(weights, self.animation.morphs, 1)
        shown = np.array(
            [self._skinned(rest, pose) for rest, pose in zip(rests, self.poses, strict=True)]
        )
        return np.linalg.norm(shown - self.known, axis=-1)

    def _skinned(self, rest: np.ndarray, pose: np.ndarray) -> np.ndarray:
        joints = self.animation.rest_joints
        whole = []
        for joint, parent in enumerate(self.body.parents):
            local = np.eye(4)
            local[:3, :3] = Rotation.from_rotvec(pose[joint]).as_matrix()
            local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0.0)
            whole.append(local if parent < 0 else whole[parent] @ local)
        turns = np.array(whole)[:, :3, :3]
        carried = np.array(whole)[:, :3, 3] - np.einsum("jcd,jd->jc", turns, joints)
        weights = self.body.skinning_weights
        return np.einsum("vcd,vd->vc", np.tensordot(weights, turns, 1), rest) + weights @ carried


exported = cache(Exported)


@dataclass(eq=False)
class Imported:
    """The same in a program. Axes: from the body's to the mesh's; bones rest like these or with
    axes of their own.
    """

    axes: np.ndarray
    scale: float
    file: Exported
    own_axes: bool = True

    @property
    def rest_turns(self) -> np.ndarray:
        """How bones rest (J, 3, 3)."""
        turns = self.file.rest_turns
        return turns if self.own_axes else np.broadcast_to(np.eye(3), turns.shape)

    def save_drivers(self, folder: Path, **changed: object) -> Path:
        """The JSON that lies beside the file."""
        path = folder / "person.correctives.json"
        path.write_text(json.dumps({**drivers(self.file.animation), **changed}))
        return path

    @cached_property
    def rests(self) -> np.ndarray:
        """Bones in the mesh's space at rest (J, 4, 4)."""
        found = np.tile(np.eye(4), (len(self.rest_turns), 1, 1))
        found[:, :3, :3] = self.rest_turns
        found[:, :3, 3] = self.scale * self.file.animation.rest_joints @ self.axes.T
        return found

    @cached_property
    def worlds(self) -> np.ndarray:
        """How bones are turned in the mesh's space, in all poses (T, J, 3, 3)."""
        poses = self.file.poses
        found = np.empty((*poses.shape, 3))
        local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix()
        local = local.reshape(found.shape)
        for joint, parent in enumerate(self.file.body.parents):
            found[:, joint] = local[:, joint] if parent < 0 else found[:, parent] @ local[:, joint]
        return self.axes @ found @ self.axes.T @ self.rest_turns

    @cached_property
    def locals(self) -> np.ndarray:
        """The same against their parents (T, J, 3, 3)."""
        parents = np.array(self.file.body.parents)
        found = np.swapaxes(self.worlds[:, parents], -1, -2) @ self.worlds
        found[:, parents < 0] = self.worlds[:, parents < 0]
        return found
