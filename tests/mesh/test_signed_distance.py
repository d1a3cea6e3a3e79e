"""Signed distance: against an independent library, and its gradient against finite differences."""

import igl
import numpy as np
import pytest
import trimesh

from habitus.mesh.proximity import signed_distance


@pytest.fixture(scope="module")
def mesh() -> tuple[np.ndarray, np.ndarray]:
    shape = trimesh.creation.capsule(height=1.0, radius=0.3)
    vertices = np.array(shape.vertices) @ np.diag([1.0, 0.6, 1.4])
    return vertices, np.array(shape.faces, dtype=np.int64)


def test_agrees_with_libigl(mesh):
    points = np.random.default_rng(0).normal(scale=0.6, size=(400, 3))
    theirs = igl.signed_distance(points, *mesh, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
    np.testing.assert_allclose(signed_distance(points, *mesh).distance, theirs, atol=1e-9)


def test_direction_is_the_gradient(mesh):
    points = np.random.default_rng(1).normal(scale=0.6, size=(50, 3))
    here = signed_distance(points, *mesh)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (
            signed_distance(points + step, *mesh).distance
            - signed_distance(points - step, *mesh).distance
        ) / 2e-6
        np.testing.assert_allclose(slope, here.direction[:, axis], atol=1e-4)


def test_closest_point_is_where_barycentric_says(mesh):
    vertices, faces = mesh
    points = np.random.default_rng(2).normal(size=(50, 3))
    here = signed_distance(points, *mesh)
    closest = np.einsum("nk,nkd->nd", here.barycentric, vertices[faces[here.triangle]])
    np.testing.assert_allclose(closest + here.distance[:, None] * here.direction, points, atol=1e-9)
