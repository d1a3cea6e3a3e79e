"""Fits to registrations: planted truth from far starts, derivatives in blocks, fixed shapes, what
is refused.
"""

from dataclasses import replace

import numpy as np
import pytest
from tube_body import random_pose, tube_body

from habitus.errors import HabitusError
from habitus.evaluate import posable
from habitus.evaluate.posable import PosableBody, without_pose_shapes
from habitus.evaluate.surface_fit import Fit, Tolerances, fit_surface, start_pose
from habitus.rotations import matrix_from_rotvec


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
@pytest.mark.parametrize("seed", range(4))
def test_planted_shape_pose_and_place_come_back_from_a_far_start(skinning, seed):
    rng = np.random.default_rng(seed)
    model = PosableBody(tube_body(skinning=skinning))
    betas = 1.5 * rng.normal(size=4)
    pose = random_pose(rng, largest=1.5)
    trans = 2 * rng.normal(size=3)
    fit = model.fit(model.surface(betas, pose) + trans, num_betas=4)
    assert fit.converged
    np.testing.assert_allclose(fit.betas, betas, atol=1e-6)
    np.testing.assert_allclose(fit.pose, pose, atol=1e-6)
    np.testing.assert_allclose(fit.trans, trans, atol=1e-6)
    np.testing.assert_allclose(fit.vertices, model.surface(betas, pose) + trans, atol=1e-6)


def test_a_body_turned_by_nearly_half_a_turn_is_found():
    rng = np.random.default_rng(3)
    model = PosableBody(tube_body(pose_shapes=0.0))
    pose = random_pose(rng, largest=1.0)
    pose[0] = [0.0, 3.1, 0.0]
    target = model.surface(np.zeros(4), pose)
    start = Fit(np.zeros(4), pose + rng.normal(size=pose.shape) * 0.2, np.zeros(3), target)
    for begin in (None, start):
        assert np.abs(model.fit(target, num_betas=4, start=begin).vertices - target).max() < 1e-7


def test_the_start_is_exact_for_parts_that_move_rigidly():
    body = tube_body(pose_shapes=0.0)
    rigid = np.eye(body.num_joints)[body.skinning_weights.argmax(1)]
    pose = random_pose(np.random.default_rng(5), largest=3.0)
    rest = body.v_template
    turned = np.empty_like(rest)
    world = [None] * body.num_joints
    for j, parent in enumerate(body.parents):
        local = matrix_from_rotvec(pose[j])
        world[j] = local if parent < 0 else world[parent] @ local
        turned[rigid[:, j] > 0] = rest[rigid[:, j] > 0] @ world[j].T + j
    np.testing.assert_allclose(start_pose(rest, turned, rigid, body.parents), pose, atol=1e-8)


def test_joints_without_vertices_go_along_in_the_start():
    model = PosableBody(tube_body(pose_shapes=0.0))
    influence = model.influence.copy()
    pose = random_pose(np.random.default_rng(1))
    influence[:, 3] = 0.0
    rest, target = (model.surface(np.zeros(4), p) for p in (0 * pose, pose))
    assert np.abs(start_pose(rest, target, influence, model.parents)[3]).max() < 1e-12


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_columns_are_the_derivatives_whatever_the_blocks(skinning, monkeypatch):
    rng = np.random.default_rng(2)
    model = PosableBody(tube_body(skinning=skinning))
    betas = rng.normal(size=3)
    pose = random_pose(rng)
    step = 1e-6
    monkeypatch.setattr(posable, "BLOCK", 77)
    blocks = list(model.columns(betas, pose, True))
    assert len(blocks) > 1
    found = np.concatenate([by for _, _, by in blocks])
    np.testing.assert_allclose(
        np.concatenate([v for _, v, _ in blocks]), model.surface(betas, pose), atol=1e-12
    )
    x = np.concatenate([betas, pose.ravel()])
    for k in range(len(x)):
        ahead, behind = (
            model.surface((x + d)[:3], (x + d)[3:].reshape(-1, 3))
            for d in (step * np.eye(len(x))[k], -step * np.eye(len(x))[k])
        )
        np.testing.assert_allclose(found[:, :, k], (ahead - behind) / (2 * step), atol=1e-7)


def test_a_fixed_shape_stays_and_its_pose_is_found():
    rng = np.random.default_rng(7)
    model = PosableBody(tube_body())
    betas = rng.normal(size=4)
    pose = random_pose(rng)
    fit = model.fit(model.surface(betas, pose), num_betas=4, betas=betas)
    np.testing.assert_array_equal(fit.betas, betas)
    np.testing.assert_allclose(fit.pose, pose, atol=1e-6)
    off = model.fit(model.surface(betas, pose), num_betas=4, betas=betas + 0.5)
    assert np.abs(off.vertices - model.surface(betas, pose)).max() > 1e-3


def test_the_place_does_not_matter():
    rng = np.random.default_rng(8)
    model = PosableBody(tube_body())
    target = model.surface(rng.normal(size=4), random_pose(rng)) + 0.01 * rng.normal(size=(300, 3))
    here = model.fit(target, num_betas=2)
    there = model.fit(target + np.array([3.0, -2.0, 1.0]), num_betas=2)
    np.testing.assert_allclose(there.vertices - [3.0, -2.0, 1.0], here.vertices, atol=1e-5)


def test_no_step_in_any_direction_lowers_the_squared_distance():
    rng = np.random.default_rng(9)
    model = PosableBody(tube_body())
    target = model.surface(rng.normal(size=4), random_pose(rng)) + 0.01 * rng.normal(size=(300, 3))
    fit = fit_surface(model, target, num_betas=2, tolerances=Tolerances(cost=1e-14))
    best = ((fit.vertices - target) ** 2).sum()
    for _ in range(30):
        betas = fit.betas + 1e-3 * rng.normal(size=2)
        pose = fit.pose + 1e-3 * rng.normal(size=(10, 3))
        moved = model.surface(betas, pose) + fit.trans + 1e-3 * rng.normal(size=3)
        assert ((moved - target) ** 2).sum() > best


@pytest.mark.parametrize("shape_features", [0, 2])
def test_forward_functions_give_the_surface(shape_features):
    rng = np.random.default_rng(4)
    body = tube_body()
    posedirs = 0.01 * rng.normal(size=(300, 3, 81 * (1 + shape_features)))
    model = PosableBody(replace(body, posedirs=posedirs, shape_features=shape_features))
    betas = rng.normal(size=4)
    pose = random_pose(rng)
    for k in (0, 1, 4):
        np.testing.assert_allclose(
            model.forward(k)(betas[:k], pose), model.surface(betas[:k], pose), atol=1e-12
        )


def test_poses_drive_the_fit_whatever_feature_they_act_through():
    rng = np.random.default_rng(6)
    body = tube_body()
    posedirs = 0.005 * rng.normal(size=(300, 3, 9 * 4 * 2))
    model = PosableBody(
        replace(body, posedirs=posedirs, pose_features="quaternions", shape_features=1)
    )
    betas = rng.normal(size=4)
    pose = random_pose(rng, largest=1.0)
    fit = model.fit(model.surface(betas, pose), num_betas=4)
    np.testing.assert_allclose(fit.betas, betas, atol=1e-6)
    np.testing.assert_allclose(fit.pose, pose, atol=1e-6)


def test_without_pose_shapes_only_those_are_missing():
    body = without_pose_shapes(tube_body())
    pose = random_pose(np.random.default_rng(4))
    plain = PosableBody(tube_body(pose_shapes=0.0)).surface(np.zeros(4), pose)
    np.testing.assert_array_equal(PosableBody(body).surface(np.zeros(4), pose), plain)


@pytest.mark.parametrize(
    ("target", "count", "words"),
    [
        (np.zeros((10, 3)), 4, r"\(10, 3\).*\(300, 3\)"),
        (np.full((300, 3), np.nan), 4, "not finite"),
        (np.zeros((300, 3)), 5, "5 shape coefficients.*0 to 4"),
    ],
)
def test_what_does_not_fit_is_refused(target, count, words):
    with pytest.raises(HabitusError, match=words):
        PosableBody(tube_body()).fit(target, num_betas=count)
