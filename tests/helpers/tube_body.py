"""A small body of tubes for tests of learning: a trunk with four limbs, shape directions, and pose
blend shapes.
"""

from types import MappingProxyType

import numpy as np

from habitus.body.model import BodyModel

PARENTS = (-1, 0, 1, 2, 1, 4, 0, 6, 0, 8)
_ENDS = np.array(
    [  # where each joint's tube begins and ends (m)
        [[0, 0.9, 0], [0, 1.15, 0]],
        [[0, 1.15, 0], [0, 1.7, 0]],
        [[0.15, 1.4, 0], [0.45, 1.4, 0]],
        [[0.45, 1.4, 0], [0.75, 1.4, 0]],
        [[-0.15, 1.4, 0], [-0.45, 1.4, 0]],
        [[-0.45, 1.4, 0], [-0.75, 1.4, 0]],
        [[0.1, 0.85, 0], [0.1, 0.45, 0]],
        [[0.1, 0.45, 0], [0.1, 0.0, 0]],
        [[-0.1, 0.85, 0], [-0.1, 0.45, 0]],
        [[-0.1, 0.45, 0], [-0.1, 0.0, 0]],
    ]
)
_RADII = np.array([0.16, 0.15, 0.05, 0.04, 0.05, 0.04, 0.08, 0.06, 0.08, 0.06])


def tube_body(seed=0, betas=4, around=6, along=4, skinning="lbs", pose_shapes=0.01):
    """V = 10 * around * (along + 1); a tube's first ring follows its parent half."""
    rng = np.random.default_rng(seed)
    vertices = []
    weights = []
    faces = []
    for j, (a, b) in enumerate(_ENDS):
        axis = (b - a) / np.linalg.norm(b - a)
        side = np.cross(axis, [0.0, 0.0, 1.0])
        up = np.cross(axis, side)
        for i in range(along + 1):
            t = 2 * np.pi * np.arange(around) / around
            ring = a + (b - a) * i / along
            vertices.append(
                ring + _RADII[j] * (np.cos(t)[:, None] * side + 0.7 * np.sin(t)[:, None] * up)
            )
            own = min(1.0, 0.5 + i / along)
            row = np.zeros(len(PARENTS))
            row[j] += own
            row[max(PARENTS[j], 0)] += 1 - own
            weights += [row] * around
        first = j * around * (along + 1)
        for i in range(along):
            for k in range(around):
                p = first + i * around + k
                q = first + i * around + (k + 1) % around
                faces += [[p, p + around, q], [q, p + around, q + around]]
    vertices = np.concatenate(vertices)
    weights = np.array(weights)
    regressor = np.zeros((len(PARENTS), len(vertices)))
    for j in range(len(PARENTS)):
        ring = j * around * (along + 1) + np.arange(around)
        regressor[j, ring] = 1 / around
    order = np.argsort(-weights, axis=1, kind="stable")[:, :2]
    waves = rng.normal(size=(betas, 3, 3)) * 0.12
    directions = np.stack([np.sin(3 * vertices @ w) * 0.04 for w in waves], -1)
    posedirs = None
    if pose_shapes:
        posedirs = rng.normal(size=(len(vertices), 3, 9 * (len(PARENTS) - 1))) * pose_shapes
    return BodyModel(
        name="tubes",
        v_template=vertices,
        shapedirs=directions,
        posedirs=posedirs,
        joint_regressor=regressor,
        skinning_index=order,
        skinning_value=np.take_along_axis(weights, order, 1),
        parents=PARENTS,
        faces=np.array(faces),
        joint_names=tuple(f"joint_{j}" for j in range(len(PARENTS))),
        skinning=skinning,
        landmarks=MappingProxyType({}),
    )


def random_pose(rng, joints=10, largest=1.5):
    """Rotation vectors of random axes; angles up to ``largest`` (rad)."""
    axes = rng.normal(size=(joints, 3))
    return (
        axes / np.linalg.norm(axes, axis=-1, keepdims=True) * rng.uniform(0, largest, (joints, 1))
    )
