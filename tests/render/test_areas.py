"""Boundary mode "exact": pixels are means over what shows in them, and derivatives are those of the
means.
"""

import numpy as np
import pytest
import torch
from scenes import SCENES, camera, scene

from habitus.mesh.shapes import icosphere, quadrilateral
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.jacobians.images import depth_jacobian, image_jacobian
from habitus.render.triangles import Triangles, join


def boxes(image, times):
    height = image.shape[0] // times
    width = image.shape[1] // times
    return image.unflatten(0, (height, times)).unflatten(2, (width, times)).mean((1, 3))


def noise(seed, *shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("name", SCENES)
def test_a_pixel_is_the_mean_of_its_parts(name):
    """Whatever the mesh and its colours: thin parts, T-junctions and surfaces through each other
    among them.
    """
    view, vertices, triangles = scene(name)
    colours = noise(1, len(vertices), 3)
    image = draw(view, vertices, triangles, "exact").image(colours, 0.1)
    finer = draw(view.scaled(3), vertices, triangles, "exact")
    apart = (image - boxes(finer.image(colours, 0.1), 3)).abs()
    assert (
        apart.max() < 1e-2 and apart.mean() < 1e-4
    )  # a part is its value at its centroid: perspective bends a little
    fine = boxes(draw(view.scaled(12), vertices, triangles, "none").image(colours, 0.1), 12)
    wrong, before = (
        (at - fine).abs().mean()
        for at in (image, draw(view, vertices, triangles).image(colours, 0.1))
    )
    assert wrong < 0.5 * before


def test_parts_of_a_pixel_add_up_to_it():
    view, vertices, triangles = scene("soup")
    frame = draw(view, vertices, triangles, "exact")
    fragments = frame.visibility.fragments
    count = view.width * view.height
    total = torch.zeros(count, dtype=torch.float64).index_add(0, fragments.pixel, fragments.weight)
    several = fragments.pixel[fragments.weight != 0].unique()
    torch.testing.assert_close(total[several], torch.ones(len(several), dtype=torch.float64))
    assert (fragments.weight >= 0).all() and len(several) > 300
    assert (fragments.weight[fragments.start != fragments.end] == 0).all()


def view_of_ball(dtype=torch.float64):
    """A ball of few triangles, each of a pixel or two, before a camera of 14 x 12 pixels."""
    ball = icosphere(1)
    turn = torch.linalg.qr(noise(3, 3, 3) - 0.5)[0]
    return (
        Camera.of(14, 12, 160.0, translation=[0.03, -0.02, 31.0]),
        (ball.vertices @ turn).to(dtype),
        ball.faces,
    )


@pytest.mark.parametrize("kind", ["colours", "depth", "silhouette"])
def test_derivatives_are_those_of_the_picture(kind):
    """What the default mode cannot promise: finite differences of its own pictures, where colours
    and depth vary.
    """
    view, vertices, faces = view_of_ball()
    triangles = Triangles.of(faces, vertices)
    colours = noise(2, len(vertices), 2)

    def picture(points):
        frame = draw(view, points, triangles, "exact")
        if kind == "colours":
            return frame.image(colours, 0.3)
        return frame.silhouette() if kind == "silhouette" else frame.depth(33.0)

    step = noise(4, *vertices.shape) - 0.5
    size = 1e-6
    _, found = torch.func.jvp(picture, (vertices,), (step,))
    expected = (picture(vertices + size * step) - picture(vertices - size * step)) / (2 * size)
    assert (found - expected).norm() < 2e-3 * expected.norm()

    cotangent = noise(7, *found.shape)
    points = vertices.clone().requires_grad_()
    (picture(points) * cotangent).sum().backward()
    torch.testing.assert_close((points.grad * step).sum(), (found * cotangent).sum())


def test_sparse_jacobians_are_the_same():
    view, vertices, triangles = scene("torus")
    colours = noise(1, len(vertices), 2)
    step = noise(2, *vertices.shape) - 0.5

    def frame(points):
        return draw(view, points, triangles, "exact")

    _, found = torch.func.jvp(
        lambda points: frame(points).image(colours, 0.2), (vertices,), (step,)
    )
    sparse = image_jacobian(frame(vertices), colours, 0.2).to_vertices(view, vertices)
    np.testing.assert_allclose(
        sparse @ step.numpy().ravel(), found.numpy().ravel(), atol=1e-9 * float(found.norm())
    )
    _, found = torch.func.jvp(lambda points: frame(points).depth(9.0), (vertices,), (step,))
    sparse = depth_jacobian(frame(vertices), 9.0).to_vertices(view, vertices)
    np.testing.assert_allclose(
        sparse @ step.numpy().ravel(), found.numpy().ravel(), atol=1e-9 * float(found.norm())
    )


def test_float32_and_threads(monkeypatch):
    view, vertices, triangles = scene("torus")
    exact = draw(view, vertices, triangles, "exact").image(vertices)
    images = []
    for threads in ("1", "3"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        images.append(
            draw(view.to(torch.float32), vertices.float(), triangles, "exact").image(
                vertices.float()
            )
        )
    assert torch.equal(*images) and images[0].dtype == torch.float32
    assert (images[0] - exact).abs().max() < 1e-3


@pytest.mark.parametrize("boundary", ["antialias", "exact", "none"])
def test_surfaces_that_pass_through_each_other_are_told(boundary):
    view = Camera.of(40, 30, 40.0, translation=[0.0, 0.0, 2.0])
    sheet = quadrilateral()
    flat = sheet.vertices @ torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0]]).double()
    tilted = flat.clone()
    tilted[:, 2] = 0.9 * flat[:, 0] + 0.05  # it crosses the other where x = -0.05 / 0.9
    parts = Triangles.of(sheet.faces, flat)
    frame = draw(view, torch.cat([flat, tilted]), join(parts, parts), boundary)
    place = 20 + 40 * (-0.05 / 0.9) / 2
    columns = frame.intersections.any(0).nonzero()[:, 0]
    assert columns.tolist() == [int(place)]
    assert frame.intersections.sum() >= 18
    if boundary == "exact":
        colours = torch.cat([torch.zeros(4, 1), torch.ones(4, 1)]).double()
        share = frame.image(colours)[15, int(place), 0]
        assert (
            abs(share - (place - int(place))) < 1e-3 or abs(share - (1 - place + int(place))) < 1e-3
        )
    clear = draw(
        view,
        torch.cat([flat, tilted - torch.tensor([0, 0, 3.0]) * 0.3]),
        join(parts, parts),
        boundary,
    )
    ball = icosphere(2)
    assert not draw(camera(), ball.vertices, ball.faces, boundary).intersections.any()
    assert not clear.intersections.any()
