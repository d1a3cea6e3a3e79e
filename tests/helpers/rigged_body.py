"""A small body for tests of markers: random arrays of the right form, and its forward function
spelled out in torch.
"""

import numpy as np
import torch

from habitus.body.model import BodyModel


def random_body(
    seed=0, joints=6, vertices=40, betas=5, influences=3, posedirs=True, drivers=None
) -> BodyModel:
    rng = np.random.default_rng(seed)
    driving = joints - 1 if drivers is None else len(drivers)
    triangles = np.stack([rng.permutation(vertices)[:3] for _ in range(2 * vertices)])
    weights = rng.dirichlet(np.ones(influences), vertices)
    weights[::3, 1:] = 0.0
    weights[::3, 0] = 1.0
    return BodyModel(
        name="random",
        v_template=np.asarray(rng.normal(size=(vertices, 3)) * 0.4),
        shapedirs=np.asarray(rng.normal(size=(vertices, 3, betas)) * 0.03),
        posedirs=np.asarray(rng.normal(size=(vertices, 3, 9 * driving)) * 0.02)
        if posedirs
        else None,
        joint_regressor=np.asarray(rng.dirichlet(np.ones(vertices), joints)),
        skinning_index=np.asarray(
            np.stack([rng.permutation(joints)[:influences] for _ in range(vertices)])
        ),
        skinning_value=weights,
        parents=(-1, *(int(rng.integers(0, j)) for j in range(1, joints))),
        faces=triangles,
        joint_names=tuple(f"joint{k}" for k in range(joints)),
        pose_joints=drivers,
    )


def hat(v):
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*v.shape[:-1], 3, 3)


def surface(body, betas, pose, trans):
    """Linear blend skinning of one frame (S 3.2): vertices (V, 3)."""
    template, shapedirs, regressor = (
        torch.tensor(a) for a in (body.v_template, body.shapedirs, body.joint_regressor)
    )
    shaped = template + shapedirs @ betas
    rest = regressor @ shaped
    local = torch.linalg.matrix_exp(hat(pose))
    if body.posedirs is not None:
        driving = local[1:] if body.pose_joints is None else local[list(body.pose_joints)]
        shaped = shaped + torch.tensor(body.posedirs) @ (
            driving - torch.eye(3, dtype=pose.dtype)
        ).reshape(-1)
    turned = []
    place = []
    for j, parent in enumerate(body.parents):
        turned.append(local[j] if parent < 0 else turned[parent] @ local[j])
        place.append(
            rest[j] + trans
            if parent < 0
            else place[parent] + turned[parent] @ (rest[j] - rest[parent])
        )
    turned = torch.stack(turned)
    place = torch.stack(place)
    k = torch.tensor(body.skinning_index)
    each = (turned[k] @ (shaped[:, None] - rest[k])[..., None])[..., 0] + place[k]
    return (torch.tensor(body.skinning_value)[..., None] * each).sum(1)
