"""Compiled gradients of the body function against automatic differentiation of its readable form,
which serves torch's transforms.
"""

from dataclasses import replace

import pytest
from synthetic import synthetic_body

from habitus.body.model import BodyModel
from habitus.io.models.bodies import load_body

torch = pytest.importorskip("torch")

BODIES = {
    "sparse blend shapes and hinges": lambda: load_body("female", joints="smpl"),
    "fingers and face": lambda: load_body("male", joints="smplx"),
    "dense blend shapes": lambda: synthetic_body("smpl", 300),
    "no blend shapes": lambda: replace(synthetic_body("smpl", 300), posedirs=None),
}


def some_state(body: BodyModel, *batch: int, dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)
    sizes = (body.num_betas,), (body.num_joints, 3), (3,)
    draws = [torch.randn(*batch, *size, generator=generator, dtype=dtype) for size in sizes]
    pose = 0.8 * draws[1]
    pose[..., 2, :] *= 1e-4
    pose[..., 3, :] = 0.0
    pose[..., 4, :] *= 0.1
    return [draws[0], pose, draws[2]]


def weighted(body: BodyModel, **options):
    """A function of the state that mixes all vertices and joints."""

    def value(betas, pose, trans):
        surface = body(betas, pose, trans, **options)
        ramp = [
            torch.linspace(-1, 2, part[..., 0].numel(), dtype=part.dtype).view_as(part[..., 0])
            for part in (surface.vertices, surface.joints)
        ]
        return (surface.vertices * ramp[0][..., None]).square().sum() + (
            surface.joints * ramp[1][..., None]
        ).sum()

    return value


def both(function, state):
    """Gradients by the compiled and by the readable form."""
    leaves = [part.clone().requires_grad_() for part in state]
    return (
        torch.autograd.grad(function(*leaves), leaves),
        torch.func.grad(function, argnums=(0, 1, 2))(*state),
    )


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_gradients_are_those_of_the_readable_form(name, batch):
    body = BODIES[name]()
    compiled, readable = both(weighted(body), some_state(body, *batch))
    for own, other in zip(compiled, readable, strict=True):
        assert (own - other).abs().max() < 1e-11 * other.abs().max()


@pytest.mark.parametrize("batch", [4, 8, 17, 66])
@pytest.mark.parametrize("dense", [False, True])
def test_bodies_side_by_side_fill_the_registers_or_not(dense, batch):
    """Vertices and gradients, for numbers of bodies and of vertices that no register divides."""
    body = synthetic_body("smpl", 301) if dense else BODIES["sparse blend shapes and hinges"]()
    value = weighted(body, vertices=range(0, body.num_vertices, 1 if dense else 21))
    state = some_state(body, batch)
    compiled, readable = both(value, state)
    single = both(value, [part.float() for part in state])[0]
    for own, other, rough in zip(compiled, readable, single, strict=True):
        assert (own - other).abs().max() < 1e-11 * other.abs().max()
        assert (rough - other).abs().max() < 1e-4 * other.abs().max()


def test_some_vertices_faces_and_single_precision():
    body = BODIES["fingers and face"]()
    units = {"jawOpen": 0.7, "eyeBlinkLeft": 0.4}
    options = {"vertices": [5, 900, 17], "face": units, "soft_tissue": [0.3, -0.2]}
    compiled, readable = both(weighted(body, **options), some_state(body, 5))
    for own, other in zip(compiled, readable, strict=True):
        assert (own - other).abs().max() < 1e-11 * other.abs().max()
    single = both(weighted(body), some_state(body, 5, dtype=torch.float32))[0]
    double = both(weighted(body), some_state(body, 5, dtype=torch.float32))[1]
    for own, other in zip(single, double, strict=True):
        assert own.dtype == torch.float32 and (own - other).abs().max() < 1e-4 * other.abs().max()


def test_one_shape_for_many_poses_and_one_pose_for_many_shapes():
    body = BODIES["sparse blend shapes and hinges"]()
    betas, pose, trans = some_state(body, 6)
    for state in ([betas[0], pose, trans], [betas, pose[:1], trans[0]]):
        compiled, readable = both(weighted(body), state)
        for own, other in zip(compiled, readable, strict=True):
            assert own.shape == other.shape
            assert (own - other).abs().max() < 1e-11 * other.abs().max()


def test_only_what_is_asked_for():
    body = BODIES["sparse blend shapes and hinges"]()
    state = some_state(body, 2)
    everything = both(weighted(body), state)[1]
    for k in range(3):
        leaves = [part.clone().requires_grad_(k == n) for n, part in enumerate(state)]
        (own,) = torch.autograd.grad(weighted(body)(*leaves), [leaves[k]])
        assert (own - everything[k]).abs().max() < 1e-11 * everything[k].abs().max()


@pytest.mark.parametrize("hinged", [False, True])
def test_gradients_can_be_differentiated_again(hinged):
    body = BODIES["sparse blend shapes and hinges"]() if hinged else synthetic_body("smpl", 40)
    pick = [0, 31] if hinged else [0, 5, 17]
    inputs = [part.requires_grad_() for part in some_state(body, 1)]

    def outputs(*state):
        surface = body(*state, vertices=pick)
        return surface.vertices.sum(-2), surface.joints[..., -3:, :]

    assert torch.autograd.gradgradcheck(outputs, inputs, atol=1e-4)


@pytest.mark.parametrize("batch", [2, 70])
def test_gradients_do_not_depend_on_the_number_of_threads(batch, monkeypatch):
    body = BODIES["sparse blend shapes and hinges"]()
    state = some_state(body, batch, dtype=torch.float32)
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        leaves = [part.clone().requires_grad_() for part in state]
        found.append(torch.autograd.grad(body(*leaves).vertices.square().sum(), leaves))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
