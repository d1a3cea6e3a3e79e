"""A body answers in kind: NumPy, lists, torch; float32 and float64."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import synthetic_body, with_features

import habitus
from habitus.arrays import kind_of, to_numpy
from habitus.body.jacobians import surface_jacobian
from habitus.body.pose_features import POSE_FEATURES
from habitus.errors import HabitusError

KINDS = {
    "numpy float64": lambda x: np.asarray(x, np.float64),
    "numpy float32": lambda x: np.asarray(x, np.float32),
    "torch float64": lambda x: torch.as_tensor(x, dtype=torch.float64),
    "torch float32": lambda x: torch.as_tensor(x, dtype=torch.float32),
}
kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
skinnings = pytest.mark.parametrize("skinning", ["lbs", "dqbs"])


def random_state(body, *batch: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    pose = 0.6 * rng.normal(size=(*batch, body.num_joints, 3))
    return rng.normal(size=(*batch, body.num_betas)), pose, rng.normal(size=(*batch, 3))


def tolerance(array) -> float:
    return 2e-5 if "32" in str(array.dtype) else 1e-12


@kinds
@skinnings
@pytest.mark.parametrize("batch", [(), (3,), (2, 0), (2, 3)])
def test_the_answer_is_of_the_kind_of_the_question_and_the_same_to_rounding(batch, skinning, kind):
    body = replace(synthetic_body(), skinning=skinning)
    state = random_state(body, *batch)
    known = body(*state)
    found = body(*(kind(x) for x in state))
    for name in ("vertices", "joints", "betas"):
        ours = getattr(found, name)
        assert (
            type(ours) is type(kind(0.0))
            and ours.dtype == kind(0.0).dtype
            and ours.shape == getattr(known, name).shape
        )
        assert np.abs(to_numpy(ours) - getattr(known, name)).max(initial=0) < tolerance(ours)
    assert np.array_equal(to_numpy(found.faces), body.faces) and type(found.faces) is type(
        kind(0.0)
    )


@kinds
@skinnings
@pytest.mark.parametrize("name", POSE_FEATURES)
def test_derivatives_come_in_kind_whatever_drives_the_pose_blend_shapes(name, skinning, kind):
    body = with_features(replace(synthetic_body("mano", 60), skinning=skinning), name, 2)
    state = random_state(body, 2)
    known, found = (
        surface_jacobian(body, *s, vertices=[3, 9]) for s in (state, [kind(x) for x in state])
    )
    assert np.abs(known.surface.vertices - body(*state, vertices=[3, 9]).vertices).max() < 1e-13
    for field in ("vertices_betas", "vertices_pose", "joints_betas", "joints_pose"):
        ours = getattr(found, field)
        assert type(ours) is type(kind(0.0)) and ours.dtype == kind(0.0).dtype
        assert np.abs(to_numpy(ours) - getattr(known, field)).max() < tolerance(ours)


@skinnings
def test_derivatives_in_numpy_are_autodiff(skinning):
    body = replace(synthetic_body("mano", 60), skinning=skinning)
    betas, pose, trans = random_state(body)
    found = surface_jacobian(body, betas, pose, trans, vertices=[1, 5])
    run = lambda *state: body(*state, torch.as_tensor(trans), vertices=[1, 5]).vertices  # noqa: E731
    by_betas, by_pose = torch.func.jacrev(run, (0, 1))(
        torch.as_tensor(betas), torch.as_tensor(pose)
    )
    assert np.abs(found.vertices_betas - by_betas.numpy()).max() < 1e-12
    assert np.abs(found.vertices_pose - by_pose.numpy()).max() < 1e-12


def test_lists_and_numbers_are_float64_and_tensors_decide():
    body = synthetic_body()
    assert body([1, 2]).vertices.dtype == np.float64
    single = np.zeros((24, 3), np.float32)
    assert body([1.0], single).vertices.dtype == np.float32  # lists have no say
    assert body(np.ones(1), single).vertices.dtype == np.float64
    mixed = body(np.ones(1), torch.zeros(24, 3), [0, 0, 1])
    assert mixed.vertices.dtype == torch.float32
    assert body(torch.ones(1).double(), torch.zeros(24, 3)).vertices.dtype == torch.float64
    prepared = body.prepare([1.0])
    assert prepared(torch.zeros(24, 3)).vertices.dtype == torch.float32
    assert (
        np.abs(prepared(torch.zeros(24, 3).double()).vertices.numpy() - prepared().vertices).max()
        < 1e-13
    )
    assert kind_of(torch.arange(3)).dtype == torch.get_default_dtype()


def test_what_is_not_given_is_zero_and_short_betas_are_filled_up():
    body = synthetic_body()
    betas, pose, trans = random_state(body, 4)
    whole = np.zeros((4, 10))
    whole[:, :3] = betas[:, :3]
    assert np.array_equal(
        body(betas[:, :3], pose, trans).vertices, body(whole, pose, trans).vertices
    )
    assert np.array_equal(body.rest_vertices(betas[:, :3]), body.rest_vertices(whole))
    assert np.array_equal(body.rest_joints(betas[:, :3]), body.rest_joints(whole))
    assert np.allclose(body().vertices, body.v_template, atol=1e-15)
    zero = body.state(2)
    assert (
        zero.betas.shape == (2, 10) and zero.pose.shape == (2, 24, 3) and zero.soft_tissue is None
    )
    assert np.array_equal(body(zero.betas, zero.pose, zero.trans).vertices[0], body().vertices)
    gradient = torch.ones(2, dtype=torch.float64, requires_grad=True)
    body(gradient).vertices.sum().backward()
    assert np.allclose(gradient.grad, body.shapedirs[..., :2].sum((0, 1)))


@kinds
def test_poses_may_be_given_by_name(kind):
    body = synthetic_body()
    elbow = body.joint_names.index("left_elbow")
    neck = body.joint_names.index("neck")
    pose = np.zeros((3, 24, 3))
    pose[:, elbow], pose[:, neck] = [[0, -1.2, 0], [0.1, 0, 0], [0, 0, 0.3]], [0.2, 0.1, 0]
    named = {"left_elbow": kind(pose[:, elbow]), "neck": (0.2, 0.1, 0)}
    found = body(pose=named, vertices=[2, 7]).vertices
    assert np.abs(to_numpy(found) - body(pose=pose, vertices=[2, 7]).vertices).max() < tolerance(
        found
    )
    assert type(found) is type(kind(0.0)) and body(pose={}).vertices.shape == (240, 3)
    jacobian = surface_jacobian(body, pose=named, vertices=[2])
    assert np.abs(to_numpy(jacobian.surface.vertices - found[:, :1])).max() < tolerance(found)


def test_unknown_joints_are_refused_with_the_nearest():
    with pytest.raises(HabitusError, match=r"no joint 'l_elbow'; did you mean .*left_elbow"):
        synthetic_body()(pose={"l_elbow": (0, 0, 1)})


def test_a_surface_knows_its_person():
    body = habitus.load_body("default")
    soft = np.zeros((2, body.num_betas))
    soft[:, 0] = 0.5
    surface = body([1.5], pose={"left_elbow": (0, -1.2, 0)}, soft_tissue=soft)
    assert surface.betas.tolist() == [1.5] + [0.0] * (body.num_betas - 1)
    told = body.measure(surface)
    assert told == body.measure([1.5]) and told["height_m"] > body.measure()["height_m"] + 0.01
    assert body.measure(torch.tensor([1.5])) == told
    with pytest.raises(HabitusError, match="the betas of one"):
        body.measure(np.zeros((2, 10)))


def test_copies_in_other_kinds_are_kept_and_do_not_travel():
    body = synthetic_body("mano", 50)
    size = len(pickle.dumps(replace(body, landmarks={}, extras={}), protocol=5))
    with torch.inference_mode():
        body(torch.zeros(10))
    pose = torch.zeros(16, 3, requires_grad=True)
    body(
        pose=pose
    ).vertices.sum().backward()  # what was made in inference mode is no inference tensor
    assert pose.grad is not None and torch.isfinite(pose.grad).all()
    again = pickle.loads(pickle.dumps(replace(body, landmarks={}, extras={}), protocol=5))
    assert len(pickle.dumps(again, protocol=5)) == size
    assert np.array_equal(again().vertices, body().vertices)
