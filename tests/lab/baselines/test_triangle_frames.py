"""Triangles' frames and their stitching: against a dense solver, under rigid and affine maps."""

import numpy as np
import pytest
from worm_model import worm_mesh

from habitus.errors import HabitusError
from habitus_lab.baselines.triangle_frames import stitching, triangle_frames


def test_frames_go_along_with_turns_and_sizes():
    rng = np.random.default_rng(0)
    vertices, faces, _ = worm_mesh(1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    frames = triangle_frames(vertices, faces)
    np.testing.assert_allclose(
        triangle_frames(2.5 * vertices @ turn.T + 1.0, faces), 2.5 * turn @ frames, atol=1e-12
    )
    np.testing.assert_array_equal(triangle_frames(np.stack([vertices, vertices]), faces)[1], frames)


def test_frames_sum_squares_over_all_three_edges_and_point_outwards():
    rng = np.random.default_rng(1)
    vertices, faces, _ = worm_mesh(1)
    matrices = rng.normal(size=(len(faces), 3, 3))
    corners = vertices[faces]
    edges = matrices @ (np.roll(corners, -1, 1) - corners).mT
    in_plane = (matrices @ triangle_frames(vertices, faces))[..., :2]
    np.testing.assert_allclose((in_plane**2).sum((1, 2)), (edges**2).sum((1, 2)))
    normals = triangle_frames(vertices, faces)[..., 2]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    np.testing.assert_allclose((normals**2).sum(1), area)
    assert ((normals * corners.mean(1)).sum(1) > 0).all()


def test_stitching_is_the_least_squares_of_edges():
    rng = np.random.default_rng(2)
    vertices, faces, _ = worm_mesh(1)
    matrices = rng.normal(size=(len(faces), 3, 3))
    rows = []
    wanted = []
    for t, face in enumerate(faces):
        for a, b in zip(face, np.roll(face, -1), strict=True):
            row = np.zeros(len(vertices))
            row[b], row[a] = 1.0, -1.0
            rows.append(row)
            wanted.append(matrices[t] @ (vertices[b] - vertices[a]))
    best = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
    best += vertices.mean(0) - best.mean(0)
    np.testing.assert_allclose(stitching(vertices, faces).vertices(matrices), best, atol=1e-10)


def test_one_matrix_for_all_triangles_is_a_linear_map():
    vertices, faces, _ = worm_mesh(2)
    matrix = np.random.default_rng(3).normal(size=(3, 3))
    found = stitching(vertices, faces).vertices(np.tile(matrix, (len(faces), 1, 1)))
    np.testing.assert_allclose(
        found, (vertices - vertices.mean(0)) @ matrix.T + vertices.mean(0), atol=1e-10
    )


def test_pieces_cannot_be_stitched():
    vertices, faces, _ = worm_mesh(1)
    with pytest.raises(HabitusError, match="2 pieces"):
        stitching(
            np.concatenate([vertices, vertices]), np.concatenate([faces, faces + len(vertices)])
        )
    with pytest.raises(HabitusError, match="2 pieces"):
        stitching(np.concatenate([vertices, vertices[:1]]), faces)
