"""The marker function in torch: attachment and its laws."""

import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.observe.markers import (
    MarkerAttachment,
    attach,
    closest_triangles,
    predict_markers,
    triangle_bases,
)


def sheet(rng):
    points = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0), indexing="ij"), -1).reshape(-1, 2)
    vertices = np.concatenate([points, 0.1 * rng.normal(size=(16, 1))], 1)
    quads = [(i, i + 4, i + 5, i + 1) for i in range(11) if i % 4 < 3]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def test_markers_ride_rigidly_on_their_surface():
    rng = np.random.default_rng(0)
    vertices, faces = sheet(rng)
    markers = rng.uniform(0, 3, (9, 3))
    attachment = attach(markers, vertices, faces)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    moved = predict_markers(torch.tensor(vertices @ rotation.T + 2.0), attachment)
    np.testing.assert_allclose(moved, markers @ rotation.T + 2.0, atol=1e-12)


def test_each_marker_takes_its_closest_triangle():
    rng = np.random.default_rng(1)
    vertices, faces = sheet(rng)
    chosen = faces[[3, 8, 14]]
    above = vertices[chosen].mean(1) + np.array([0, 0, 0.01])
    np.testing.assert_array_equal(closest_triangles(above, vertices, faces), chosen)


def test_bases_are_right_handed_and_orthonormal():
    rng = np.random.default_rng(2)
    vertices, faces = sheet(rng)
    origin, basis = triangle_bases(torch.tensor(vertices), faces)
    np.testing.assert_allclose(origin, vertices[faces[:, 0]])
    np.testing.assert_allclose(
        basis.transpose(-1, -2) @ basis, np.broadcast_to(np.eye(3), basis.shape), atol=1e-12
    )
    np.testing.assert_allclose(torch.linalg.det(basis), np.ones(len(faces)), atol=1e-12)


def test_gradients_pass_through():
    rng = np.random.default_rng(3)
    vertices, faces = sheet(rng)
    attachment = attach(rng.uniform(0, 3, (4, 3)), vertices, faces)
    start = torch.tensor(vertices, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: predict_markers(v, attachment), start)


@pytest.mark.wrong_shapes
def test_bad_input_is_refused_in_one_line():
    rng = np.random.default_rng(4)
    vertices, faces = sheet(rng)
    with pytest.raises(HabitusError, match="finite"):
        attach(np.full((2, 3), np.nan), vertices, faces)
    with pytest.raises(HabitusError, match="no area"):
        attach(np.zeros((1, 3)), vertices, faces, triangles=np.array([[0, 0, 1]]))
    with pytest.raises(HabitusError, match="triangles"):
        MarkerAttachment(np.zeros((2, 3)), np.zeros((1, 3)))
