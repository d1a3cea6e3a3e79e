"""Where a scan tells of a registered surface, and the surface carried back to rest."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from habitus.body.jacobians import posed_skeleton
from habitus.body.model import BodyModel
from habitus.fit.registration.model_stage import Cloud, ModelState
from habitus.fit.registration.nearest import TURN, Topology
from habitus.mesh.normals import vertex_normals

LEAST_REACH = 0.004
"""Metres from a vertex within which there has to be a point of the scan, however dense it is."""
SPACINGS = 2.0
"""The same in mean distances of the scan's points."""


def vertex_weights(
    topology: Topology, surface: Float[np.ndarray, "V 3"], cloud: Cloud
) -> Float[np.ndarray, " V"]:
    """1 where points of the scan are near a vertex and look its way, 0 where there is a hole,
    straight in between.
    """
    pointing = vertex_normals(surface, topology.faces)
    tree = cKDTree(np.concatenate([cloud.points, TURN * cloud.normals], 1))
    own = tree.query(tree.data[: min(2000, len(cloud.points))], k=2)[0][:, 1]
    reach = max(LEAST_REACH, SPACINGS * float(np.median(own)))
    away = tree.query(np.concatenate([surface, TURN * pointing], 1))[0]
    weights = np.zeros(len(surface))
    weights[topology.whole] = np.clip(2.0 - 0.5 * away[topology.whole] / reach, 0.0, 1.0)
    return weights


def hidden_vertices(body: BodyModel) -> Bool[np.ndarray, " V"] | None:
    """Vertices of pockets that nobody sees; None for a body that does not say."""
    full = body if body.mesh is not None else body.full
    if full is None or full.mesh is None:
        return None
    seen = np.zeros(full.num_vertices, dtype=bool)
    seen[np.unique(full.mesh.quads[~full.mesh.hidden])] = True
    return ~(seen if full is body else seen[body.full_vertices])


def at_rest(
    body: BodyModel, state: ModelState, offset: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """The person at rest: the model's, with a posed surface's offset from the posed model turned
    back.
    """
    skeleton = posed_skeleton(body, body.rest_joints(state.betas), state.pose[0])
    turn = np.einsum(
        "vk,vkij->vij", body.skinning_value, skeleton.motions[body.skinning_index][..., :3]
    )
    return body.rest_vertices(state.betas) + np.linalg.solve(turn, offset[..., None])[..., 0]
