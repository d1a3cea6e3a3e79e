import math
from dataclasses import replace

import pytest
import torch
from synthetic import synthetic_body, with_features

from habitus.body.jacobians import surface_jacobian
from habitus.body.pose_features import POSE_FEATURES

SCALES = (0.0, 1e-9, 1e-3, 0.5, math.pi - 1e-6, math.pi)
skinnings = pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
PICK = [0, 17, 33, 101]


def case(skinning: str, scale: float, family: str = "smpl", **changes):
    body = replace(synthetic_body(family, 120), skinning=skinning, **changes)
    torch.manual_seed(1)
    betas = torch.randn(body.num_betas).double()
    trans = torch.randn(3).double()
    pose = scale * torch.nn.functional.normalize(torch.randn(body.num_joints, 3).double(), dim=-1)
    return body, betas, pose, trans


def outputs(body, trans):
    def run(betas, pose):
        surface = body(betas, pose, trans, vertices=PICK)
        return surface.vertices, surface.joints

    return run


@skinnings
@pytest.mark.parametrize("scale", SCALES)
def test_analytic_is_autodiff_at_every_angle(skinning, scale):
    body, betas, pose, trans = case(skinning, scale)
    (by_betas, by_pose), (joints_betas, joints_pose) = torch.func.jacrev(
        outputs(body, trans), (0, 1)
    )(betas, pose)
    found = surface_jacobian(body, betas, pose, trans, vertices=PICK)
    vertices, joints = outputs(body, trans)(betas, pose)
    pairs = [
        (found.surface.vertices, vertices),
        (found.surface.joints, joints),
        (found.vertices_betas, by_betas),
        (found.vertices_pose, by_pose),
        (found.joints_betas, joints_betas),
        (found.joints_pose, joints_pose),
    ]
    for ours, theirs in pairs:
        assert ours.shape == theirs.shape and (ours - theirs).abs().max() < 1e-12


@skinnings
@pytest.mark.parametrize("scale", SCALES)
def test_analytic_is_what_small_steps_show(skinning, scale):
    scale = (
        min(scale, 3.0) if skinning == "dqbs" else scale
    )  # neighbours half a turn apart change side there
    body, betas, pose, trans = case(skinning, scale)
    found = surface_jacobian(body, betas, pose, trans, vertices=PICK)
    run = outputs(body, trans)
    step = 1e-5
    for _ in range(4):
        along_betas = torch.randn_like(betas)
        along_pose = torch.randn_like(pose)
        ahead = run(betas + step * along_betas, pose + step * along_pose)
        behind = run(betas - step * along_betas, pose - step * along_pose)
        for (a, b), by_betas, by_pose in zip(
            zip(ahead, behind, strict=True),
            (found.vertices_betas, found.joints_betas),
            (found.vertices_pose, found.joints_pose),
            strict=True,
        ):
            predicted = by_betas @ along_betas + (by_pose * along_pose).sum((-2, -1))
            assert ((a - b) / (2 * step) - predicted).abs().max() < 2e-8


@skinnings
@pytest.mark.parametrize("shapes", [0, 2])
@pytest.mark.parametrize("name", POSE_FEATURES)
@pytest.mark.parametrize(
    ("dtype", "joints"), [(torch.float32, None), (torch.float64, None), (torch.float64, (9, 2, 14))]
)
def test_all_pose_features_have_their_exact_derivatives(dtype, joints, name, shapes, skinning):
    for scale in (0.0, 1e-6, 0.7, 3.0):
        body, betas, pose, trans = case(skinning, scale, "mano")
        body = with_features(body, name, shapes, joints)
        betas, pose, trans = (value.to(dtype) for value in (betas, pose, trans))
        by_betas, by_pose = torch.func.jacrev(outputs(body, trans), (0, 1))(betas, pose)[0]
        found = surface_jacobian(body, betas, pose, trans, vertices=PICK)
        tolerance = 2e-5 if dtype == torch.float32 else 1e-12
        assert (
            found.surface.vertices - outputs(body, trans)(betas, pose)[0]
        ).abs().max() < tolerance
        assert (
            found.vertices_betas.dtype == dtype
            and (found.vertices_betas - by_betas).abs().max() < tolerance
        )
        assert (found.vertices_pose - by_pose).abs().max() < tolerance


@pytest.mark.parametrize("name", POSE_FEATURES)
def test_batches_of_shapes_that_pose_blend_shapes_depend_on(name):
    body, betas, pose, trans = case("lbs", 0.7, "mano")
    body = with_features(body, name, 3)
    shapes = torch.stack([betas, -betas])
    poses = torch.stack([pose, 0.3 * pose, -pose])[:, None]
    batch = surface_jacobian(body, shapes, poses, trans, vertices=PICK)
    alone = surface_jacobian(body, -betas, 0.3 * pose, trans, vertices=PICK)
    shared = surface_jacobian(body, -betas, poses, trans, vertices=PICK)
    for field in ("vertices_betas", "vertices_pose"):
        assert getattr(batch, field).shape[:2] == (3, 2)
        assert (getattr(batch, field)[1, 1] - getattr(alone, field)).abs().max() < 1e-12
        assert (getattr(shared, field)[1, 0] - getattr(alone, field)).abs().max() < 1e-12


@skinnings
def test_batches_families_and_missing_pose_blend_shapes(skinning):
    for family, changes in (("mano", {}), ("smplx", {}), ("smpl", {"posedirs": None})):
        body, betas, pose, trans = case(skinning, 0.7, family, **changes)
        shapes = torch.stack([betas, -betas]).expand(3, 2, -1)
        poses = torch.stack([pose, 0.3 * pose]).expand(3, 2, -1, -1)
        batch = surface_jacobian(body, shapes, poses, vertices=PICK)
        alone = surface_jacobian(body, -betas, 0.3 * pose, vertices=PICK)
        for name in ("vertices_betas", "vertices_pose", "joints_betas", "joints_pose"):
            assert (getattr(batch, name)[2, 1] - getattr(alone, name)).abs().max() < 1e-12
        (by_pose, _) = torch.func.jacrev(outputs(body, 0 * trans), 1)(-betas, 0.3 * pose)
        assert (alone.vertices_pose - by_pose).abs().max() < 1e-12
        shared = surface_jacobian(body, betas, poses, vertices=PICK)  # one shape for many poses
        assert (shared.vertices_pose[0, 0] - batch.vertices_pose[0, 0]).abs().max() < 1e-12


def test_single_precision_follows():
    body, betas, pose, trans = case("lbs", 1.0)
    exact = surface_jacobian(body, betas, pose, trans, vertices=PICK)
    single = [value.float() for value in (betas, pose, trans)]
    found = surface_jacobian(body, *single, vertices=PICK)
    assert (found.vertices_pose - exact.vertices_pose).abs().max() < 1e-5
    assert found.vertices_betas.dtype == torch.float32
