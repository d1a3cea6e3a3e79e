"""Initial skinning weights and joint regressor from a segmentation of the template (S 4.1, Fig. 6;
T 5.4.1).
"""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

from habitus.errors import HabitusError
from habitus.learn.options import SETTINGS, TrainSettings
from habitus.mesh.template import Template

MAX_JOINTS = 4  # joints a vertex
_SIDES = np.array([[1, 2], [2, 0], [0, 1]])  # opposite to each corner


def diffuse_weights(
    template: Template, settings: TrainSettings = SETTINGS
) -> Float[np.ndarray, "V J"]:
    """Initial skinning weights W_I: the segmentation, diffused over the surface (S 4.1, Fig. 6b).

    Each part's indicator is heat that spreads over the mesh, faster on large parts: a border is
    smeared by 0.35 times the radius of the sphere that has the part's area. On a grown body that
    blends weights (5 to 95 %) over some 16 cm at a knee, 10 at an elbow and 6 at a wrist, as
    hand-made weights do. At most four joints a vertex are kept. Rows sum to 1 and nothing is
    negative; weights are symmetric where the template has its mirrors. A piece of the mesh that
    lies in one part and touches nothing else keeps a weight of 1.
    """
    heat = np.eye(template.num_joints)[template.part]
    solve, mass = _heat_step(template, settings)
    for _ in range(settings.border_steps):
        heat = solve(mass * heat)
    return _strongest(_symmetric(heat, template), settings.min_initial_weight)


def ring_regressor(template: Template) -> Float[np.ndarray, "J V"]:
    """Initial joint regressor J_I: a joint is the mean of the ring of vertices between its part and
    its parent's.

    The ring are the vertices of the edges that lead from one part to the other (S 4.1). The root is
    the mean of its children's joints, or that of all its vertices if it has none. Rows sum to 1;
    symmetric where the template has its mirrors. Raises HabitusError where a part does not touch
    its parent's.
    """
    edges = np.unique(np.sort(template.faces[:, _SIDES].reshape(-1, 2), 1), axis=0)
    part = template.part[edges]
    parents = template.parents
    regressor = np.zeros((template.num_joints, template.num_vertices))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            ring = edges[(part == [joint, parent]).all(1) | (part == [parent, joint]).all(1)]
            if ring.size == 0:
                raise _no_ring(template, joint)
            regressor[joint, ring] = 1.0
    regressor[1:] /= regressor[1:].sum(1, keepdims=True)
    children = np.flatnonzero(np.array(parents) == 0)
    regressor[0] = regressor[children].mean(0) if len(children) else 1.0 / template.num_vertices
    return _symmetric(regressor.T, template).T


def _no_ring(template: Template, joint: int) -> HabitusError:
    name = template.joint_names[joint]
    parent = template.joint_names[template.parents[joint]]
    count = len(template.part_vertices(joint))
    return HabitusError(
        f"no edge of the template leads from the part of {name!r} ({count} vertices) to its "
        f"parent's, {parent!r}; "
        "expected parts that touch: repair the segmentation, the tree of joints or the mesh"
    )


def _heat_step(
    template: Template, settings: TrainSettings
) -> tuple[Callable[[np.ndarray], np.ndarray], Float[np.ndarray, "V 1"]]:
    """A backward Euler step of the heat equation, as a function of the vertices' heat content; and
    their masses (V, 1).

    The equation is u' = s div(s grad u), s the part's radius in the units of the spread: in one
    dimension, heat where lengths are counted in radii. So half of each joint's weight stays at the
    border, also between parts of two sizes. Edges that a cotangent Laplacian repels heat along
    (obtuse triangles) conduct none, so heat never turns negative.
    """
    vertices = np.asarray(template.vertices, dtype=np.float64)
    faces = template.faces
    twice_area, cotangents = _areas_and_cotangents(vertices, faces)
    mass = np.bincount(faces.ravel(), np.repeat(twice_area / 6, 3), len(vertices))
    mass = np.maximum(mass, 1e-9 * mass.max())  # vertices without area
    area = np.bincount(template.part, mass, template.num_joints)
    speed = settings.border_spread * np.sqrt(area[template.part] / (8 * np.pi))
    cotangents = np.nan_to_num(cotangents).clip(-settings.max_cotangent, settings.max_cotangent)
    ends = faces[:, _SIDES[:, 0]].ravel(), faces[:, _SIDES[:, 1]].ravel()
    flow = (cotangents * speed[faces].mean(1, keepdims=True)).ravel()
    flow = sparse.coo_array((flow, ends), (len(vertices), len(vertices))).tocsr()
    flow = (flow + flow.T).maximum(0.0)
    mass = mass / speed
    steps = settings.border_steps
    system = sparse.diags_array(mass + flow.sum(1) / steps) - flow / steps
    return splu(system.tocsc()).solve, mass[:, None]


def _areas_and_cotangents(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F 3"]]:
    """Twice the triangles' areas, and half the cotangents of their corners (not finite where there
    is no area).
    """
    corners = vertices[faces]
    after, before = (np.roll(corners, shift, axis=1) - corners for shift in (-1, 1))
    twice_area = np.linalg.norm(np.cross(after[:, 0], before[:, 0]), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return twice_area, (after * before).sum(2) / (2 * twice_area[:, None])


def _symmetric(weights: Float[np.ndarray, "V J"], template: Template) -> Float[np.ndarray, "V J"]:
    """The mean with the mirrored."""
    if template.mirror is None or template.joint_mirror is None:
        return weights
    return (weights + weights[template.mirror][:, template.joint_mirror]) / 2


def _strongest(weights: Float[np.ndarray, "V J"], least: float) -> Float[np.ndarray, "V J"]:
    """At most four joints a vertex; of joints that tie for the last place, none, which keeps
    mirrors alike.
    """
    if weights.shape[1] > MAX_JOINTS:
        fifth = np.partition(weights, -MAX_JOINTS - 1, axis=1)[:, -MAX_JOINTS - 1, None]
        weights = np.where((weights > fifth) | (weights == 1), weights, 0.0)
    weights = np.where(weights >= least, weights, 0.0)
    return weights / weights.sum(1, keepdims=True)
