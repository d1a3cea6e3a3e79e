"""Normals of triangles, places on them, and samples of points."""

import numpy as np
import pytest
import torch

from habitus.arrays import runs
from habitus.mesh.proximity import (
    at_barycentrics,
    barycentric_coordinates,
    farthest_points,
    triangle_normals,
)


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_the_normal_of_a_triangle_is_twice_its_area_long(kind):
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0]])
    normals = triangle_normals(kind(np.stack([corners, corners[::-1]])))
    np.testing.assert_array_equal(normals, [[0, 0, 6], [0, 0, -6]])


def test_barycentric_coordinates_give_the_point_back():
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(9, 3))
    corners = rng.permutation(9).reshape(3, 3)
    barycentric = rng.dirichlet((1, 1, 1), 3)
    points = at_barycentrics(vertices, corners, barycentric)
    found = barycentric_coordinates(points, vertices[corners])
    np.testing.assert_allclose(found, barycentric, atol=1e-12)


def test_of_two_clusters_the_second_sample_is_in_the_other_one():
    points = np.concatenate([np.zeros((5, 2)), np.ones((5, 2))]) + 0.01 * np.eye(10, 2)
    assert farthest_points(points, 2, first=6)[1] < 5
    assert farthest_points(points, 99)[:2].tolist() == [0, 5]
    assert len(farthest_points(points, 99)) == len(points)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [("", []), ("000", []), ("1", [(0, 1)]), ("0110100", [(1, 3), (4, 5)]), ("11", [(0, 2)])],
)
def test_runs_of_true(flags, expected):
    assert runs(np.array(list(flags)) == "1") == expected
