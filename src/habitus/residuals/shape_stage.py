"""The terms of MoSh's shape stage (MoSh sec. 5, thesis sec. 3.5; full citations in
`habitus.fit.markers.energy`): functions that make a `Term` each.

Unknowns: betas (B,), latent_markers (M, 3), pose (F, J, 3) rad and trans (F, 3). Lengths are
metres. MoSh states the weights per cm²; `per_m2` converts them, here and for all other modules.
"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import bsr_array

from habitus.body.model import BodyModel
from habitus.mesh.proximity import signed_distance
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.markers import default_markers
from habitus.solve.terms import Term


def per_m2(weight_cm2: float) -> float:
    """A weight of squared lengths per cm² as one per m²."""
    return 1e4 * weight_cm2


def data(
    markers: LatentMarkers,
    observed: Float[np.ndarray, "F M 3"],
    weights: Float[np.ndarray, "F M"],
    scale: float,
) -> Term:
    """E_D (MoSh eq. 3): simulated against observed markers; ``weights`` are 0 where a marker is
    missing.
    """
    root = np.sqrt(weights)[..., None]

    def residual(betas, latent_markers, pose, trans):
        def jacobians():
            jacobian = markers.jacobian(betas, latent_markers, pose, trans)
            frames, count = weights.shape
            own = {
                "pose": (root[..., None] * jacobian.by_pose).reshape(frames, 3 * count, -1),
                "trans": (root[..., None] * np.eye(3)).reshape(frames, 3 * count, 3),
            }
            along_markers = np.tile(np.arange(count), frames)
            by_latent = (root[..., None] * jacobian.by_latent).reshape(-1, 3, 3)
            shape = (3 * frames * count, 3 * count)
            return {
                "betas": (root[..., None] * jacobian.by_betas).reshape(3 * frames * count, -1),
                "latent_markers": bsr_array(
                    (by_latent, along_markers, np.arange(len(by_latent) + 1)), shape=shape
                ),
                **{name: diagonal(blocks) for name, blocks in own.items()},
            }

        return root * (markers(betas, latent_markers, pose, trans) - observed), jacobians

    return Term(residual, per_m2(scale))


def surface_distance(
    body: BodyModel,
    distance: Float[np.ndarray, " M"],
    spread: Float[np.ndarray, " M"],
    scale: float,
) -> Term:
    """E_S (MoSh eq. 4): latent markers keep the layout's distance from the skin, to within
    ``spread`` (paper: 1 mm).
    """
    root = 1e-3 / spread

    def residual(betas, latent_markers):
        near = signed_distance(latent_markers, body.rest_vertices(betas), body.faces)

        def jacobians():
            on_skin = np.einsum(
                "mk,mkdb->mdb", near.barycentric, body.shapedirs[body.faces[near.triangle]]
            )
            return {
                "betas": -root[:, None] * np.einsum("md,mdb->mb", near.direction, on_skin),
                "latent_markers": diagonal(root[:, None, None] * near.direction[:, None, :]),
            }

        return root * (near.distance - distance), jacobians

    return Term(residual, per_m2(scale))


def start_place(
    body: BodyModel,
    vertices: np.ndarray,
    distance: Float[np.ndarray, " M"],
    spread: Float[np.ndarray, " M"],
    scale: float,
) -> Term:
    """E_I (MoSh eq. 5): latent markers stay near the layout's places v_i(betas), to within
    ``spread`` (paper: 2 cm).

    The normals in v_i are held in the derivative.
    """
    root = (0.02 / spread)[:, None]
    by_latent = diagonal(root[:, :, None] * np.eye(3))
    by_betas = -(root[..., None] * body.shapedirs[vertices]).reshape(3 * len(vertices), -1)

    def residual(betas, latent_markers):
        start = default_markers(body, betas, vertices, distance)
        return root * (latent_markers - start), {"betas": by_betas, "latent_markers": by_latent}

    return Term(residual, per_m2(scale))


def shape_prior(num_betas: int, scale: float) -> Term:
    """E_beta (MoSh eq. 6); betas are unit normal by construction of the body."""
    return Term(lambda betas: (betas, {"betas": np.eye(num_betas)}), scale)


def pose_prior(
    mean: Float[np.ndarray, " n"], whitening: Float[np.ndarray, "n n"], frames: int, scale: float
) -> Term:
    """E_theta (MoSh eq. 7) with ``whitening`` W, WᵀW the prior's precision; the root is free."""
    block = np.concatenate([np.zeros((len(mean), 3)), whitening], axis=1)
    by_pose = diagonal(np.tile(block, (frames, 1, 1)))

    def residual(pose):
        return (pose[:, 1:].reshape(frames, -1) - mean) @ whitening.T, {"pose": by_pose}

    return Term(residual, scale)


def diagonal(blocks: Float[np.ndarray, "K r c"]) -> bsr_array:
    """K matrices (r, c) along the diagonal of a sparse one."""
    count, rows, columns = blocks.shape
    places = (np.arange(count), np.arange(count + 1))
    return bsr_array((np.ascontiguousarray(blocks), *places), shape=(count * rows, count * columns))
