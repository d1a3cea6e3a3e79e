"""A small BlendSCAPE model for tests of learning: an ellipsoid with a chain of joints along it."""

import numpy as np

from habitus.mesh.shapes import icosphere
from habitus_lab.baselines.blendscape import BlendScape

PARENTS = (-1, 0, 1, 2)
_JOINTS = np.array([-0.5, -0.2, 0.1, 0.4])  # where along x each part begins to take over (m)


def worm_mesh(subdivisions=2):
    """Vertices (m) and faces of an ellipsoid one and a half metres long, and its skinning
    weights.
    """
    sphere = icosphere(subdivisions)
    vertices = sphere.vertices.numpy() * [0.75, 0.2, 0.25]
    steps = 1 / (1 + np.exp(-(vertices[:, :1] - _JOINTS[1:]) / 0.05))
    reached = np.concatenate([np.ones((len(vertices), 1)), steps, np.zeros((len(vertices), 1))], 1)
    return vertices, sphere.faces.numpy(), reached[:, :-1] - reached[:, 1:]


def worm_model(rng, betas=3, shape=0.08, pose=0.05, subdivisions=2):
    """Triangle deformations that vary smoothly along the worm; poses deform the triangles near
    their joints.
    """
    vertices, faces, weights = worm_mesh(subdivisions)
    centres = vertices[faces].mean(1)
    count = len(faces)
    waves = np.stack([np.cos(2.5 * centres @ rng.normal(size=3) + k) for k in range(betas)])
    near = np.exp(-(((centres[:, 0, None] - _JOINTS[1:]) / 0.15) ** 2)).T.repeat(9, 0)
    return BlendScape(
        name="worm",
        template=vertices,
        faces=faces,
        parents=PARENTS,
        influence=weights,
        mean_shape=np.tile(np.eye(3), (count, 1, 1)),
        shape_directions=shape * waves[:, :, None, None] * rng.normal(size=(betas, 1, 3, 3)),
        pose_regression=pose * near[:, :, None, None] * rng.normal(size=(len(near), 1, 3, 3)),
    )
