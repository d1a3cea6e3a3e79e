"""The closest face: what an independent library says, and one and the same of several that are
equally close.
"""

import igl
import numpy as np

from habitus.mesh.proximity import SAME, closest_faces, closest_points
from habitus.mesh.shapes import sphere


def ball():
    shape = sphere(8, 12)
    return np.asarray(shape.vertices, float), np.asarray(shape.faces, np.int64)


def test_no_face_is_closer():
    vertices, faces = ball()
    points = np.random.default_rng(0).normal(size=(300, 3))
    squared, _, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    chosen = faces[closest_faces(points, vertices, faces)]
    alone = [
        igl.point_mesh_squared_distance(p[None], vertices, f[None])[0]
        for p, f in zip(points, chosen, strict=True)
    ]
    np.testing.assert_allclose(np.sqrt(np.ravel(alone)), np.sqrt(squared), atol=2 * SAME)


def test_above_corners_and_edges_it_is_the_first_whatever_rounding_says():
    vertices, faces = ball()
    corners = np.arange(len(vertices))
    above = 1.1 * vertices
    chosen = closest_faces(above, vertices, faces)
    at = [
        np.flatnonzero((np.linalg.norm(vertices[faces] - vertices[k], axis=2) < 1e-12).any(1))[0]
        for k in corners
    ]
    np.testing.assert_array_equal(chosen, at)
    rng = np.random.default_rng(1)
    for size in (1e-15, 1e-12, 1e-9):
        np.testing.assert_array_equal(
            closest_faces(above + size * rng.normal(size=above.shape), vertices, faces), chosen
        )
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    np.testing.assert_array_equal(
        closest_faces(above @ turned.T + 3.0, vertices @ turned.T + 3.0, faces), chosen
    )


def test_faces_without_area_are_passed_over():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 0, 1], [0, 1, 2]])
    assert closest_faces(np.array([[0.0, -1.0, 0.0]]), vertices, faces).tolist() == [1]
    assert closest_faces(np.array([[0.0, -1.0, 0.0]]), vertices, faces[:1]).tolist() == [0]


def test_triangles_in_any_order_and_place():
    rng = np.random.default_rng(7)
    vertices = rng.normal(size=(300, 3)) * [1.0, 0.1, 3.0]
    faces = rng.integers(0, 300, (500, 3))  # long, crossing, some without area
    points = np.concatenate(
        [2.0 * rng.normal(size=(40, 3)), vertices[:20], vertices[faces[:20]].mean(axis=1)]
    )
    found, closest = closest_points(points, vertices, faces)
    distance = np.linalg.norm(points - closest, axis=1)
    squared, _, _ = igl.point_mesh_squared_distance(points, vertices, faces)
    np.testing.assert_allclose(distance, np.sqrt(squared), atol=1e-9)
    alone = [
        igl.point_mesh_squared_distance(p[None], vertices, faces[[f]])
        for p, f in zip(points, found, strict=True)
    ]
    np.testing.assert_allclose(closest, np.concatenate([place for _, _, place in alone]), atol=1e-9)
