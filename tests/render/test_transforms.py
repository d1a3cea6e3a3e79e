"""Operators and plain functions beside torch's derivatives of every kind."""

import torch
from torch.autograd import forward_ad
from torch.testing import assert_close

from habitus.mesh.shapes import sphere
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.transforms import outside
from habitus.render.triangles import Triangles

BALL = sphere(6, 8)
TRIANGLES = Triangles.of(BALL.faces, BALL.vertices)


def picture(translation):
    camera = Camera.of(24, 18, translation=(0.0, 0.0, 3.0)).replace(translation=translation)
    return draw(camera, BALL.vertices, TRIANGLES).image(BALL.vertices)


def test_a_picture_is_the_same_with_and_without_derivatives():
    place = torch.tensor([0.1, 0.2, 3.0], dtype=torch.float64)
    plain = picture(place)
    leaf = place.clone().requires_grad_()
    derived = picture(leaf)
    assert derived.requires_grad and not plain.requires_grad
    with torch.no_grad():
        assert torch.equal(picture(leaf), plain)
    assert torch.equal(derived.detach(), plain)


def test_dual_numbers_get_the_same_derivative_as_func_jvp():
    place, step = torch.tensor([[0.1, 0.2, 3.0], [0.3, -0.2, 0.5]], dtype=torch.float64)
    _, expected = torch.func.jvp(picture, (place,), (step,))
    with torch.no_grad(), forward_ad.dual_level():
        found = forward_ad.unpack_dual(picture(forward_ad.make_dual(place, step))).tangent
    assert expected.abs().max() > 0.01
    assert_close(found, expected)


def test_outside_gives_plain_numbers_within_and_without_transforms():
    seen = []

    def take(numbers):
        seen.append(outside(lambda plain: plain.numpy().copy(), numbers).tolist())
        return numbers.sum()

    numbers = torch.tensor([1.0, 2.0], requires_grad=True)
    take(numbers)
    torch.func.grad(take)(numbers.detach())
    assert seen == [[1.0, 2.0]] * 2
