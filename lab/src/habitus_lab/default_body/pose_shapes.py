"""Pose blend shapes, hinge channels and dynamics of earlier files, carried over to new ones vertex by
vertex.

They are learned from simulated flesh, which takes hours. The meshes are the same, the form differs
by millimetres: the offsets serve until flesh is simulated on the new form. What is multiplied with
the first betas is rewritten for the new file's: the earlier betas of the new file's people, about
their mean, as a linear function of their new ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

SAME = ("base_vertices", "coarse_vertices", "coarse_faces", "faces", "mirror", "joint_names")
TAKEN = ("posedirs", "posedirs_joints", "hinge_joints", "hinge_rows", "hinge_bias", "hinge_linear")
TAKEN += ("dynamicsdirs", "dynamics_limits", "dynamics_joints", "dynamics_rate")
TAKEN += ("dynamics_controls", "description")


def coarse_mesh(path: Path) -> np.ndarray:
    """(F, 3) triangles of a file's coarse mesh over its full vertices."""
    with np.load(path) as file:
        return file["coarse_vertices"][file["coarse_faces"]]


def with_pose_shapes(
    arrays: dict[str, np.ndarray], path: Path, vertices: np.ndarray, betas: np.ndarray
) -> dict[str, np.ndarray]:
    """A new file's arrays with the pose shapes of an earlier one; vertices (N,V,3) and betas (N,B)
    of the new file's people.

    Raises ValueError where the meshes differ.
    """
    with np.load(path) as file:
        earlier = {key: file[key] for key in file.files}
    other = [key for key in SAME if not np.array_equal(arrays[key], earlier[key])]
    if other:
        raise ValueError(f"{path}: {', '.join(other)} differ; pose shapes need the same mesh")
    found = arrays | {key: earlier[key] for key in TAKEN if key in earlier}
    if "hingedirs" in earlier:
        shapes = earlier["hingedirs"].shape[-1] - 1
        turn = earlier_betas(earlier, vertices, betas, shapes)
        found["hingedirs"] = _rewritten(np.moveaxis(earlier["hingedirs"], -1, 0), turn)
        found["hingedirs"] = np.moveaxis(found["hingedirs"], 0, -1).astype(np.float16)
    if "dynamics_drive" in earlier:
        turn = earlier_betas(earlier, vertices, betas, len(earlier["dynamics_drive"]) - 1)
        for key in ("dynamics_history", "dynamics_drive"):
            found[key] = _rewritten(earlier[key], turn)
        ends = earlier["dynamics_reach"] / np.diag(turn)
        found["dynamics_reach"] = np.sort(ends, 0).astype(np.float32)
    return found


def earlier_betas(
    earlier: dict[str, np.ndarray], vertices: np.ndarray, betas: np.ndarray, count: int
) -> np.ndarray:
    """(S, S) so that the first S earlier betas of people are about this times their first S new
    ones.
    """
    flat = earlier["shapedirs"].astype(np.float32).reshape(-1, earlier["shapedirs"].shape[-1])
    offsets = (vertices - vertices.mean(0)).reshape(len(vertices), -1)
    known = np.linalg.solve((flat.T @ flat).astype(float), (offsets @ flat).astype(float).T).T
    return np.linalg.lstsq(betas[:, :count], known[:, :count], rcond=None)[0].T


def _rewritten(blocks: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Blocks (1 + S, ...), the first alone and the others times a beta each, for new betas."""
    blocks = blocks.astype(np.float32)
    further = np.tensordot(turn.T.astype(np.float32), blocks[1:], 1)
    return np.concatenate([blocks[:1], further])
