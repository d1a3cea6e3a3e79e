# SPDX-License-Identifier: GPL-3.0-or-later
"""The body's arrays and what follows from them: NumPy alone, so that Blender's own Python runs it."""

from pathlib import Path

import numpy as np


class Body:
    """A body of V vertices, J joints, B betas, metres, +y up, facing +z, as `blender/build.py` packs it."""

    def __init__(self, path: Path):
        with np.load(path) as file:
            self.arrays = {name: file[name] for name in file.files}
        self.joint_names = [str(name) for name in self.arrays["joint_names"]]
        self.parents = self.arrays["parents"].tolist()
        self.drivers = self.arrays["drivers"].tolist()
        self.num_betas = self.arrays["shapedirs"].shape[-1]

    def rest(self, betas: np.ndarray) -> np.ndarray:
        """The shaped vertices (V, 3) at rest."""
        return self.arrays["v_template"] + self.arrays["shapedirs"] @ self._all(betas)

    def joints(self, betas: np.ndarray) -> np.ndarray:
        """The joints (J, 3) at rest."""
        return self.arrays["joint_template"] + self.arrays["joint_shapedirs"] @ self._all(betas)

    def correctives(self, rotations: np.ndarray) -> np.ndarray:
        """Pose blend shapes (V, 3; m at rest) for the joints' local rotations (J, 3, 3)."""
        start, vertices, values = (self.arrays[f"pose_{name}"] for name in ("start", "vertices", "values"))
        found = np.zeros_like(self.arrays["v_template"])
        for k, joint in enumerate(self.drivers):
            rows = slice(start[k], start[k + 1])
            found[vertices[rows]] += values[rows] @ (rotations[joint] - np.eye(3)).reshape(9)
        return found

    def _all(self, betas: np.ndarray) -> np.ndarray:
        given = np.asarray(betas, np.float64).ravel()[: self.num_betas]
        return np.pad(given, (0, self.num_betas - len(given)))


UP = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


class Motion:
    """What an npz says of the body in motion: ``pose`` (T, J, 3; rad), ``trans`` (T, 3; m), ``betas``, ``rate`` (Hz).

    Raises ValueError for a file that holds no motion of this body.
    """

    def __init__(self, path: str, body: Body):
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        missing = [name for name in ("poses", "trans") if name not in arrays]
        if missing:
            raise ValueError(f"holds no {missing[0]}; expected the body.npz of a fit")
        whose = str(arrays.get("surface_model_type", arrays.get("body", "")))
        if whose not in ("default", "neutral"):
            raise ValueError(f"is of the body {whose or 'that it does not name'}; this is the default body")
        names = [str(name) for name in arrays["joint_names"]] if "joint_names" in arrays else None
        pose = np.asarray(arrays["poses"], np.float64).reshape(len(arrays["poses"]), -1, 3)
        if names is None and pose.shape[1] == 52:  # AMASS's columns: the joints of the body come first
            names = body.joint_names[:22] + [""] * 30
        if names is None or len(names) != pose.shape[1]:
            raise ValueError(f"poses of {pose.shape[1]} joints without their names")
        self.pose = np.zeros((len(pose), len(body.joint_names), 3))
        for joint, name in enumerate(body.joint_names):
            if name in names:
                self.pose[:, joint] = pose[:, names.index(name)]
        self.trans = np.asarray(arrays["trans"], np.float64)
        self.betas = np.asarray(arrays.get("body_betas", arrays.get("betas", np.zeros(0))), np.float64)
        self.rate = float(arrays["mocap_framerate"])
        self.upright = np.array(UP[str(arrays.get("up_axis", "+z"))], np.float64)
        self.soft = bool(np.any(arrays.get("soft_tissue_betas", 0)) or np.any(arrays.get("soft_tissue_dynamics", 0)))


def quaternions(vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors (…, 3) as quaternions (…, 4), w first."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), vectors * (0.5 * np.sinc(angle / (2 * np.pi)))], axis=-1)
