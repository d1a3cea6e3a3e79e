"""The derivative of vertex normals is what small moves of the vertices show."""

import numpy as np

from habitus.mesh.normals import normal_jacobian, vertex_normals
from habitus.mesh.shapes import sphere


def test_it_is_what_small_moves_show():
    rng = np.random.default_rng(0)
    ball = sphere()
    faces = np.asarray(ball.faces)
    vertices = np.asarray(ball.vertices) * [1.0, 1.3, 0.7] + 0.01 * rng.normal(
        size=np.shape(ball.vertices)
    )
    way = rng.normal(size=vertices.shape)
    ahead, behind = (vertex_normals(vertices + step * way, faces) for step in (1e-6, -1e-6))
    found = (normal_jacobian(vertices, faces) @ way.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(found, (ahead - behind) / 2e-6, atol=1e-6 * np.abs(found).max())


def test_normals_stay_when_a_surface_moves_or_grows_as_a_whole():
    ball = sphere()
    vertices = np.asarray(ball.vertices)
    faces = np.asarray(ball.faces)
    jacobian = normal_jacobian(vertices, faces)
    for way in (np.ones_like(vertices), vertices):
        assert np.abs(jacobian @ way.ravel()).max() < 1e-9
