"""Posing in training is the body's own, linear in what it is said to be linear in, with exact
derivatives.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_rigs import PARENTS, as_body, people, poses, small_body, small_rig, torch_surface

from habitus.body.pose_features import POSE_FEATURES
from habitus.body.skinning import SKINNING
from habitus.learn.posing.rig import RestPerson, influences, kinship
from habitus.learn.posing.surface import posed, rest_surface, skeleton, surface
from habitus.learn.steps.poses import surface_jacobians
from habitus.rotations import matrix_from_rotvec

SMALL = small_body(pairs=4, middle=2)


def rigs(*shape_features):
    """Every skinning with every kind of features."""
    return pytest.mark.parametrize(
        "rig",
        [
            pytest.param(
                small_rig(SMALL, 1, skinning, features, s), id=f"{skinning}-{features}-{s}"
            )
            for skinning in SKINNING
            for features in POSE_FEATURES
            for s in shape_features
        ],
    )


every = rigs(0, 2)
skinnings = pytest.mark.parametrize("skinning", list(SKINNING))


@every
def test_surfaces_are_the_body_models(rig):
    rng = np.random.default_rng(0)
    shapedirs = 0.03 * rng.normal(size=(len(SMALL.vertices), 3, 3))
    body = as_body(rig, SMALL, shapedirs)
    betas = rng.normal(size=3)
    template = SMALL.vertices + shapedirs @ betas
    person = RestPerson(template, SMALL.regressor @ template, betas[: rig.shape_features])
    for pose in poses(4, largest=3.0):
        theirs = body(torch.from_numpy(betas), torch.from_numpy(pose))
        assert np.abs(surface(rig, person, pose) - theirs.vertices.numpy()).max() < 1e-12
        assert (
            np.abs(skeleton(PARENTS, pose).positions(person.joints) - theirs.joints.numpy()).max()
            < 1e-12
        )


@skinnings
def test_a_rig_without_blend_shapes_poses_as_well(skinning):
    rig, (person,), (pose,) = (
        small_rig(SMALL, skinning=skinning, size=None),
        people(SMALL, 1),
        poses(1),
    )
    theirs = as_body(rig, SMALL, np.zeros((len(SMALL.vertices), 3, 1)), person.template)
    found = theirs(torch.zeros(1, dtype=torch.float64), torch.from_numpy(pose)).vertices.numpy()
    assert np.abs(surface(rig, person, pose) - found).max() < 1e-12
    assert rig.posedirs_for(np.zeros(0)) is None


@skinnings
def test_surfaces_are_linear_in_rest_surface_and_joints(skinning):
    rig, (person,), rng = (
        small_rig(SMALL, skinning=skinning),
        people(SMALL, 1),
        np.random.default_rng(1),
    )
    for pose in poses(3, seed=1, largest=3.0):
        applied = posed(rig, pose)
        rest = rest_surface(rig, person, pose)
        more = rng.normal(size=rest.shape)
        away = rng.normal(size=person.joints.shape)
        moved = applied.vertices(rest + more, person.joints + away) - applied.vertices(
            rest, person.joints
        )
        by_parts = (applied.turn @ more[..., None])[
            ..., 0
        ] + applied.joint_jacobian() @ away.ravel()
        assert np.abs(moved - by_parts).max() < 1e-12


@skinnings
def test_a_blended_turn_does_not_lengthen(skinning):
    rig = small_rig(SMALL, skinning=skinning)
    for pose in poses(3, seed=2, largest=3.0):
        lengths = np.linalg.svd(posed(rig, pose).turn, compute_uv=False)
        assert lengths.max() < 1 + 1e-12
        if skinning == "dqbs":  # what is blended is a rotation
            assert lengths.min() > 1 - 1e-12


@rigs(2)
def test_derivatives_are_exact(rig):
    (person,), (pose,) = (
        people(SMALL, 1, shape_features=rig.shape_features),
        poses(1, seed=3, largest=2.5),
    )
    moved, pose_jacobian, turn, joint_jacobian = surface_jacobians(rig, person, pose)
    given = tuple(torch.from_numpy(x) for x in (person.template, person.joints, pose))

    def theirs(template, joints, pose):
        return torch_surface(rig, template, joints, person.descriptor, pose)

    by = torch.autograd.functional.jacobian(theirs, given)
    rows = np.arange(len(moved))
    assert np.abs(moved - theirs(*given).numpy()).max() < 1e-12
    assert np.abs(pose_jacobian - by[2].flatten(2).numpy()).max() < 1e-10
    assert np.abs(turn - by[0].numpy()[rows, :, rows]).max() < 1e-12
    assert np.abs(joint_jacobian - by[1].flatten(2).numpy()).max() < 1e-12


@rigs(0)
def test_derivatives_by_pose_are_differences(rig):
    (person,), (pose,), step = (
        people(SMALL, 1, shape_features=rig.shape_features),
        poses(1, seed=4),
        1e-5,
    )
    pose_jacobian = surface_jacobians(rig, person, pose)[1]
    for c, along in enumerate(np.eye(pose.size).reshape(-1, *pose.shape)):
        ahead, behind = (surface(rig, person, pose + sign * step * along) for sign in (1, -1))
        assert np.abs((ahead - behind) / (2 * step) - pose_jacobian[..., c]).max() < 1e-8


@skinnings
def test_a_rest_pose_is_rest_and_its_derivatives_hold(skinning):
    rig, (person,) = small_rig(SMALL, skinning=skinning), people(SMALL, 1)
    rest = np.zeros((len(PARENTS), 3))
    moved, pose_jacobian, *_ = surface_jacobians(rig, person, rest)
    assert np.abs(moved - person.template).max() < 1e-14
    for c, along in enumerate(np.eye(rest.size).reshape(-1, *rest.shape)):
        ahead, behind = (surface(rig, person, sign * 1e-5 * along) for sign in (1, -1))
        assert np.abs((ahead - behind) / 2e-5 - pose_jacobian[..., c]).max() < 1e-8


@every
def test_turning_the_root_turns_everything_about_its_joint(rig):
    (person,), (pose,) = people(SMALL, 1, shape_features=rig.shape_features), poses(1, seed=5)
    at_ease = pose.copy()
    at_ease[0] = 0
    turn = matrix_from_rotvec(torch.from_numpy(pose[0])).numpy()
    turned = (surface(rig, person, at_ease) - person.joints[0]) @ turn.T + person.joints[0]
    assert np.abs(surface(rig, person, pose) - turned).max() < 1e-12


def test_shape_dependent_blend_shapes_are_blocks_summed():
    rig = small_rig(SMALL, shape_features=2)
    first, second, third = np.split(rig.posedirs, 3, axis=-1)
    assert (
        np.abs(rig.posedirs_for(np.array([2.0, -3.0])) - (first + 2 * second - 3 * third)).max()
        < 1e-15
    )
    plain = replace(rig, posedirs=first, shape_features=0)
    assert plain.posedirs_for(np.zeros(0)) is first


def test_influences_are_the_strongest_in_order():
    weights = np.array([[0.1, 0.5, 0.0, 0.4], [0.25, 0.25, 0.3, 0.2], [1.0, 0.0, 0.0, 0.0]])
    index, value = influences(weights, 2)
    assert index[:2].tolist() == [[1, 3], [2, 0]] and index[2, 0] == 0
    assert np.allclose(value, [[5 / 9, 4 / 9], [6 / 11, 5 / 11], [1, 0]], atol=1e-15)
    rig = small_rig(SMALL)
    assert np.abs(rig.weights - SMALL.weights).max() < 1e-15
    assert np.array_equal(rig.strongest, SMALL.weights.argmax(1))


def test_kinship_counts_bones_between_joints():
    table = kinship(PARENTS)
    assert np.array_equal(table, table.T) and not table.diagonal().any()
    assert table[4, 5] == 4 and table[0, 4] == 3 and table[2, 3] == 2 and table[1, 0] == 1
