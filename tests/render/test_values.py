"""Numbers of every type that arrive from a user: converted, or refused in one clear line."""

import itertools

import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.mesh.shapes import icosphere, sphere
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.kernels import samples, surfaces, surfaces_vjp
from habitus.render.kernels import textures as texture_kernels
from habitus.render.textures import Texture
from habitus.render.transforms import of_one_type

VIEW = Camera.of(16, 12, translation=[0.0, 0.0, 3.0])
BALL = icosphere(1)
REAL = (torch.float32, torch.float64)


@pytest.mark.parametrize(
    "kind", [torch.bool, torch.uint8, torch.int32, torch.int64, torch.float16, torch.bfloat16]
)
@pytest.mark.parametrize("dtype", REAL)
def test_whole_numbers_and_truth_values_keep_their_antialiased_borders(kind, dtype):
    frame = draw(VIEW.to(dtype), BALL.vertices.to(dtype), BALL.faces)
    values = torch.arange(len(BALL.vertices))[:, None].remainder(2).to(kind)
    expected = frame.image(values.to(dtype), 1.0)
    for found in (
        frame.image(values, torch.tensor(True)),
        frame.image(values.double().numpy(), [1]).to(dtype),
    ):
        assert found.dtype == dtype
        torch.testing.assert_close(found, expected)
    assert ((expected % 1) != 0).any()
    at = frame.at_samples(values)
    assert at.dtype == dtype and torch.equal(at, frame.at_samples(values.to(dtype)))
    ones = torch.ones(len(at), 1)
    torch.testing.assert_close(frame.compose(ones.to(kind))[..., 0], frame.silhouette())


def test_vertices_may_be_arrays_and_lists():
    expected = draw(VIEW, BALL.vertices, BALL.faces).depth()
    for given in (BALL.vertices.numpy(), BALL.vertices.tolist()):
        assert torch.equal(draw(VIEW, given, BALL.faces).depth(), expected)


@pytest.mark.parametrize("boundary", ["antialias", "filter", "none"])
def test_kernels_are_compiled_for_two_types_only(boundary):
    """No mixture of types reaches a kernel, each of which would compile for seconds."""
    kernels = [
        *(getattr(surfaces, name) for name in ("draw_values", "draw_depths", "draw_jumps")),
        surfaces_vjp.draw_values_vjp,
        *(getattr(samples, name) for name in ("interpolate", "interpolate_vjp", "barycentrics")),
        *(
            getattr(texture_kernels, name)
            for name in ("sample_texels", "sample_texels_vjp", "sample_uv_vjp")
        ),
    ]
    known = {kernel: set(kernel.signatures) for kernel in kernels}
    globe = sphere(6, 8)
    for first, second, third in itertools.product(REAL, repeat=3):
        vertices = globe.vertices.clone().to(first).requires_grad_()
        values, uv = (at.clone().to(second).requires_grad_() for at in (globe.vertices, globe.uv))
        behind = torch.zeros(12, 16, 3, dtype=third)
        texels = torch.rand(4, 4, 3, dtype=third).requires_grad_()
        frame = draw(VIEW.to(first), vertices, globe.faces, boundary)
        image = frame.image(values, behind)
        textured = frame.textured(Texture.of(texels), uv, globe.faces.int(), values)
        assert image.dtype == torch.promote_types(first, second)
        (image.sum() + textured.sum() + frame.depth(behind[..., 0]).sum()).backward()
        assert (vertices.grad.dtype, values.grad.dtype, uv.grad.dtype, texels.grad.dtype) == (
            first,
            second,
            second,
            third,
        )
    for kernel in kernels:
        for signature in set(kernel.signatures) - known[kernel]:
            kinds = {
                str(part.dtype)
                for part in signature
                if getattr(part, "ndim", 0) and "float" in str(part.dtype)
            }
            assert len(kinds - {"float64"}) <= 1, (kernel.__name__, signature)


def test_mixed_types_are_the_wider_one():
    narrow = torch.ones(2)
    wide = torch.ones(2, dtype=torch.float64)
    assert [x.dtype for x in of_one_type(narrow, wide)] == [torch.float64] * 2
    assert [x.dtype for x in of_one_type(narrow, narrow)] == [torch.float32] * 2


def test_what_cannot_be_drawn_is_one_clear_line():
    frame = draw(VIEW, BALL.vertices, BALL.faces)
    points = BALL.vertices
    globe = sphere(6, 8)
    texture = Texture.of(torch.rand(4, 4, 3))
    two = torch.ones(len(globe.uv), 2)
    ball = draw(VIEW, globe.vertices, globe.faces)
    cases = [
        (lambda: draw(VIEW, points[None][:0], BALL.faces), r"vertices are a batch of \(0,\)"),
        (
            lambda: draw(VIEW.replace(translation=torch.zeros(0, 3).double()), points, BALL.faces),
            "cameras are a batch",
        ),
        (
            lambda: draw(VIEW.to(torch.float16), points.half(), BALL.faces),
            "float16; expected .* float32 or float64",
        ),
        (lambda: draw(VIEW, ["ball"], BALL.faces), "vertices is of type list"),
        (lambda: frame.image(points.to(torch.complex64)), "complex64; expected real numbers"),
        (lambda: frame.image(points, [0.0, 1.0]), r"background is \(2,\)"),
        (lambda: frame.image(points, torch.zeros(12, 16, 2)), "background is"),
        (lambda: frame.image(points, ["sky"]), "background is of type list"),
        (lambda: frame.normals(points[:, :2]), "normals have 2 numbers"),
        (lambda: frame.compose(torch.ones(3, 1)), r"values at samples are \(3, 1\)"),
        (lambda: frame.compose(torch.ones(3)), r"values at samples are \(3,\)"),
        (
            lambda: ball.textured(texture, globe.uv, brightness=two),
            "brightness has 2 channels",
        ),
        (lambda: ball.textured(texture, globe.uv.half()), "float16; expected"),
        (lambda: frame.image(np.array(["a"] * 42)[:, None]), "values is of type ndarray"),
    ]
    for call, words in cases:
        with pytest.raises(HabitusError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)
