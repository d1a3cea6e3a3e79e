"""The terms of MoSh's shape stage (MoSh 5, thesis 3.5), each a residual with its derivatives.

Lengths are metres. MoSh states the weights per cm²; ``PER_CM2`` converts them, here and nowhere else.
"""

from dataclasses import dataclass

import numpy as np

from habitus.mesh.signed_distance import signed_distance
from habitus.residuals.blocks import Block

PER_CM2 = 1e4


@dataclass(frozen=True)
class Columns:
    """Where each unknown of the shape stage lies in the vector: betas, latent markers, then a body a frame."""

    num_betas: int
    num_markers: int
    num_frames: int
    num_joints: int

    @property
    def frame_size(self) -> int:
        """Unknowns of one frame: trans (3) and pose (3 J)."""
        return 3 + 3 * self.num_joints

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.num_betas + 3 * self.num_markers + self.num_frames * self.frame_size

    @property
    def betas(self) -> slice:
        """Columns of the shape coefficients."""
        return slice(0, self.num_betas)

    @property
    def latent_markers(self) -> slice:
        """Columns of the latent markers."""
        return slice(self.num_betas, self.num_betas + 3 * self.num_markers)

    def frame(self, index: int) -> slice:
        """Columns of trans and pose of one frame."""
        start = self.latent_markers.stop + index * self.frame_size
        return slice(start, start + self.frame_size)

    def body_pose(self, index: int) -> slice:
        """Columns of a frame's joint rotations, the root's left out."""
        frame = self.frame(index)
        return slice(frame.start + 6, frame.stop)

    def pack(self, betas: np.ndarray, latent: np.ndarray, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        """The vector of unknowns."""
        frames = np.concatenate([trans, pose.reshape(len(pose), -1)], axis=1)
        return np.concatenate([betas, latent.ravel(), frames.ravel()])

    def unpack(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """betas (B,), latent_markers (M, 3), pose (F, J, 3), trans (F, 3)."""
        frames = x[self.latent_markers.stop :].reshape(self.num_frames, self.frame_size)
        pose = frames[:, 3:].reshape(self.num_frames, self.num_joints, 3)
        return x[self.betas], x[self.latent_markers].reshape(-1, 3), pose, frames[:, :3]


@dataclass(frozen=True)
class Simulated:
    """Simulated markers of some frames, linearised (MoSh eq. 2).

    markers (F, M, 3); by_frame (F, M, 3, 3 + 3 J); by_betas (F, M, 3, B), latent markers held; by_latent (F, M, 3, 3).
    """

    markers: np.ndarray
    by_frame: np.ndarray
    by_betas: np.ndarray
    by_latent: np.ndarray


def data(
    simulated: Simulated, observed: np.ndarray, weights: np.ndarray, scale: float, columns: Columns
) -> list[Block]:
    """E_D (eq. 3): simulated against observed markers; ``weights`` (F, M), 0 where a marker is missing."""
    blocks = []
    for t in range(columns.num_frames):
        seen = np.flatnonzero(weights[t] > 0)
        root = np.sqrt(weights[t, seen])
        rows = 3 * len(seen)
        latent = np.zeros((len(seen), 3, columns.num_markers, 3))
        latent[np.arange(len(seen)), :, seen, :] = root[:, None, None] * simulated.by_latent[t, seen]
        by_betas, by_frame = (root[:, None, None] * j[t, seen] for j in (simulated.by_betas, simulated.by_frame))
        jacobian = [
            (columns.betas, by_betas.reshape(rows, -1)),
            (columns.latent_markers, latent.reshape(rows, -1)),
            (columns.frame(t), by_frame.reshape(rows, -1)),
        ]
        residual = (root[:, None] * (simulated.markers[t, seen] - observed[t, seen])).ravel()
        blocks.append(Block("data", PER_CM2 * scale, residual, jacobian))
    return blocks


def surface_distance(
    latent: np.ndarray,
    rest_vertices: np.ndarray,
    shapedirs: np.ndarray,
    faces: np.ndarray,
    distance: np.ndarray,
    spread: np.ndarray,
    scale: float,
    columns: Columns,
) -> list[Block]:
    """E_S (eq. 4): latent markers keep the layout's distance from the skin, to within ``spread`` (M,) (paper: 1 mm)."""
    near = signed_distance(latent, rest_vertices, faces)
    root = 1e-3 / spread
    on_skin = np.einsum("mk,mkdb->mdb", near.barycentric, shapedirs[faces[near.triangle]])
    by_betas = -root[:, None] * np.einsum("md,mdb->mb", near.direction, on_skin)
    by_latent = _diagonal(root[:, None, None] * near.direction[:, None, :])
    jacobian = [(columns.betas, by_betas), (columns.latent_markers, by_latent)]
    return [Block("surface", PER_CM2 * scale, root * (near.distance - distance), jacobian)]


def start_place(
    latent: np.ndarray,
    start: np.ndarray,
    start_by_betas: np.ndarray,
    spread: np.ndarray,
    scale: float,
    columns: Columns,
) -> list[Block]:
    """E_I (eq. 5): latent markers stay near the layout's places v_i(betas), to within ``spread`` (M,) (paper: 2 cm)."""
    root = (0.02 / spread)[:, None]
    by_betas = -(root[..., None] * start_by_betas).reshape(3 * len(latent), -1)
    by_latent = _diagonal(root[:, :, None] * np.eye(3))
    jacobian = [(columns.betas, by_betas), (columns.latent_markers, by_latent)]
    return [Block("start", PER_CM2 * scale, (root * (latent - start)).ravel(), jacobian)]


def shape_prior(betas: np.ndarray, scale: float, columns: Columns) -> list[Block]:
    """E_beta (eq. 6); betas are unit normal by construction of the body."""
    return [Block("betas", scale, betas, [(columns.betas, np.eye(len(betas)))])]


def pose_prior(
    pose: np.ndarray, mean: np.ndarray, whitening: np.ndarray, scale: float, columns: Columns
) -> list[Block]:
    """E_theta (eq. 7) with ``whitening`` W, WᵀW the prior's precision; the root is free."""
    deviation = pose[:, 1:].reshape(len(pose), -1) - mean
    return [Block("pose", scale, whitening @ d, [(columns.body_pose(t), whitening)]) for t, d in enumerate(deviation)]


def _diagonal(rows: np.ndarray) -> np.ndarray:
    """(M, R, 3) -> (M R, 3 M) block diagonal."""
    markers, height, _ = rows.shape
    out = np.zeros((markers, height, markers, 3))
    out[np.arange(markers), :, np.arange(markers), :] = rows
    return out.reshape(markers * height, markers * 3)
