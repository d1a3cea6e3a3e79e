"""Which poses tell the shape of a person with a given set of markers best: a body scan with markers
(M 10).

What a frame tells of shape and of where markers sit is its information once its own pose is let go:
with H the derivatives of the markers by betas and latent markers and P those by pose and place, HᵀH
- HᵀP (PᵀP + L)⁻¹ PᵀH. Frames add up, with what layout and priors say before; the shape's part of
the inverse says how well the person is known.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.energy import Placement
from habitus.fit.markers.settings import MoshWeights
from habitus.fit.selection.problem import SELECTION, SelectionSettings
from habitus.mesh.normals import vertex_normals
from habitus.observe.latent_markers import LatentMarkers
from habitus.observe.markers import attach, default_markers
from habitus.parallel.workers import Threads, Workers


@dataclass(frozen=True)
class PoseChoice:
    """Poses in the order in which they were chosen, and the shape's error (m, of the surface at
    rest) after each.

    ``alone`` is the error after any one pose (N,) of those that there were; ``random`` after as
    many drawn at random.
    """

    poses: tuple[int, ...]
    errors: tuple[float, ...]
    alone: Float[np.ndarray, " N"]
    random: tuple[float, ...]


def choose_poses(
    body: BodyModel,
    prior: PosePrior,
    placement: Placement,
    poses: Float[np.ndarray, "N J 3"],
    count: int,
    *,
    settings: SelectionSettings = SELECTION,
    seed: int = 0,
    workers: Workers | None = None,
) -> PoseChoice:
    """``count`` of N poses, one after another, that tell the mean person's shape best with markers
    placed so.
    """
    known = _known(body, placement)
    before = _mean_square(body)
    shared = body, prior, placement, settings
    information = np.stack(list((workers or Threads(1)).map(_information, shared, list(poses))))
    rng = np.random.default_rng(seed)
    drawn = [rng.permutation(len(poses))[:count] for _ in range(20)]
    random = [
        np.mean([_error(known + information[some[: k + 1]].sum(0), before) for some in drawn])
        for k in range(count)
    ]
    alone = np.array([_error(known + pose_information, before) for pose_information in information])
    chosen = [int(np.argmin(alone))]
    errors = [float(alone.min())]
    while len(chosen) < min(count, len(poses)):
        so_far = known + information[chosen].sum(axis=0)
        each = [
            np.inf if k in chosen else _error(so_far + information[k], before)
            for k in range(len(poses))
        ]
        chosen.append(int(np.argmin(each)))
        errors.append(float(np.min(each)))
    return PoseChoice(tuple(chosen), tuple(errors), alone, tuple(map(float, random)))


def _known(body: BodyModel, placement: Placement) -> Float[np.ndarray, "K K"]:
    """The information on betas and latent markers that priors and the layout give: E_beta, E_I and
    E_S.
    """
    shape = body.num_betas
    count = len(placement.vertices)
    out = np.zeros((shape + 3 * count, shape + 3 * count))
    out[:shape, :shape] = MoshWeights().betas * np.eye(shape)
    normals = vertex_normals(body.v_template, body.faces, placement.vertices)
    for k, (vertex, normal) in enumerate(zip(placement.vertices, normals, strict=True)):
        moved = np.zeros(
            (3, len(out))
        )  # of the marker from the layout's place, which moves with betas
        moved[:, :shape] = -body.shapedirs[vertex]
        moved[:, shape + 3 * k : shape + 3 * k + 3] = np.eye(3)
        out += moved.T @ moved / placement.place_spread[k] ** 2
        out += np.outer(normal @ moved, normal @ moved) / placement.distance_spread[k] ** 2
    return out


def _information(
    shared: tuple[BodyModel, PosePrior, Placement, SelectionSettings], pose: np.ndarray
) -> Float[np.ndarray, "K K"]:
    """What one frame in a pose tells of betas and latent markers."""
    body, prior, placement, settings = shared
    betas = np.zeros(body.num_betas)
    latent = default_markers(body, betas, placement.vertices, placement.distance)
    markers = LatentMarkers(body, attach(latent, body.rest_vertices(betas), body.faces).triangles)
    jacobian = markers.jacobian(betas, latent, pose[None], np.zeros((1, 3)))
    count = len(latent)
    by_latent = np.zeros((count, 3, count, 3))
    by_latent[np.arange(count), :, np.arange(count)] = jacobian.by_latent[0]
    columns = np.concatenate(
        [jacobian.by_betas[0].reshape(3 * count, -1), by_latent.reshape(3 * count, -1)], axis=1
    )
    by_pose = jacobian.by_pose[0].reshape(3 * count, -1)
    let_go = np.concatenate([by_pose, np.tile(np.eye(3), (count, 1))], axis=1)
    trust = np.eye(let_go.shape[1]) / settings.free**2
    trust[3:-3, 3:-3] = MoshWeights().shape_pose * prior.for_joints(body.joint_names).precision
    columns = columns / settings.slip
    let_go = let_go / settings.slip
    across = let_go.T @ columns
    return columns.T @ columns - across.T @ np.linalg.solve(let_go.T @ let_go + trust, across)


def _mean_square(body: BodyModel) -> Float[np.ndarray, "B B"]:
    """What betas do to the mean square of the surface at rest (m²), where it stands left out."""
    moved = body.shapedirs - body.shapedirs.mean(axis=0)
    return np.einsum("vcb,vcd->bd", moved, moved) / len(moved)


def _error(information: Float[np.ndarray, "K K"], square: Float[np.ndarray, "B B"]) -> float:
    """The expected error of the surface at rest (m, root mean square)."""
    shape = len(square)
    inner = information[:shape, :shape] - information[:shape, shape:] @ np.linalg.solve(
        information[shape:, shape:], information[shape:, :shape]
    )
    return float(np.sqrt(np.trace(np.linalg.solve(inner, square))))
