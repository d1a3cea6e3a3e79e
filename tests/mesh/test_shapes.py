import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.mesh.shapes import cube, icosphere, quadrilateral, sphere, tetrahedron, torus
from habitus.render.triangles import Triangles, welded

CLOSED = {
    "sphere": (sphere(7, 9), 2),
    "smallest sphere": (sphere(2, 3), 2),
    "torus": (torus(12, 7), 0),
    "icosahedron": (icosphere(0), 2),
    "icosphere": (icosphere(2), 2),
    "tetrahedron": (tetrahedron(), 2),
    "split tetrahedron": (tetrahedron(3), 2),
    "hard cube": (cube(), 2),
    "soft cube": (cube(hard=False), 2),
}
ROUND = [sphere(48, 96), icosphere(4)]


def volume(shape):
    a, b, c = shape.vertices[shape.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_without_unused_vertices_and_of_the_right_genus(name):
    shape, euler = CLOSED[name]
    triangles = Triangles.of(shape.faces, shape.vertices)
    assert (triangles.edge_start.diff() == 2).all()
    assert torch.equal(shape.faces.unique(), torch.arange(len(shape.vertices)))
    corners = np.unique(welded(shape.vertices.numpy()))
    assert len(corners) - len(triangles.edge_seam) + len(shape.faces) == euler
    if shape.uv is None:
        assert not triangles.edge_seam.any()


@pytest.mark.parametrize("name", CLOSED)
def test_every_edge_is_run_once_each_way_and_faces_look_outwards(name):
    shape, _ = CLOSED[name]
    triangles = Triangles.of(shape.faces, shape.vertices)
    tails = triangles.faces[triangles.edge_face, triangles.edge_corner].reshape(-1, 2)
    heads = triangles.faces[triangles.edge_face, (triangles.edge_corner + 1) % 3].reshape(-1, 2)
    assert torch.equal(shape.vertices[tails], shape.vertices[heads].flip(1))
    assert volume(shape) > 0
    if "torus" not in name:  # all others are star-shaped about the origin
        a, b, c = shape.vertices[shape.faces].unbind(1)
        assert ((a + b + c) * torch.linalg.cross(b - a, c - a)).sum(-1).min() > 0


def test_sizes():
    assert all(volume(shape) == pytest.approx(4 / 3 * np.pi, rel=5e-3) for shape in ROUND)
    assert all(
        torch.allclose(shape.vertices.norm(dim=1), torch.ones((), dtype=torch.float64))
        for shape in ROUND
    )
    assert volume(torus(200, 100, tube=0.3)) == pytest.approx(2 * np.pi**2 * 0.3**2, rel=2e-3)
    assert volume(cube()) == volume(cube(hard=False)) == pytest.approx(1)
    assert volume(tetrahedron(2)) == pytest.approx(volume(tetrahedron()))
    assert len(torus(84, 82).faces) == 13_776
    assert len(sphere(10, 20).faces) == 2 * 9 * 20 and len(icosphere(3).faces) == 20 * 4**3
    assert {shape.vertices.dtype for shape, _ in CLOSED.values()} == {torch.float64}


@pytest.mark.parametrize("shape", [sphere(5, 8), cube(), quadrilateral()])
def test_texture_coordinates_stay_in_the_image_and_are_not_mirrored(shape):
    assert shape.uv.min() == 0 and shape.uv.max() == 1
    a, b, c = shape.uv[shape.faces].unbind(1)
    (x, y), (s, t) = (b - a).unbind(1), (c - a).unbind(1)
    assert (
        x * t - y * s
    ).min() > 0  # counter-clockwise on the texture, as on the surface seen from outside


def test_a_globe_has_its_map_the_right_way_round():
    globe = sphere(8, 16)
    x, y, z = globe.vertices.T
    u, v = globe.uv.T
    away = (y.abs() < 1) & (u > 0) & (u < 1)
    assert torch.allclose(torch.asin(y), np.pi * (v - 0.5), atol=1e-12)
    assert torch.allclose(torch.atan2(x, z)[away], 2 * np.pi * (u[away] - 0.5), atol=1e-12)
    pole = (y.abs() == 1)[globe.faces]
    others = torch.where(pole, 0.0, u[globe.faces]).sum(1) / 2
    assert pole.sum() == 2 * 16 and torch.allclose(
        u[globe.faces][pole], others[pole.any(1)]
    )  # above their middle


def test_the_square_faces_its_viewer():
    square = quadrilateral()
    a, b, c = square.vertices[square.faces].unbind(1)
    assert torch.allclose(
        torch.linalg.cross(b - a, c - a).sum(0) / 2, torch.tensor([0.0, 0, 1], dtype=torch.float64)
    )


@pytest.mark.parametrize(
    "make", [lambda: sphere(1, 8), lambda: sphere(8, 2), lambda: torus(2, 5), lambda: icosphere(-1)]
)
def test_too_few_parts_are_refused(make):
    with pytest.raises(HabitusError, match="expected at least"):
        make()
