"""The same body on a GPU: the same numbers, on its device, with gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import synthetic_body

import habitus
from habitus.body.jacobians import surface_jacobian

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
skinnings = pytest.mark.parametrize("skinning", ["lbs", "dqbs"])


def random_state(body, batch: int, dtype: torch.dtype) -> list[torch.Tensor]:
    make = torch.Generator().manual_seed(1)
    shapes = (batch, body.num_betas), (batch, body.num_joints, 3), (batch, 3)
    return [0.5 * torch.randn(shape, generator=make, dtype=dtype) for shape in shapes]


def tolerance(dtype: torch.dtype) -> float:
    return 2e-5 if dtype == torch.float32 else 1e-12


@dtypes
@skinnings
def test_surface_and_joints_are_those_of_the_processor(skinning, dtype):
    for body in (
        replace(synthetic_body(), skinning=skinning),
        replace(habitus.load_body("default"), skinning=skinning),
    ):
        state = random_state(body, 5, dtype)
        here = body(*state)
        there = body(*(part.cuda() for part in state))
        for name in ("vertices", "joints", "betas", "faces"):
            found = getattr(there, name)
            assert found.device.type == "cuda" and found.dtype == getattr(here, name).dtype
            assert (found.cpu() - getattr(here, name)).abs().max() < tolerance(dtype), name
        some = body(*(part.cuda() for part in state), vertices=[3, 1, 7]).vertices
        assert (some.cpu() - here.vertices[:, [3, 1, 7]]).abs().max() < tolerance(dtype)


@skinnings
def test_gradients_are_those_of_the_processor(skinning):
    body = replace(synthetic_body(), skinning=skinning)
    weights = torch.randn(
        4, body.num_vertices, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )

    def gradients(device: str) -> list[torch.Tensor]:
        state = [part.to(device).requires_grad_() for part in random_state(body, 4, torch.float64)]
        (body(*state).vertices * weights.to(device)).sum().backward()
        return [part.grad.cpu() for part in state]

    for here, there in zip(gradients("cpu"), gradients("cuda"), strict=True):
        assert (here - there).abs().max() < 1e-10 * max(1.0, float(here.abs().max()))


def test_jacobians_are_those_of_the_processor():
    body = synthetic_body()
    state = random_state(body, 2, torch.float64)
    here, there = (
        surface_jacobian(body, *(part.to(place) for part in state)) for place in ("cpu", "cuda")
    )
    for field in ("vertices_betas", "vertices_pose", "joints_betas", "joints_pose"):
        found = getattr(there, field)
        assert (
            found.device.type == "cuda" and (found.cpu() - getattr(here, field)).abs().max() < 1e-12
        ), field


def test_a_pose_by_names_and_numbers_beside_a_tensor_follow_its_device():
    body = habitus.load_body("default")
    bent = body([1.0], {"left_elbow": torch.tensor([0.0, -1.2, 0.0], device="cuda")})
    assert bent.vertices.device.type == "cuda"
    known = body([1.0], {"left_elbow": (0.0, -1.2, 0.0)})
    assert np.abs(bent.vertices.cpu().numpy() - known.vertices).max() < 2e-5
