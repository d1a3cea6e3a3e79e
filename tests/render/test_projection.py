"""The compiled projection against the camera's own formulas, values and derivatives of every
kind.
"""

import math

import pytest
import torch

from habitus.observe.camera import Camera
from habitus.render.derivatives import project

LENSES = {
    "none": None,
    "zero": (0.0,) * 8,
    "bent": (-0.2, 0.05, 0.002, -0.003, 0.01, 0.02, -0.01, 0.004),
}


def camera(lens, dtype) -> Camera:
    return Camera.of(
        64,
        48,
        (70.0, 65.0),
        (31.0, 25.0),
        (0.3, -0.2, 0.1),
        (0.1, -0.2, 3.0),
        LENSES[lens],
        dtype=dtype,
    )


def points(dtype) -> torch.Tensor:
    return torch.rand(40, 3, dtype=dtype, generator=torch.Generator().manual_seed(1)) - 0.5


def numbers(of: Camera) -> tuple[torch.Tensor, ...]:
    found = (of.focal_length, of.principal_point, of.rotation, of.translation, of.distortion)
    return tuple(value for value in found if value is not None)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("lens", LENSES)
def test_the_screen_is_the_cameras(lens, dtype):
    found = project(camera(lens, dtype), points(dtype))
    expected = camera(lens, dtype).screen(points(dtype))
    assert found.dtype == dtype
    torch.testing.assert_close(
        found, expected, atol=1e-4 if dtype == torch.float32 else 1e-11, rtol=0
    )


@pytest.mark.parametrize("lens", LENSES)
def test_derivatives_in_both_directions_are_the_cameras(lens):
    start = camera(lens, torch.float64)
    around = points(torch.float64)

    def screens(screen):
        return lambda points, *given: screen(Camera(64, 48, *given), points)

    fast = screens(project)
    slow = screens(lambda camera, points: camera.screen(points))
    leaves = tuple(value.clone().requires_grad_() for value in (around, *numbers(start)))
    cotangent = torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found, expected = (torch.autograd.grad(f(*leaves), leaves, cotangent) for f in (fast, slow))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-9, rtol=1e-10)
    steps = tuple(torch.randn_like(value) for value in leaves)
    given = tuple(value.detach() for value in leaves)
    found, expected = (torch.func.jvp(f, given, steps)[1] for f in (fast, slow))
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-10)


def test_where_the_lens_folds_back_nothing_is_seen_and_nothing_moves():
    folding = Camera.of(64, 48, distortion=(-0.5, 0.0, 0.0, 0.0), dtype=torch.float64)
    limit = math.sqrt(folding.valid_radius_squared())
    across = torch.tensor(
        [[0.9 * limit, 0.0, 1.0], [1.1 * limit, 0.0, 1.0]], dtype=torch.float64, requires_grad=True
    )
    screen = project(folding, across)
    assert screen[0].isfinite().all() and screen[1].isnan().all()
    (found,) = torch.autograd.grad(screen[:, 0].nan_to_num().sum(), across)
    assert found[0].abs().max() > 1 and (found[1] == 0).all()
