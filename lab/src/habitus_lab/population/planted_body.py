"""A body of SMPL's form with random pose blend shapes: planted truth for training to recover."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.skinning import ancestors
from habitus.errors import HabitusError
from habitus.learn.start.segmentation import ring_regressor
from habitus.mesh.normals import vertex_normals
from habitus.mesh.template import Template
from habitus.rotations import matrix_from_rotvec
from habitus_lab.population.coarse_bodies import mirrored_names

BUMPS = 6  # smooth bumps on the surface by which each joint's features move it
SPAN = 1.75  # m: longest side of the box around a person at rest
WIDTH = 0.06  # m: standard deviation of a bump, in a person of SPAN
REACH = 0.16  # m: how far from the joint bumps lie
ALONG_NORMAL = 0.8  # share of a bump's direction that is along the surface's normal
# rad: the bend at which a joint's greatest shift has the size asked for, over many directions
BEND = 1.0


def planted_truth(
    template_body: BodyModel,
    *,
    seed: int = 0,
    num_betas: int = 10,
    pose_shape_size: float = 0.01,
    joint_regressor: Float[np.ndarray, "J V"] | None = None,
) -> BodyModel:
    """``template_body`` with ``num_betas`` of its shape directions and pose blend shapes planted.

    Joint by joint, the nine entries of R - I move a few smooth patches of the surface near the
    joint, by ``pose_shape_size`` (m) where it moves most, on average over bends of 1 rad; nothing
    further away. They hold nothing that a shift of joints would do as well, since nobody could tell
    which of the two was planted. Where the body knows its mirror, the mirrored pose gives the
    mirrored surface. Weights, shape directions and, unless a regressor is given, joints are the
    body's own. Raises HabitusError where the body has pose blend shapes already.
    """
    if template_body.posedirs is not None:
        raise HabitusError(
            f"{template_body.name} has pose blend shapes; expected none, to plant some: "
            "posedirs=None"
        )
    body = template_body.with_betas(num_betas)
    if joint_regressor is not None:
        body = replace(body, joint_regressor=joint_regressor)
    rng = np.random.default_rng(seed)
    joints = body.joint_template
    normals = vertex_normals(body.v_template, body.faces)
    posedirs = np.stack(
        [_near_joint(rng, body, normals, joints, k) for k in range(1, body.num_joints)], 2
    )
    if body.mirror is not None:
        posedirs = (posedirs + _mirrored(posedirs, body)) / 2
    posedirs = _without_joint_shifts(posedirs, body)
    rotvecs = rng.standard_normal((64, 3))
    rotvecs *= BEND / np.linalg.norm(rotvecs, axis=1, keepdims=True)
    rotvecs = np.concatenate([rotvecs, rotvecs * [1.0, -1.0, -1.0]])  # the same for the other side
    feature = (matrix_from_rotvec(rotvecs) - np.eye(3)).reshape(-1, 9)
    for k in range(posedirs.shape[2]):
        shift = np.linalg.norm(posedirs[:, :, k] @ feature.T, axis=1).max(0).mean()
        posedirs[:, :, k] *= pose_shape_size / max(shift, 1e-12)
    planted = posedirs.reshape(body.num_vertices, 3, -1)
    return replace(body, name=f"planted on {template_body.name}", posedirs=planted)


def _near_joint(
    rng: np.random.Generator, body: BodyModel, normals: np.ndarray, joints: np.ndarray, joint: int
) -> Float[np.ndarray, "V 3 9"]:
    """Bumps around a joint, each with a direction, times how much each entry of R - I raises it."""
    vertices = body.v_template
    scale = np.ptp(vertices, axis=0).max() / SPAN
    near = patch_mask(body, joint)
    distance = np.linalg.norm(vertices - joints[joint], axis=1)
    inside = np.flatnonzero(
        (near > 0.3) & (distance < max(REACH * scale, np.sort(distance[near > 0.3])[:8].max()))
    )
    shifts = np.zeros((len(vertices), 3, 9))
    for centre in rng.choice(inside, BUMPS):
        bump = near * np.exp(
            -0.5 * ((vertices - vertices[centre]) ** 2).sum(1) / (WIDTH * scale) ** 2
        )
        random = rng.standard_normal(3)
        direction = ALONG_NORMAL * normals + (1 - ALONG_NORMAL) * random / np.linalg.norm(random)
        shifts += (bump[:, None] * direction)[..., None] * rng.standard_normal(9)
    return shifts


def _without_joint_shifts(
    posedirs: Float[np.ndarray, "V 3 K 9"], body: BodyModel
) -> Float[np.ndarray, "V 3 K 9"]:
    """Without what moving a joint would do as well: what it is driven by is found at one place
    only.

    Moving joint k by d moves everything below it by -(R_k - I) d, which pose blend shapes can do
    too. Of the two, the penalty E_P on their size leaves the joint's move. It is taken away near
    the joint, where the planted ones are.
    """
    weights = body.skinning_weights
    chains = ancestors(body.parents)
    out = posedirs.copy().reshape(*posedirs.shape[:3], 3, 3)
    for k in range(posedirs.shape[2]):
        below = weights[:, [k + 1 in chain for chain in chains]].sum(1)
        window = (posedirs[:, :, k] ** 2).sum((1, 2))
        window /= max(window.max(), 1e-30)
        size = 3 * (below**2 * window).sum()
        along = np.einsum("v,vaac->c", below, out[:, :, k])
        for a in range(3):
            out[:, a, k, a] -= (below * window)[:, None] * (along / max(size, 1e-30))
    return out.reshape(posedirs.shape)


def patch_mask(body: BodyModel, joint: int) -> Float[np.ndarray, " V"]:
    """Membership of each vertex in a joint, its parent or its children: 1 there, 0 beyond, smooth
    between.
    """
    family = [
        k
        for k, parent in enumerate(body.parents)
        if k == joint or parent == joint or k == body.parents[joint]
    ]
    share = body.skinning_weights[:, family].sum(1)
    return share * share * (3 - 2 * share)


def _mirrored(
    posedirs: Float[np.ndarray, "V 3 K 9"], body: BodyModel
) -> Float[np.ndarray, "V 3 K 9"]:
    """The mirrored effect of the mirrored pose: R -> S R S with S = diag(-1, 1, 1)."""
    assert body.mirror is not None
    side = np.array([-1.0, 1.0, 1.0])
    joints = mirrored_names(body.joint_names)[1:] - 1
    return posedirs[body.mirror][:, :, joints] * side[:, None, None] * np.outer(side, side).ravel()


def joints_near_rings(
    template: Template, *, seed: int = 0, offset: float = 0.01
) -> Float[np.ndarray, "J V"]:
    """A joint regressor that is about ``offset`` (m) away from the rings that training starts from
    (S 4.1).

    Each ring's mean is moved along a random direction towards a few vertices near it; left and
    right alike where the template has its mirrors.
    """
    rng = np.random.default_rng(seed)
    rings = ring_regressor(template)
    regressor = rings.copy()
    for joint, place in enumerate(rings @ template.vertices):
        away = template.vertices - place
        distance = np.linalg.norm(away, axis=1)
        direction = rng.standard_normal(3)
        cosine = away @ direction / np.maximum(distance * np.linalg.norm(direction), 1e-9)
        pull = np.argsort(distance + 0.1 * (1 - cosine))[:12]
        share = min(1.0, offset / max(float(np.linalg.norm(away[pull].mean(0))), 1e-9))
        regressor[joint] *= 1 - share
        regressor[joint, pull] += share / len(pull)
    if template.mirror is None or template.joint_mirror is None:
        return regressor
    for joint, other in enumerate(template.joint_mirror):
        if other > joint:
            regressor[other] = regressor[joint][template.mirror]
        elif other == joint:
            regressor[joint] = (regressor[joint] + regressor[joint][template.mirror]) / 2
    return regressor
