"""Women's and men's bodies: a scan tells which of several bodies of one topology explains it, and
that one is fitted.

    E = 1/2 sum_p rho(d_p) / noise^2 + 1/2 h^T Q h + 1/2 |betas|^2 + 1/2 (theta - mean)^T P (theta -
    mean)

is what `offset_stage` makes small: what is left of the scan, skin off the model, shape and pose.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.fit.registration.model_stage import Cloud, ModelFitter, ModelState
from habitus.fit.registration.nearest import nearest
from habitus.fit.registration.offset_stage import STEPS, field_precision, offset_spread
from habitus.mesh.normals import vertex_normals
from habitus.rotations import matrix_from_rotvec

ALIKE = 0.005
"""Metres (sd) within which another body's vertices are put on the first one's; its betas are held
as people's are.
"""


def carried(body: BodyModel, other: BodyModel, state: ModelState) -> ModelState:
    """A state of one body as one of another of its topology: the same poses, and the shape that is
    most alike.
    """
    mean = np.zeros(other.num_betas)
    count = other.num_vertices
    wanted = body.rest_vertices(state.betas) - other.rest_vertices(mean)
    slopes = np.asarray(other.shapedirs, float).reshape(3 * count, -1)
    slopes = np.concatenate(
        [slopes, np.tile(np.eye(3), (count, 1))], 1
    )  # betas, and the whole moved
    held = ALIKE**2 * np.concatenate([np.ones(other.num_betas), np.zeros(3)])
    found = np.linalg.solve(slopes.T @ slopes + np.diag(held), slopes.T @ wanted.ravel())
    betas = found[:-3]
    moved = found[-3:]
    first = body.rest_joints(state.betas)[0]
    second = other.rest_joints(betas)[0]
    turned = np.array(
        [matrix_from_rotvec(pose[0]) @ (moved - first + second) for pose in state.pose]
    )
    return ModelState(betas, state.pose, state.trans + first - second + turned)


def energy(
    fitter: ModelFitter,
    state: ModelState,
    clouds: Sequence[Cloud],
    surfaces: Sequence[Float[np.ndarray, "V 3"]],
) -> float:
    """E of all scans at surfaces (m) that lie off the model along its normals."""
    total = 0.5 * float(state.betas @ state.betas)
    for k, (cloud, surface) in enumerate(zip(clouds, surfaces, strict=True)):
        model = fitter.vertices(state, k)
        offset = ((surface - model) * vertex_normals(model, fitter.topology.faces)).sum(1)
        held = field_precision(fitter.topology, model, offset_spread(fitter.body))
        off = state.pose[k, 1:].ravel() - fitter.prior.mean
        total += 0.5 * float(offset @ (held @ offset)) + 0.5 * float(
            off @ fitter.prior.precision @ off
        )
        total += _left(fitter, cloud.first(STEPS[-1].points), surface)
    return total


def _left(fitter: ModelFitter, cloud: Cloud, surface: Float[np.ndarray, "V 3"]) -> float:
    """What a surface leaves of a scan, by Geman and McClure's function of the distance."""
    place = nearest(fitter.topology, surface, cloud.points, cloud.normals).place
    square = ((cloud.points - place) ** 2).sum(1)
    reach = STEPS[-1].reach ** 2
    return 0.5 / STEPS[-1].noise ** 2 * float((square * reach / (square + reach)).sum())
