import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError
from synthetic import synthetic_body

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-13}
both = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
skinnings = pytest.mark.parametrize("skinning", ["lbs", "dqbs"])


def random_state(
    body: BodyModel, *batch: int, seed: int = 0, scale: float = 0.6, dtype=torch.float64
):
    generator = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*batch, *shape, generator=generator, dtype=dtype)  # noqa: E731
    return normal(body.num_betas), scale * normal(body.num_joints, 3), normal(3)


def world_by_the_book(body, betas, pose):
    """4 x 4 matrices of eq. 4, one joint after another, and the rest joints of eq. 10."""
    rest = body.v_template + body.shapedirs @ betas
    joints = body.joint_regressor @ rest
    world = []
    for k, parent in enumerate(body.parents):
        local = np.eye(4)
        local[:3, :3] = torch.linalg.matrix_exp(
            torch.tensor(
                [
                    [0, -pose[k, 2], pose[k, 1]],
                    [pose[k, 2], 0, -pose[k, 0]],
                    [-pose[k, 1], pose[k, 0], 0],
                ]
            )
        )
        local[:3, 3] = joints[k] - (joints[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    return rest, joints, world


def surface_by_the_book(body, betas, pose, trans):
    """S 3, eqs. 2 to 12, in loops; DQBS as Kavan et al. 2008 print it."""
    rest, joints, world = world_by_the_book(body, betas, pose)
    feature = np.concatenate(
        [
            (np.linalg.inv(world[parent][:3, :3]) @ world[k][:3, :3] - np.eye(3)).ravel()
            for k, parent in enumerate(body.parents)
            if parent >= 0
        ]
    )
    rest = rest + body.posedirs @ feature
    weights = body.skinning_weights
    out = np.zeros_like(rest)
    for i, vertex in enumerate(rest):
        if body.skinning == "lbs":
            for k, g in enumerate(world):
                out[i] += weights[i, k] * (g[:3, :3] @ (vertex - joints[k]) + g[:3, 3])
        else:
            out[i] = kavan(vertex, weights[i], joints, world)
    return out + trans, np.array([g[:3, 3] for g in world]) + trans


def kavan(vertex, weights, joints, world):
    pivot = None
    real = np.zeros(4)
    dual = np.zeros(4)
    for k in np.argsort(-weights, kind="stable"):
        r = world[k][:3, :3]
        t = world[k][:3, 3] - r @ joints[k]
        w = 0.5 * math.sqrt(max(0.0, 1 + np.trace(r)))
        q = np.array(
            [w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w))]
        )
        e = 0.5 * np.array([-t @ q[1:], *(q[0] * t + np.cross(t, q[1:]))])
        pivot = q if pivot is None else pivot
        sign = 1 if q @ pivot >= 0 else -1
        real = real + sign * weights[k] * q
        dual = dual + sign * weights[k] * e
    norm = np.linalg.norm(real)
    (a0, a), (e0, e) = (real[0] / norm, real[1:] / norm), (dual[0] / norm, dual[1:] / norm)
    shift = 2 * (a0 * e - e0 * a + np.cross(a, e))
    return vertex + 2 * np.cross(a, np.cross(a, vertex) + a0 * vertex) + shift


@skinnings
@pytest.mark.parametrize("family", ["smpl", "smplx", "mano", "smal"])
def test_a_body_is_what_the_paper_says(family, skinning):
    body = replace(synthetic_body(family, 60), skinning=skinning)
    for seed in range(3):
        betas, pose, trans = random_state(body, seed=seed)
        surface = body(betas, pose, trans)
        vertices, joints = surface_by_the_book(body, betas.numpy(), pose.numpy(), trans.numpy())
        assert np.abs(surface.vertices.numpy() - vertices).max() < 1e-12
        assert np.abs(surface.joints.numpy() - joints).max() < 1e-12


@both
@skinnings
def test_zero_pose_is_the_shaped_template_whatever_the_skinning(skinning, dtype):
    body = replace(synthetic_body(), skinning=skinning)
    betas, pose, trans = random_state(body, 4, dtype=dtype)
    surface = body(betas, torch.zeros_like(pose), trans)
    assert (surface.vertices - body.rest_vertices(betas) - trans[:, None]).abs().max() < TOLERANCE[
        dtype
    ]
    assert (surface.joints - body.rest_joints(betas) - trans[:, None]).abs().max() < TOLERANCE[
        dtype
    ]


@skinnings
def test_turning_the_root_turns_the_body_about_its_root_joint(skinning):
    from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix

    body = replace(synthetic_body(), skinning=skinning)
    betas, pose, trans = random_state(body)
    before = body(betas, pose, trans)
    turn = matrix_from_rotvec(torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64))
    turned = pose.clone()
    turned[0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[0]))
    after = body(betas, turned, trans)
    root = before.joints[0]
    assert torch.allclose(after.vertices, (before.vertices - root) @ turn.T + root, atol=1e-12)
    assert torch.allclose(after.joints, (before.joints - root) @ turn.T + root, atol=1e-12)


@skinnings
def test_moving_a_joint_leaves_all_that_hangs_elsewhere(skinning):
    body = replace(synthetic_body(), skinning=skinning, posedirs=None)
    betas, pose, trans = random_state(body)
    moved = pose.clone()
    elbow = body.joint_names.index("left_elbow")
    moved[elbow] += 1
    below = [elbow, *(body.joint_names.index(f"left_{part}") for part in ("wrist", "hand"))]
    free = body.skinning_weights[:, below].sum(1) == 0
    change = (body(betas, moved, trans).vertices - body(betas, pose, trans).vertices).abs().amax(1)
    assert change[free].max() < 1e-14 and change[~free].max() > 1e-3


@both
@skinnings
def test_subsets_batches_and_prepared_bodies_say_the_same(skinning, dtype):
    body = replace(synthetic_body(), skinning=skinning)
    betas, pose, trans = random_state(body, 2, 3, dtype=dtype)
    surface = body(betas, pose, trans)
    assert (
        surface.vertices.shape == (2, 3, body.num_vertices, 3) and surface.vertices.is_contiguous()
    )
    pick = [7, 3, 3, 200]
    few = body(betas, pose, trans, vertices=pick)
    assert (few.vertices - surface.vertices[..., pick, :]).abs().max() < TOLERANCE[dtype]
    assert torch.equal(few.joints, surface.joints)
    alone = body(betas[1, 2], pose[1, 2], trans[1, 2])
    assert (alone.vertices - surface.vertices[1, 2]).abs().max() < TOLERANCE[dtype]
    for shape in (betas[0, 0], betas[:1, :1]):  # one shape, many poses
        shared = body.prepare(shape, torch.tensor(pick))(pose, trans)
        each = body(betas[:1, :1].expand_as(betas), pose, trans, vertices=np.array(pick))
        assert (shared.vertices - each.vertices).abs().max() < TOLERANCE[dtype]
        assert (shared.joints - each.joints).abs().max() < TOLERANCE[dtype]
    many = body(betas, pose[0, 0], trans[0, 0])  # many shapes, one pose
    assert (many.vertices[0, 0] - surface.vertices[0, 0]).abs().max() < TOLERANCE[dtype]
    assert body(betas[:, :0], pose[:, :0], trans[:, :0]).vertices.shape == (
        2,
        0,
        body.num_vertices,
        3,
    )


def test_large_batches_are_cut_into_chunks_without_a_trace():
    body = synthetic_body("smpl", 3000)
    betas, pose, trans = random_state(body, 50, dtype=torch.float32)
    whole = body(betas, pose, trans).vertices
    assert (whole[-1] - body(betas[-1], pose[-1], trans[-1]).vertices).abs().max() < 1e-5


@skinnings
def test_gradients_reach_every_input_even_at_rest(skinning):
    body = replace(synthetic_body("smpl", 30), skinning=skinning)
    pick = [0, 4, 9]
    zero = body.state(2)
    inputs = [
        torch.tensor(value, requires_grad=True) for value in (zero.betas, zero.pose, zero.trans)
    ]

    def outputs(*state):
        surface = body(*state, vertices=pick)
        return surface.vertices, surface.joints

    assert torch.autograd.gradcheck(outputs, inputs)


def test_soft_tissue_is_shape_that_changes_with_time():
    body = synthetic_body()
    betas, pose, trans = random_state(body, 5)
    soft = 0.1 * torch.randn_like(betas)
    with_soft = body(betas[0], pose, trans, soft_tissue=soft)
    as_shape = body(betas[0] + soft, pose, trans)
    assert torch.equal(with_soft.vertices, as_shape.vertices) and torch.equal(
        with_soft.joints, as_shape.joints
    )


def test_states_index_over_time():
    state = replace(synthetic_body().state(4), betas=np.arange(10.0), soft_tissue=np.ones((4, 10)))
    assert state[1:3].pose.shape == (2, 24, 3) and state[2].soft_tissue.shape == (10,)
    assert np.array_equal(state[2].betas, state.betas)


def test_models_are_immutable_numpy_and_can_be_cut():
    names = synthetic_body().joint_names
    prior = PosePrior(names[1:], np.zeros(69), np.eye(69))
    body = replace(synthetic_body(), pose_prior=prior, female_direction=(np.ones(10), 0.5))
    with pytest.raises(FrozenInstanceError):
        body.name = "other"  # pyright: ignore
    given = replace(
        body, v_template=body.v_template.astype(np.float32), faces=body.faces.astype(np.int32)
    )
    for array in (
        given.v_template,
        given.posedirs,
        given.skinning_value,
        given.female_direction[0],
    ):
        assert isinstance(array, np.ndarray) and array.dtype == np.float64
    assert given.faces.dtype == np.int64
    few = body.with_betas(3)
    assert few.num_betas == 3 and len(few.female_direction[0]) == 3
    betas, pose, trans = random_state(body)
    betas[3:] = 0
    assert torch.allclose(
        few(betas[:3], pose, trans).vertices, body(betas, pose, trans).vertices, atol=1e-14
    )


@pytest.mark.parametrize(
    ("betas", "pose", "say"),
    [
        (
            torch.zeros(11),
            torch.zeros(24, 3),
            r"betas has shape \(11,\); expected \(\*batch, 10\) or fewer",
        ),
        (torch.tensor(1.0), torch.zeros(24, 3), r"betas has shape \(\)"),
        (
            torch.zeros(10),
            torch.zeros(23, 3),
            r"pose has shape \(23, 3\); expected \(\*batch, 24, 3\)",
        ),
        (
            [0.0],
            {"left_elbow": (0, 1)},
            r"pose\['left_elbow'\] has shape \(2,\); expected \(\*batch, 3\)",
        ),
        ([0.0], {"left_elbo": (0, 1, 0)}, r"no joint 'left_elbo'; did you mean left_elbow, "),
    ],
)
def test_wrong_states_are_refused_with_the_right_shape(betas, pose, say):
    with pytest.raises(HabitusError, match=say):
        synthetic_body()(betas, pose)


def test_flat_poses_are_refused():
    with pytest.raises((HabitusError, TypeCheckError), match=r"pose has shape|parameter 'pose'"):
        synthetic_body()(torch.zeros(10), torch.zeros(72))


def test_impossible_trees_and_skinnings_are_refused():
    body = synthetic_body("mano", 40)
    with pytest.raises(HabitusError, match="parent of joint 3 is 3"):
        replace(body, parents=(-1, 0, 1, 3, *body.parents[4:]))
    with pytest.raises(HabitusError, match="root"):
        replace(body, parents=(0, *body.parents[1:]))
    with pytest.raises(HabitusError, match="dqbs"):
        replace(body, skinning="magic")
    with pytest.raises(
        (HabitusError, TypeCheckError), match=r"expected vertex numbers|parameter 'vertices'"
    ):
        body.prepare(torch.zeros(10, dtype=torch.float64), torch.ones(40, dtype=torch.bool))
    with pytest.raises(HabitusError, match="vertices run from"):
        body(
            torch.zeros(10, dtype=torch.float64),
            torch.zeros(16, 3, dtype=torch.float64),
            vertices=[0, 40],
        )
