"""The compiled kernels agree with the reference in plain torch."""

import pytest
import torch
from scenes import SCENES, scene

from habitus.render import operators
from habitus.render.clipping import clip_near
from habitus.render.rasterize import list_all_faces, rasterize, rasterize_reference
from habitus.render.reference import images as reference
from habitus.render.triangles import EdgeFragments, list_pixels_reference

SIZE = 48, 36


def screen_of(name):
    camera, vertices, triangles = scene(name)
    points = camera.to_camera(vertices)
    clipped = clip_near(points, triangles, camera.near)
    if clipped is not None:
        points = clipped.points
        triangles = clipped.triangles
    return torch.cat([camera.project_camera_points(points), points[:, 2:]], -1), triangles


@pytest.mark.parametrize("cull", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_what_is_seen(name, cull):
    screen, triangles = screen_of(name)
    fast = rasterize(screen, triangles, *SIZE, cull, True)
    slow = rasterize_reference(screen, triangles, *SIZE, cull, True)
    assert torch.equal(fast.ids.long(), slow.ids.long()) and (fast.ids >= 0).any()
    listed = fast.pixels, fast.faces[: len(fast.pixels)], fast.points[: len(fast.pixels)]
    assert all(
        torch.equal(x, y) for x, y in zip(listed, list_pixels_reference(slow.ids), strict=True)
    )
    a, b = (_in_order(visibility.fragments) for visibility in (fast, slow))
    assert len(a.pixel) > 20
    for name in EdgeFragments.__dataclass_fields__:
        x = getattr(a, name)
        y = getattr(b, name)
        assert x.shape == y.shape, name
        if x.is_floating_point():
            torch.testing.assert_close(
                x, y.to(x.dtype), rtol=0, atol=1e-6, msg=lambda text, name=name: f"{name}: {text}"
            )
        else:
            same = (x == y).double().mean()
            assert same == 1.0 if name not in ("inner_face", "outer_face") else same > 0.99, name


@pytest.mark.parametrize("size", [SIZE, (160, 120), (640, 480)])
def test_faces_listed_around_edges_alone_give_the_same_fragments(size, monkeypatch):
    camera, vertices, triangles = scene("torus")
    screen = camera.replace(width=size[0], height=size[1]).screen(vertices)
    screen = screen * torch.tensor([size[0] / SIZE[0], size[1] / SIZE[1], 1.0])

    def fragments():
        return rasterize(screen, triangles, *size, False, True).fragments

    around = fragments()
    monkeypatch.setattr(
        "habitus.render.rasterize._tiles_around",
        lambda on_screen, bounds, *_: list_all_faces(on_screen.facing, bounds, *size),
    )
    everywhere = fragments()
    assert len(around.pixel) > 100
    for name in EdgeFragments.__dataclass_fields__:
        assert torch.equal(getattr(around, name), getattr(everywhere, name)), name


def _in_order(fragments):
    order = sorted(
        range(len(fragments.pixel)),
        key=lambda n: (
            int(fragments.pixel[n]),
            int(fragments.tail[n]),
            int(fragments.head[n]),
            float(fragments.start[n]),
        ),
    )
    return EdgeFragments(
        *(
            getattr(fragments, name)[torch.tensor(order, dtype=torch.long)]
            for name in EdgeFragments.__dataclass_fields__
        )
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_and_images(dtype):
    screen, triangles = screen_of("soup")
    visibility = rasterize(screen, triangles, *SIZE, False, True)
    screen = screen.to(dtype).requires_grad_()
    points = visibility.points.to(dtype)
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(len(screen), 3, generator=generator, dtype=dtype).requires_grad_()
    background = torch.randn(
        SIZE[0] * SIZE[1], 3, generator=generator, dtype=dtype
    ).requires_grad_()
    weights = torch.rand(len(visibility.inner), generator=generator, dtype=dtype).requires_grad_()
    cotangent = torch.randn(SIZE[0] * SIZE[1], 3, generator=generator, dtype=dtype)
    inputs = screen, values, background, weights
    corners = triangles.faces[visibility.faces]

    fast = operators.interpolate(
        values,
        triangles.faces,
        visibility.faces,
        operators.barycentrics(screen, triangles.faces, visibility.faces, points),
    )
    fast = operators.compose(fast, background, weights, visibility)
    slow = reference.interpolate(values, corners, reference.barycentrics(screen, corners, points))
    slow = reference.compose(slow, background, weights, visibility)
    tolerance = (
        {"rtol": 1e-4, "atol": 1e-3} if dtype == torch.float32 else {"rtol": 1e-9, "atol": 1e-9}
    )
    torch.testing.assert_close(fast, slow, **tolerance)
    for a, b in zip(
        *(torch.autograd.grad((image * cotangent).sum(), inputs) for image in (fast, slow)),
        strict=True,
    ):
        torch.testing.assert_close(
            a, b, rtol=tolerance["rtol"], atol=tolerance["atol"] * float(b.abs().max())
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [0, 1, 2, 3, 5])
@pytest.mark.parametrize("rows", [1, SIZE[0] * SIZE[1]])
def test_images_in_one_go(dtype, channels, rows):
    screen, triangles = screen_of("torus")
    visibility = rasterize(screen, triangles, *SIZE, False, True)
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(len(screen), channels, generator=generator, dtype=dtype)
    background = torch.randn(rows, channels, generator=generator, dtype=dtype)
    if rows == 1 and channels == 1:
        background[:] = torch.inf  # as depth has it: what jumps there is left out
    weights = torch.rand(len(visibility.inner), generator=generator, dtype=dtype)
    inputs = tuple(x.requires_grad_() for x in (screen.to(dtype), values, background, weights))
    cotangent = torch.randn(SIZE[0] * SIZE[1], channels, generator=generator, dtype=dtype)

    def in_steps(screen, values, background, weights):
        corners = triangles.faces[visibility.faces]
        found = reference.interpolate(
            values, corners, reference.barycentrics(screen, corners, visibility.points)
        )
        return reference.compose(found, background, weights, visibility)

    def at_once(screen, values, background, weights):
        return operators.image(screen, triangles.faces, values, background, weights, visibility)

    fast = at_once(*inputs)
    slow = in_steps(*inputs)
    tolerance = (
        {"rtol": 1e-4, "atol": 1e-3} if dtype == torch.float32 else {"rtol": 1e-9, "atol": 1e-9}
    )
    torch.testing.assert_close(fast, slow, **tolerance)
    gradients = [torch.autograd.grad(image, inputs, cotangent) for image in (fast, slow)]
    for a, b in zip(*gradients, strict=True):
        most = float(b.abs().max()) if b.numel() else 0.0
        torch.testing.assert_close(a, b, rtol=tolerance["rtol"], atol=tolerance["atol"] * most)
    steps = tuple(torch.randn(x.shape, generator=generator, dtype=dtype) for x in inputs)
    forward = torch.func.jvp(at_once, tuple(x.detach() for x in inputs), steps)[1]
    there = sum((a * b).sum() for a, b in zip(gradients[0], steps, strict=True))
    torch.testing.assert_close(
        (forward * cotangent).sum(),
        there,
        rtol=max(tolerance["rtol"], 1e-8),
        atol=1e-2 if dtype == torch.float32 else 1e-8,
    )


def test_forward_mode_agrees_with_backward():
    screen, triangles = screen_of("torus")
    visibility = rasterize(screen, triangles, *SIZE, False, True)
    values = torch.randn(
        len(screen), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    weights = visibility.fragments.weight
    background = torch.ones(1, 2, dtype=torch.float64)

    def image(screen, values, weights, background):
        at = operators.barycentrics(screen, triangles.faces, visibility.faces, visibility.points)
        found = operators.interpolate(values, triangles.faces, visibility.faces, at)
        return operators.compose(found, background, weights, visibility)

    inputs = screen, values, weights, background
    generator = torch.Generator().manual_seed(2)
    steps = tuple(torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in inputs)
    cotangent = torch.randn(SIZE[0] * SIZE[1], 2, generator=generator, dtype=torch.float64)
    forward = torch.func.jvp(image, inputs, steps)[1]
    backward = torch.func.vjp(image, *inputs)[1](cotangent)
    torch.testing.assert_close(
        (forward * cotangent).sum(),
        sum((a * b).sum() for a, b in zip(backward, steps, strict=True)),
    )
