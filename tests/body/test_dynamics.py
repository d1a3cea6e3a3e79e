"""Dynamic blend shapes on a body, and soft tissue that is predicted from motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from soft_tubes import RATE, planted_regressor, shaken, soft_tubes
from tube_body import random_pose, tube_body

import habitus
from habitus.body.dynamics import CONTROLS, at_rest_in_time, companion, motion_controls, resampled
from habitus.body.jacobians import surface_jacobian
from habitus.body.soft_tissue import controls_of
from habitus.errors import HabitusError
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

BETAS = np.array([0.7, -1.0, 0.3, 0.2])


# -- blend shapes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
@pytest.mark.parametrize("face", [False, True])
def test_dynamics_are_added_to_the_rest_surface_and_move_no_joint(skinning, face):
    rng = np.random.default_rng(0)
    body = soft_tubes(skinning=skinning)
    if face:
        body = replace(body, expressiondirs=0.01 * rng.normal(size=(body.num_vertices, 3, 3)))
    pose = random_pose(rng)
    delta = np.array([1.5, -2.0])
    np.testing.assert_array_equal(
        body(BETAS, pose, dynamics=delta).joints, body(BETAS, pose).joints
    )
    pinned = replace(body, joint_regressor=np.zeros_like(body.joint_regressor))
    moved = replace(pinned, v_template=body.v_template + body.dynamics.directions @ delta)
    expected = moved(BETAS, pose, expression=(0.5,) if face else None)
    found = pinned(BETAS, pose, expression=(0.5,) if face else None, dynamics=delta)
    np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-12)


def test_zero_dynamics_and_none_are_the_same_body():
    body = soft_tubes()
    pose = random_pose(np.random.default_rng(1))
    np.testing.assert_array_equal(body(BETAS, pose).vertices, tube_body()(BETAS, pose).vertices)
    np.testing.assert_allclose(
        body(BETAS, pose, dynamics=(0,)).vertices, body(BETAS, pose).vertices, atol=1e-14
    )


def test_torch_and_some_vertices_and_batches_agree():
    rng = np.random.default_rng(2)
    body = soft_tubes()
    pose = random_pose(rng)
    delta = rng.normal(size=(5, 2))
    ids = np.array([3, 70, 9])
    whole = body(BETAS, pose, dynamics=delta).vertices
    np.testing.assert_allclose(
        body(BETAS, pose, dynamics=delta, vertices=ids).vertices, whole[:, ids], atol=1e-12
    )
    given = [
        torch.tensor(part, requires_grad=grad)
        for part, grad in ((BETAS, True), (pose, False), (delta, True))
    ]
    found = body(
        given[0], given[1], dynamics=given[2]
    ).vertices  # wants gradients: the readable path
    np.testing.assert_allclose(found.detach().numpy(), whole, atol=1e-12)
    prepared = body.prepare(BETAS, dynamics=delta)
    np.testing.assert_allclose(prepared(torch.tensor(pose)).vertices.numpy(), whole, atol=1e-12)
    assert prepared.dynamics.shape == (5, 2) and prepared.expression is None


@pytest.mark.parametrize("skinning", ["lbs", "dqbs"])
def test_jacobians_are_those_of_autodiff(skinning):
    body = soft_tubes(skinning=skinning, pose_shapes=0.003)
    rng = np.random.default_rng(3)
    pose = random_pose(rng)
    delta = np.array([0.8, -0.4])
    ids = np.array([11, 60, 130, 200])
    found = surface_jacobian(body, BETAS, pose, vertices=ids, dynamics=delta)
    np.testing.assert_allclose(
        found.surface.vertices, body(BETAS, pose, vertices=ids, dynamics=delta).vertices, atol=1e-12
    )

    def vertices(betas, angles, moving):
        return body(betas, angles, dynamics=moving, vertices=ids).vertices

    by = torch.autograd.functional.jacobian(
        vertices, tuple(torch.tensor(x) for x in (BETAS, pose, delta))
    )
    for ours, theirs in zip(
        (found.vertices_betas, found.vertices_pose, found.vertices_dynamics), by, strict=True
    ):
        np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-10)
    assert surface_jacobian(body, BETAS, pose, vertices=ids).vertices_dynamics is None


def test_a_body_without_dynamics_refuses_them():
    with pytest.raises(
        HabitusError, match=r"shape \(1,\) given to tubes, which has no dynamic blend shapes"
    ):
        tube_body()(BETAS, dynamics=[1.0])
    with pytest.raises(HabitusError, match=r"no dynamic blend shapes.*train-dynamics"):
        habitus.simulate_soft_tissue(tube_body(), BETAS, np.zeros((9, 10, 3)), np.zeros((9, 3)), 60)
    with pytest.raises(HabitusError, match=r"dynamics has shape \(3,\)"):
        soft_tubes()(BETAS, dynamics=[1.0, 2.0, 3.0])
    with pytest.raises(HabitusError, match="vertices"):
        replace(soft_tubes(), dynamics=soft_tubes(around=5).dynamics)


# -- controls --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(CONTROLS))
def test_controls_do_not_care_where_the_body_is_and_which_way_it_faces(kind):
    body, (pose, trans) = tube_body(), shaken(40)
    rest = body.rest_joints(BETAS)
    turn = matrix_from_rotvec(np.array([0.4, 1.9, -0.3]))
    turned = pose.copy()
    turned[:, 0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[:, 0]))
    elsewhere = (trans + rest[0]) @ turn.T - rest[0] + [3.0, -1.0, 8.0]
    given = (kind, [0, 3, 6], body.parents, rest)
    found = motion_controls(*given, pose, trans, 60.0)
    other = motion_controls(*given, turned, elsewhere, 60.0)
    assert found.shape == (40, CONTROLS[kind].count(3)) and np.abs(found).max() > 1
    np.testing.assert_allclose(other, found, atol=1e-7)


def test_controls_are_velocities_and_accelerations():
    """A body that spins steadily about an axis away from it, on a wheel of 2 m at 3 rad/s."""
    body = tube_body(pose_shapes=0)
    t = np.arange(60) / 240.0
    spin = 3.0
    pose = np.zeros((60, 10, 3))
    trans = np.zeros((60, 3))
    rest = body.rest_joints()
    pose[:, 0, 1] = spin * t
    trans[:, 0], trans[:, 2] = 2 * np.cos(spin * t), -2 * np.sin(spin * t)
    trans -= rest[0]
    found = motion_controls("joints", [0], body.parents, rest, pose, trans, 240.0)[1:-1]
    np.testing.assert_allclose(
        found, np.tile([-18.0, 0, 0, 0, spin, 0, 0, 0, 0], (58, 1)), atol=1e-2
    )
    smpl = motion_controls("smpl", [0, 4], body.parents, rest, pose, trans, 240.0)[1:-1]
    expected = [0, spin, 0, 0, 0, 0, *[0] * 6, 0, 0, -2 * spin, -18.0, 0, 0]
    np.testing.assert_allclose(smpl, np.tile(expected, (58, 1)), atol=1e-2)


def test_long_motions_are_gone_through_in_pieces(monkeypatch):
    body, (pose, trans) = tube_body(), shaken(50)
    given = ("joints", [0, 5], body.parents, body.rest_joints(), pose, trans, 60.0)
    whole = motion_controls(*given)
    monkeypatch.setattr("habitus.body.dynamics._BLOCK", 7)
    np.testing.assert_allclose(motion_controls(*given), whole, atol=1e-9)


def test_resampling_keeps_what_is_pushed():
    values = np.random.default_rng(0).normal(size=(241, 2))
    assert resampled(values, 60, 60) is values
    slower = resampled(values, 240, 60)
    assert slower.shape == (61, 2)
    np.testing.assert_allclose(slower[30], np.trapezoid(values[118:123], axis=0) / 4, atol=1e-12)
    faster = resampled(values, 60, 120)
    assert len(faster) == 481
    np.testing.assert_allclose(faster[::2], values, atol=1e-12)
    np.testing.assert_allclose(faster[1], values[:2].mean(0), atol=1e-12)


# -- prediction ------------------------------------------------------------------------------------


def _simulated(body, motion, rate=RATE, **options):
    return habitus.simulate_soft_tissue(body, BETAS, *motion, rate, **options)


def test_soft_tissue_follows_the_regressor():
    body = soft_tubes()
    motion = shaken(80)
    found = _simulated(body, motion)
    regressor = body.dynamics.regressor
    history, drive = regressor.of_person(BETAS)
    controls = controls_of(body, body.dynamics, BETAS, *motion, RATE)
    for t in (2, 40, 79):
        expected = history[0] @ found[t - 1] + history[1] @ found[t - 2] + drive @ controls[t]
        np.testing.assert_allclose(found[t], expected, atol=1e-12)
    assert found.std() > 0.1
    np.testing.assert_allclose(_simulated(body, motion, strength=1.7), 1.7 * found, atol=1e-12)
    tensors = habitus.simulate_soft_tissue(
        body, torch.tensor(BETAS), *map(torch.tensor, motion), RATE
    )
    np.testing.assert_allclose(tensors.numpy(), found, atol=1e-12)


@pytest.mark.parametrize("rate", [30.0, 100.0, 240.0])
def test_other_rates_come_to_the_same_soft_tissue(rate):
    body = soft_tubes()
    slow = lambda hz: shaken(int(6 * hz), seed=4, rate=hz)  # noqa: E731
    fine = _simulated(body, slow(60.0))
    found = _simulated(body, slow(rate), rate)
    assert len(found) == int(6 * rate)
    at = np.arange(0, 5.9, 0.1)
    ours, theirs = (
        np.array([np.interp(at, np.arange(len(x)) / hz, c) for c in x.T])
        for x, hz in ((found, rate), (fine, 60.0))
    )
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.2 * fine.std()


def test_a_body_that_stops_comes_to_rest_in_two_seconds():
    pose, trans = (
        np.concatenate([part, np.tile(part[-1:], (300, *[1] * (part.ndim - 1)))])
        for part in shaken(120)
    )
    found = np.abs(_simulated(soft_tubes(), (pose, trans))).max(1)
    assert found[:120].max() > 0.3
    assert found[121 + 120 :].max() < 0.02 * found[:122].max()
    assert not _simulated(soft_tubes(), (pose[-200:], trans[-200:])).any()


def test_histories_that_would_grow_are_damped_whatever_the_shape():
    wild = replace(planted_regressor(count=4, shapes=2), rate_hz=30.0)
    wild = replace(wild, history=1.3 * wild.history)
    for betas in ([], [9.0, -9.0], [-2.0, 3.0, 1.0]):
        history, _ = wild.of_person(np.array(betas))
        radius = np.abs(np.linalg.eigvals(companion(history))).max()
        assert radius**60 <= 0.01 * (1 + 1e-9)
    calm = planted_regressor().history[0]
    np.testing.assert_array_equal(at_rest_in_time(calm, RATE), calm)


def test_ten_minutes_stay_bounded_and_run_in_real_time():
    body = soft_tubes()
    pose, trans = (
        np.tile(part, (60, *[1] * (part.ndim - 1))) for part in shaken(600)
    )  # jumps at every seam
    found = _simulated(body, (pose, trans))
    assert len(found) == 36_000 and np.isfinite(found).all()
    minutes = np.abs(found).reshape(10, -1).max(1)
    assert minutes.max() < 1.05 * minutes[1]


def test_jumps_in_the_data_count_as_the_fastest_that_was_learned():
    body, (pose, trans) = soft_tubes(), shaken(200)
    tight = replace(body.dynamics.regressor, limits=np.full(27, 30.0))
    body = replace(body, dynamics=replace(body.dynamics, regressor=tight))
    trans[100:] += 4.0
    apart = _simulated(body, (pose, trans)) - _simulated(body, shaken(200))
    trans[100:] += 400.0
    further = _simulated(body, (pose, trans)) - _simulated(body, shaken(200))
    assert np.abs(apart).max() > 0
    np.testing.assert_allclose(further, apart, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"pose": np.zeros((5, 9, 3))}, r"pose has shape \(5, 9, 3\); expected \(5, 10, 3\)"),
        ({"trans": np.zeros((4, 3))}, "trans has shape"),
        ({"betas": np.zeros((5, 4))}, "betas has shape.*one person"),
        ({"pose": np.full((5, 10, 3), np.nan)}, "not finite"),
        ({"rate": 5.0}, "the rate is 5 Hz; expected 10"),
    ],
)
def test_motions_that_are_none(change, told):
    given = {"betas": BETAS, "pose": np.zeros((5, 10, 3)), "trans": np.zeros((5, 3)), "rate": 60.0}
    with pytest.raises(HabitusError, match=told):
        habitus.simulate_soft_tissue(soft_tubes(), **(given | change))


def test_a_body_without_the_joints_that_drive():
    other = replace(soft_tubes(), joint_names=tuple(f"bone_{k}" for k in range(10)))
    with pytest.raises(HabitusError, match="no joint 'joint_0'"):
        _simulated(other, shaken(5))
