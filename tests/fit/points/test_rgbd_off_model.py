"""Skin off the model: a field over the surface that all views share, what is worn, soles on the
floor, lost limbs.
"""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_scene_small import small_scene

from habitus.body.state import BodyState
from habitus.fit.offsets import along_normals, offset_spread
from habitus.fit.points.correspondences import Footpads
from habitus.fit.points.depth import fit_state
from habitus.fit.points.depth_energy import DepthEnergy, degrees_between, in_pelvis_frame
from habitus.fit.points.depth_limbs import retry_limbs
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.fit.points.depth_start import arm_poses
from habitus.fit.points.prepared_views import segment
from habitus.fit.points.skin_offsets import (
    SkinField,
    SkinPlanes,
    clothing,
    moved_back,
    skin_planes_term,
)
from habitus.io.models.bodies import load_body
from habitus.mesh.normals import vertex_normals
from habitus.residuals.points import PointObservations, points_on_surface
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix
from habitus.solve.least_squares import Levenberg
from habitus.solve.minimize import minimize
from habitus.solve.terms import Term

SETTINGS = RgbdSettings(clothes=0.0, hair=0.0)


@pytest.fixture(scope="module")
def body():
    return load_body("default")


@pytest.fixture(scope="module")
def field(body):
    return SkinField.of(body, SETTINGS)


def test_the_field_is_as_wide_as_told_and_alike_nearby(body, field):
    rest = body.rest_vertices(np.zeros(body.num_betas))
    told = SETTINGS.skin * offset_spread(body)
    spread = np.sqrt((field.basis**2).sum(1))
    trunk = (
        body.skinning_weights[:, [body.joint_names.index(f"spine{k}") for k in (1, 2)]].sum(1) > 0.8
    )
    assert 0.7 < np.median(spread[trunk] / told[trunk]) < 1.1
    navel = np.flatnonzero(trunk)[np.argmax(rest[trunk, 2])]
    alike = (field.basis @ field.basis[navel]) / (spread * spread[navel]).clip(1e-9)
    away = np.linalg.norm(rest - rest[navel], axis=1)
    assert alike[away < 0.03].min() > 0.8
    assert np.abs(alike[away > 0.6]).max() < 0.1


def test_soles_have_no_offset(body, field):
    pads = Footpads.of(body)
    assert np.abs(field.basis[body.faces[pads.face, pads.corner]]).max() == 0.0


def test_clothes_and_hair_lie_where_they_are_clothing(body):
    layer = clothing(body, RgbdSettings(clothes=0.001, hair=0.003))
    rest = body.rest_vertices(np.zeros(body.num_betas))
    assert np.isclose(layer[rest[:, 1].argmax()], 0.003, atol=2e-4)
    head = body.skinning_weights[:, body.joint_names.index("head")] > 0.9
    nose = np.flatnonzero(head)[rest[head, 2].argmax()]
    assert layer[nose] < 1e-4
    for name, told in (("spine1", 0.001), ("left_elbow", 0.0), ("right_ankle", 0.0)):
        part = body.skinning_weights[:, body.joint_names.index(name)] > 0.95
        np.testing.assert_allclose(layer[part], told, atol=1e-4)


def test_an_offset_is_found_and_the_shape_stays(body, field):
    """Points on the front of a planted person; what the field tells elsewhere is the likeliest, not
    the truth.
    """
    rng = np.random.default_rng(3)
    pose = np.zeros((2, body.num_joints, 3))
    trans = np.zeros((2, 3))
    planted = rng.normal(size=field.count)
    state = BodyState(np.zeros(body.num_betas), pose, trans)
    numbers = np.zeros(field.count)
    model = body(state.betas, pose, trans).vertices
    seen = along_normals(model, field.offset(planted), body)
    facing = vertex_normals(model[0], body.faces)[:, 2]
    front = np.flatnonzero(facing[body.faces].min(1) > 0.5)
    face = np.repeat(front, 2)
    share = rng.dirichlet((1, 1, 1), 2 * len(front))
    normal = vertex_normals(seen[0], body.faces)[body.faces[face, 0]]

    def matches(surface):
        target = points_on_surface(seen[0], body.faces, face, share)
        return [
            PointObservations.to_planes(face, share, target, normal, np.full(len(face), 1e6))
        ] * len(surface)

    energy = DepthEnergy.of(body, [], SETTINGS)
    views = [
        SkinPlanes.of(field, state, k, numbers, each, model[k], model[k])
        for k, each in enumerate(matches(model))
    ]
    count = field.count
    terms = {
        "depth": skin_planes_term(body, views, count),
        **energy.priors(pose),
        "skin": Term(lambda skin: (skin, {"skin": np.eye(count)})),
    }
    start = {"betas": state.betas, "pose": pose, "trans": trans, "skin": numbers}
    solve = {"max_accepted": 1, "stretch": False}
    found = minimize(terms, start, Levenberg(1e-9), blocks=("pose", "trans"), **solve).state
    alone = minimize(
        terms, start, Levenberg(1e-9), blocks=("pose", "trans"), fixed=("skin",), **solve
    ).state
    told = facing > 0.6
    left = field.offset(found["skin"]) - field.offset(planted)
    assert np.std(left[told]) < 0.4 * np.std(field.offset(planted)[told])
    assert np.linalg.norm(found["betas"]) < 0.7 * np.linalg.norm(alone["betas"])


def test_targets_move_back_by_what_lies_between(body):
    model = body.rest_vertices(np.zeros(body.num_betas))
    seen = model + 0.01
    face = np.arange(5)
    share = np.full((5, 3), 1 / 3)
    one = PointObservations.to_planes(
        face, share, np.zeros((5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1)), np.ones(5)
    )
    np.testing.assert_allclose(moved_back(one, model, seen, body).target, -0.01)


def test_soles_stand_as_high_as_they_are_at_rest(body):
    pads = Footpads.of(body)
    rest = body.rest_vertices(np.zeros(body.num_betas))
    used = body.faces[pads.face, pads.corner]
    standing = rest - [0.0, rest[used, 1].min(), 0.0]
    here = pads.on_floor(standing, body, RgbdSettings(floor=1.0))
    apart = points_on_surface(standing, body.faces, here.face, here.barycentric) - here.target
    assert np.abs(apart[:, 1]).max() < 0.006  # 14 mm, were all of a sole drawn to the floor
    lifted = pads.on_floor(
        standing + np.array([0.0, RgbdSettings().floor_scale, 0.0]), body, RgbdSettings(floor=1.0)
    )
    assert np.allclose(
        np.median(
            np.linalg.norm(lifted.directions, axis=-1) / np.linalg.norm(here.directions, axis=-1)
        ),
        0.5,
        atol=0.15,
    )


def test_soles_below_the_floor_keep_their_weight(body):
    """Legs too long by 13 cm went through the floor, where no pixel contradicts them."""
    pads = Footpads.of(body)
    rest = body.rest_vertices(np.zeros(body.num_betas))
    used = body.faces[pads.face, pads.corner]
    standing = rest - [0.0, rest[used, 1].min(), 0.0]
    here, below = (
        np.linalg.norm(pads.on_floor(standing - [0.0, depth, 0.0], body, SETTINGS).directions)
        for depth in (0.02, 0.13)
    )
    assert np.isclose(here, below)


@pytest.fixture(scope="module")
def fitted(body):
    """The planted scene, and a fit by depth from a start with other arms, turned by 30 degrees."""
    scene = small_scene()[1]
    poses = np.stack(list(arm_poses(body, ((0.0, 0.0, 0.0),))) * 2)
    poses[:, 0, 1] = np.deg2rad([30.0, 15.0])
    return scene, fit_state(scene.capture, body, replace(SETTINGS, colour_levels=()), start=poses)


def test_a_start_with_other_arms_comes_home(fitted):
    scene, found = fitted
    for k, sight in enumerate(found.prepared_views):
        true = scene.surfaces[k] @ sight.turn.T + sight.shift
        assert np.linalg.norm(found.seen[k] - true, axis=1).mean() < 0.02
    assert np.abs(found.skin).max() < 0.02 and found.skin.std() > 2e-4


def test_an_arm_that_one_view_lost_is_found_again(fitted, body):
    scene, found = fitted
    energy = DepthEnergy.of(body, found.prepared_views, SETTINGS)
    state = found.state
    pose = found.state.pose.copy()
    arm = [body.joint_names.index(name) for name in ("left_shoulder", "left_elbow")]
    pose[1, arm] = next(arm_poses(body, ((-60.0, 40.0, 0.0),)))[arm]
    again, _ = retry_limbs(energy, replace(state, pose=pose), pose)
    true = scene.surfaces[1] @ found.prepared_views[1].turn.T + found.prepared_views[1].shift
    before, after = (energy.surfaces(one)[1] for one in (replace(state, pose=pose), again))
    away = [np.linalg.norm(surface - true, axis=1).mean() for surface in (before, after)]
    assert away[0] > 0.07 and away[1] < 0.03


def test_a_person_who_was_fitted_facing_away_is_turned_back(fitted, body):
    scene, found = fitted
    energy = DepthEnergy.of(body, found.prepared_views, SETTINGS)
    pose = found.state.pose.copy()
    half = matrix_from_rotvec(np.array([0.0, np.pi, 0.0]))
    pose[1, 0] = rotvec_from_matrix(half @ matrix_from_rotvec(pose[1, 0]))
    arms = [k for k, name in enumerate(body.joint_names) if name.endswith(("shoulder", "elbow"))]
    pose[1, arms] = next(arm_poses(body, ((0.0, 60.0, 60.0),)))[arms]
    again, _ = retry_limbs(energy, replace(found.state, pose=pose), pose)
    true = scene.surfaces[1] @ found.prepared_views[1].turn.T + found.prepared_views[1].shift
    away = np.linalg.norm(energy.surfaces(again)[1] - true, axis=1).mean()
    assert away < 0.03


def test_a_forearm_that_one_view_has_turned_about_its_axis_is_turned_back(fitted, body):
    _, found = fitted
    energy = DepthEnergy.of(body, found.prepared_views, SETTINGS)
    pose = found.state.pose.copy()
    elbow = body.joint_names.index("left_elbow")
    turn = matrix_from_rotvec(np.array([2.0, 0.0, 0.0]))
    pose[1, elbow] = rotvec_from_matrix(matrix_from_rotvec(pose[1, elbow]) @ turn)
    turned = replace(found.state, pose=pose)
    again, _ = retry_limbs(energy, turned, pose)
    before, after = (
        degrees_between(*in_pelvis_frame(body, state)[1])[elbow] for state in (turned, again)
    )
    assert before > 90.0 and after < 30.0


def test_where_no_limb_is_in_doubt_none_moves(fitted, body):
    _, found = fitted
    energy = DepthEnergy.of(body, found.prepared_views[1:], SETTINGS)
    alone = BodyState(found.state.betas, found.state.pose[1:], found.state.trans[1:])
    same, means = retry_limbs(energy, alone, alone.pose)
    assert same is alone and means is alone.pose


def test_a_person_cut_out_of_the_background_is_fitted_by_depth_alone():
    """No floor and nothing behind the person: there are no floor or outline points in any view."""
    body, scene = small_scene()
    views = []
    for view in scene.capture.views:
        mask = segment(view).mask
        cut = replace(
            view, depth=np.where(mask, view.depth, 0.0), mask=mask, background=None, colour=None,
            colour_camera=None, background_colour=None,
        )  # fmt: skip
        views.append(cut)
    search = replace(SETTINGS.search, turns=(0.0,), arms=((45.0, 0.0, 0.0),))
    few = replace(SETTINGS, skin_steps=1, search=search)
    found = fit_state(replace(scene.capture, views=tuple(views)), body, few)
    assert not any(view.on_floor for view in found.prepared_views)
    assert set(found.terms) == {"depth", "shape", "pose", "skin"}
    assert found.terms["depth"] > 0.0 and np.isfinite(sum(found.terms.values()))
