from dataclasses import replace

import torch
from synthetic import synthetic_body

from habitus.body.skinning import Influences, skin
from habitus.rotations import matrix_from_rotvec


def strip(bend: torch.Tensor):
    """Two joints at the same place, the second turned: points half carried by each."""
    turn = matrix_from_rotvec(bend.to(torch.float64))
    motions = torch.zeros(2, 3, 4, dtype=torch.float64)
    motions[0, :, :3], motions[1, :, :3] = torch.eye(3), turn
    rest = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0.3, 0.4, 0.5]], dtype=torch.float64).T
    half = torch.full((3, 2), 0.5, dtype=torch.float64)
    return (
        rest,
        motions,
        torch.zeros(3, dtype=torch.float64),
        Influences(half.T, torch.tensor([[0, 1]] * 3), half),
    )


def test_dual_quaternions_turn_half_way_where_linear_blending_shrinks():
    bend = torch.tensor([0.0, 0, 2.0])
    rest, motions, origin, influences = strip(bend)
    halfway = rest.T @ matrix_from_rotvec(bend.double() / 2).T
    assert torch.allclose(skin("dqbs", rest, motions, origin, influences), halfway, atol=1e-14)
    linear = skin("lbs", rest, motions, origin, influences)
    assert (linear.norm(dim=1)[:2] < 0.6).all()


def test_dual_quaternion_skinning_does_not_see_the_sign_of_a_quaternion():
    for bend in (
        3.0,
        3.3,
        -3.0,
    ):  # past half a turn the short way changes side; never through the inside
        rest, motions, origin, influences = strip(torch.tensor([0.0, 0, bend]))
        assert torch.allclose(
            skin("dqbs", rest, motions, origin, influences).norm(dim=1),
            rest.norm(dim=0),
            atol=1e-12,
        )


def test_a_vertex_with_one_joint_moves_rigidly_in_both():
    body = synthetic_body("smpl", 80, influences=1)
    torch.manual_seed(0)
    pose = torch.randn(24, 3, dtype=torch.float64)
    linear = body(pose=pose).vertices
    dual = replace(body, skinning="dqbs")(pose=pose).vertices
    assert torch.allclose(linear, dual, atol=1e-12)
