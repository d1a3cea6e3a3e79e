"""Laws of a body of two levels of detail: one surface, one skeleton with more joints or fewer, one
age at a time.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from two_levels import DRIVERS, YEARS, two_level_arrays, write_two_levels

from habitus.body.joint_layouts import LAYOUTS, SMPL, folded_weights
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body

SETS = ("smpl", "smplh", "smplx")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_two_levels(tmp_path_factory.mktemp("bodies") / "made_up.npz")


@pytest.fixture(params=["made up", "neutral"], scope="module")
def source(request, file):
    return file if request.param == "made up" else request.param


def state(body: BodyModel, seed: int = 0, batch: int = 3):
    rng = np.random.default_rng(seed)
    pose = 0.5 * rng.normal(size=(batch, body.num_joints, 3))
    return rng.normal(size=(batch, body.num_betas)), pose, rng.normal(size=(batch, 3))


@pytest.mark.parametrize("joints", SETS)
def test_both_levels_are_one_surface_in_every_shape_pose_face_flesh_and_age(source, joints):
    coarse = load_body(source, joints=joints)
    full = load_body(source, joints=joints, detail="full")
    assert coarse.full is not None and full.full is None and coarse.num_vertices < full.num_vertices
    assert coarse.mesh is None and full.mesh is not None
    betas, pose, trans = state(coarse)
    face = np.random.default_rng(1).normal(size=(3, coarse.num_expressions))
    flesh = np.random.default_rng(2).normal(size=(3, coarse.num_dynamics))
    for make in (lambda body: body, lambda body: body.at_age(9.5), lambda body: body.with_betas(3)):
        one = make(coarse)
        other = make(full)
        few = betas[:, : one.num_betas]
        moved = {"expression": face, "dynamics": flesh}
        a, b, c = (body(few, pose, trans, **moved) for body in (one, other, one.full))
        for found in (b, c):
            assert np.abs(a.vertices - found.vertices[:, one.full_vertices]).max() < 1e-6
            assert np.abs(a.joints - found.joints).max() < 1e-6
        assert dict(one.landmarks).keys() == dict(other.landmarks).keys()
        for name, vertex in one.landmarks.items():
            assert one.full_vertices[vertex] == other.landmarks[name]
        if one.mirror is not None:
            assert np.array_equal(one.full_vertices[one.mirror], other.mirror[one.full_vertices])


@pytest.mark.parametrize("joints", ["smpl", "smplh"])
def test_joints_that_rest_may_be_folded_away(source, joints):
    many = load_body(source, joints="smplx")
    few = many.with_joints(joints)
    assert few.joint_names == LAYOUTS[joints].joint_names and few.parents == LAYOUTS[joints].parents
    rng = np.random.default_rng(4)
    turns = {name: 0.6 * rng.normal(size=3) for name in few.joint_names if name in many.joint_names}
    betas = rng.normal(size=many.num_betas)
    for skinning in ("lbs", "dqbs"):
        one, other = (
            replace(body, skinning=skinning)(betas, turns, [0.1, 0, 0]) for body in (many, few)
        )
        assert np.abs(one.vertices - other.vertices).max() < 1e-9
        for name in few.joint_names:
            twin = many.joint_names.index(
                {"left_hand": "left_middle1", "right_hand": "right_middle1"}.get(name, name)
            )
            assert np.abs(other.joints[few.joint_names.index(name)] - one.joints[twin]).max() < 1e-9
    assert np.allclose(few.skinning_weights.sum(1), many.skinning_weights.sum(1), atol=1e-12)
    assert few.full.joint_names == few.joint_names
    again = load_body(source, joints=joints)
    assert np.array_equal(again().vertices, few().vertices) and again.pose_joints == few.pose_joints


def test_a_folded_hand_moves_all_its_fingers_together(source):
    """The hand of SMPL carries all that any finger carries."""
    many = load_body(source, joints="smplx")
    few = load_body(source, joints="smpl")
    fingers = [
        k
        for k, name in enumerate(many.joint_names)
        if name.startswith("left_") and name[-1] in "123"
    ]
    assert len(fingers) == 15
    hand = few.joint_names.index("left_hand")
    assert np.allclose(
        few.skinning_weights[:, hand], many.skinning_weights[:, fingers].sum(1), atol=1e-12
    )


def test_a_joint_set_that_a_body_has_not_is_refused(file):
    with pytest.raises(
        HabitusError, match="made_up has no joint 'left_index1', which smplh has; it has 24 joints"
    ):
        load_body(file, joints="smpl").with_joints("smplh")
    with pytest.raises(HabitusError, match="joints are 'all'; expected one of smpl, smplh"):
        load_body(file, joints="all")
    with pytest.raises(HabitusError, match="detail is 'fine'; expected one of coarse, full"):
        load_body(file, detail="fine")
    body = load_body(file, joints="smpl")
    assert body.with_joints("smpl") is body


def test_a_joint_that_carries_a_vertex_twice_carries_it_once():
    index, value = folded_weights(
        (0, 1, 1, 2), np.array([[1, 2, 3, 0], [3, 1, 0, 2]]), np.full((2, 4), 0.25)
    )
    assert index[0, 0] == index[1, 0] == 1 and value[:, 0].tolist() == [0.5, 0.5]
    assert sorted(zip(index[0, :3].tolist(), value[0, :3].tolist(), strict=True)) == [
        (0, 0.25),
        (1, 0.5),
        (2, 0.25),
    ]
    assert not value[:, 3].any()


def test_ages_are_straight_lines_between_people(source):
    adult = load_body(source)
    assert np.abs(adult.at_age(25).v_template - adult.v_template).max() < 1e-12
    assert np.array_equal(adult.at_age(25).shapedirs, adult.shapedirs)
    for before, after in pairwise(adult.ages.years.tolist()):
        ends = [adult.at_age(years) for years in (before, after)]
        middle = adult.at_age((before + after) / 2)
        for name in ("v_template", "shapedirs", "posedirs"):
            mean = (getattr(ends[0], name) + getattr(ends[1], name)) / 2
            assert np.abs(getattr(middle, name) - mean).max() < 1e-12
    child = adult.at_age(8)
    grown = np.abs(child.full.shapedirs).sum() / np.abs(adult.full.shapedirs).sum()
    tall, taller = (np.ptp(body.full.v_template[:, 1]) for body in (child, adult))
    spread = adult.ages.spreads[adult.ages.years.tolist().index(8)]
    assert grown == pytest.approx(spread * tall / taller, abs=1e-6)
    posed = np.abs(child.full.posedirs).sum() / np.abs(adult.full.posedirs).sum()
    assert posed == pytest.approx(tall / taller, abs=1e-6)
    assert child.called == f"{adult.name} of 8 years" and child.full.called == child.called
    assert (child.age, child.full.age, adult.age) == (8, 8, None)
    first, last = adult.ages.years[[0, -1]]
    for years in (first - 0.1, last + 0.1):
        with pytest.raises(HabitusError, match=f"this body knows {first:g} to {last:g} years"):
            adult.at_age(years)
    with pytest.raises(HabitusError, match="of 8 years cannot be brought to 10"):
        child.at_age(10)


def test_spreads_of_ages_are_optional_and_above_zero(tmp_path):
    arrays = two_level_arrays()
    for number, spreads in enumerate((None, np.zeros(len(YEARS)))):
        path = tmp_path / f"{number}.npz"
        own = {} if spreads is None else {"age_spread": spreads}
        np.savez(path, **{key: v for key, v in arrays.items() if key != "age_spread"}, **own)
    plain = load_body(tmp_path / "0.npz")
    child, tall = plain.at_age(5), plain.ages.statures[0] / plain.ages.adult
    assert np.allclose(child.shapedirs, tall * plain.shapedirs, atol=1e-12)
    with pytest.raises(HabitusError, match=r"'age_spread' is .* expected factors above 0"):
        load_body(tmp_path / "1.npz")


def test_an_expression_moves_the_face_apart_from_shape(source):
    body = load_body(source, joints="smplx")
    betas, pose, trans = state(body, batch=2)
    face = np.random.default_rng(2).normal(size=(2, 3))
    still = body(betas, pose, trans, expression=np.zeros(3)).vertices
    assert np.abs(body(betas, pose, trans).vertices - still).max() < 1e-14
    shaped = replace(
        body,
        v_template=body.v_template + body.expressiondirs[..., :3] @ face[0],
        expressiondirs=None,
    )
    found = body(betas, pose, trans, expression=face[0])
    known = shaped(betas, pose, trans)
    assert (
        np.abs(found.vertices - known.vertices).max() < 1e-9
        and np.abs(found.joints - known.joints).max() < 1e-9
    )
    assert found.betas.shape == (2, body.num_betas)
    both = body(betas[0], pose, trans, expression=face)
    assert (
        np.abs(
            both.vertices[1] - body(betas[0], pose[1], trans[1], expression=face[1]).vertices
        ).max()
        < 1e-12
    )
    with pytest.raises(HabitusError, match="expression has shape"):
        body(expression=np.zeros(body.num_expressions + 1))


def test_a_coarse_body_changed_by_itself_is_no_longer_the_full_one(file):
    body = load_body(file)
    assert replace(body, name="other").full is not None
    for change in (
        {"posedirs": None},
        {"skinning": "dqbs"},
        {"shapedirs": 2 * body.shapedirs},
        {"dynamics": None},
    ):
        assert replace(body, **change).full is None
    assert replace(body, v_template=body.v_template + 1e-3).full is None
    assert replace(body, dynamics=body.dynamics.scaled(1.1)).full is None


def test_a_full_surface_has_quads_and_texture(file):
    full = load_body(file, detail="full")
    assert (
        full().mesh is full.mesh
        and full(vertices=[1, 2]).mesh is None
        and load_body(file)().mesh is None
    )
    corners = full.mesh.triangle_uv(full.faces)
    assert np.array_equal(corners[: len(full.mesh.quads)], full.mesh.quad_uv[:, [0, 1, 2]])
    assert np.array_equal(corners[len(full.mesh.quads) :], full.mesh.quad_uv[:, [0, 2, 3]])
    order = np.random.default_rng(0).permutation(len(full.faces))
    assert np.array_equal(full.mesh.triangle_uv(full.faces[order]), corners[order])
    assert full.mesh.triangle_uv(full.faces[:-1]) is None
    twice = np.concatenate([full.faces[:1], full.faces[:-1]])
    assert full.mesh.triangle_uv(twice) is None


def test_twist_is_driven_by_its_own_joints(file):
    body = load_body(file, joints="smplx")
    assert body.pose_joints == DRIVERS and load_body(file, joints="smpl").pose_joints == DRIVERS
    assert SMPL.joint_names[20] == "left_wrist"
    plain = replace(body, posedirs=None)
    for joint, drives in (
        ("left_elbow", False),
        ("left_wrist", True),
        ("right_hip", True),
        ("left_index1", False),
    ):
        turn = {joint: (0.5, 0.2, 0)}
        change = np.abs(body(pose=turn).vertices - plain(pose=turn).vertices).max()
        assert change > 1e-3 if drives else change < 1e-12
    assert np.array_equal(body().vertices, plain().vertices)
