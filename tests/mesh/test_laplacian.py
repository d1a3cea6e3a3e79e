"""Laplacians of meshes, and values carried on into holes."""

import numpy as np
import trimesh
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from habitus.mesh.laplacian import cotangent_laplacian, eliminate_holes, fill_holes


def path(count, cut=None):
    """A chain of vertices, perhaps cut before one of them."""
    joined = np.diag(np.ones(count - 1), 1)
    if cut:
        joined[cut - 1, cut] = 0.0
    joined = joined + joined.T
    return csr_array(np.diag(joined.sum(1)) - joined)


def test_holes_are_bridged_evenly_and_what_is_seen_stays():
    values = np.stack([np.arange(7.0), 3.0 - 2 * np.arange(7.0)], 1)
    seen = np.array([1, 0, 0, 1, 1, 0, 1], bool)
    spoilt = np.where(seen[:, None], values, 100.0)
    assert np.allclose(fill_holes(path(7), seen, spoilt), values, atol=1e-6)
    assert np.allclose(fill_holes(path(7), seen, spoilt[:, :, None])[..., 0], values, atol=1e-6)


def test_an_end_takes_its_neighbours_value_and_a_piece_unseen_none():
    seen = np.array([1, 1, 0, 0, 0], bool)
    assert np.allclose(
        fill_holes(path(5), seen, np.array([1.0, 2, 9, 9, 9])), [1, 2, 2, 2, 2], atol=1e-6
    )
    assert np.allclose(
        fill_holes(path(5, cut=3), seen, np.array([1.0, 2, 9, 9, 9])), [1, 2, 2, 0, 0], atol=1e-6
    )
    whole = np.arange(5.0)
    assert fill_holes(path(5), np.ones(5, bool), whole) is whole


def test_without_holes_the_laplacian_measures_the_least_that_any_filling_has():
    rng = np.random.default_rng(0)
    weight = np.triu(rng.random((30, 30)) * (rng.random((30, 30)) < 0.2), 1)
    weight += weight.T
    laplacian = csr_array(np.diag(weight.sum(1)) - weight)
    seen = rng.random(30) < 0.6
    values = rng.normal(size=30)
    filled = fill_holes(laplacian, seen, values)
    least = eliminate_holes(laplacian, seen)
    spoilt = np.where(seen, values, 1e3)
    assert np.isclose(spoilt @ (least @ spoilt), filled @ (laplacian @ filled))
    for _ in range(5):
        other = np.where(seen, values, filled + 0.1 * rng.normal(size=30))
        assert other @ (laplacian @ other) > filled @ (laplacian @ filled)
    assert eliminate_holes(laplacian, np.ones(30, bool)) is laplacian


def test_a_laplacian_is_semidefinite_whatever_its_triangles():
    rng = np.random.default_rng(5)
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    for angle in (1e-1, 1e-2, 1e-4, 1e-7, 0.0):
        for _ in range(20):
            flat = np.array([[0.0, 0.0], [1.0, 0.0], [rng.uniform(0.1, 0.9), angle], [1.5, -1.0]])
            vertices = 0.01 * np.pad(flat, ((0, 0), (0, 1))) @ Rotation.random(rng=rng).as_matrix()
            laplacian, _ = cotangent_laplacian(vertices, faces)
            values = np.linalg.eigvalsh(laplacian.toarray())
            assert values.min() > -1e-9 * values.max()


def test_the_laplacian_of_a_constant_is_zero_and_the_areas_add_up():
    ball = trimesh.creation.icosphere(3, 0.4)
    laplacian, area = cotangent_laplacian(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert np.abs(laplacian @ np.ones(len(area))).max() < 1e-9
    np.testing.assert_allclose(area.sum(), ball.area)
    assert np.linalg.eigvalsh(laplacian.toarray()[:200, :200]).min() > -1e-9
