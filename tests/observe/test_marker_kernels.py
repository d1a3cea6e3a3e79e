"""Predicted markers, compiled and by the body, against a torch reference; every derivative against
autodiff.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hinged_body import KNEE, with_hinges
from rigged_body import random_body, surface

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.observe.marker_prediction import BATCH, BodyMarkers, marked_body, predict
from habitus.observe.marker_rig import MarkerRig, marker_rig
from habitus.observe.markers import MarkerAttachment, attach, marker_jacobian, predict_markers

MARKERS = 7


def setting(seed, **kind):
    body = random_body(seed, **kind)
    rng = np.random.default_rng(seed + 100)
    betas = rng.normal(size=body.shapedirs.shape[2])
    rest = body.v_template + body.shapedirs @ betas
    triangles = body.faces[:MARKERS]
    latent = rest[body.faces[:MARKERS, 0]] + rng.normal(size=(MARKERS, 3)) * 0.05
    return body, betas, attach(latent, rest, body.faces, triangles=triangles), rng


def states(body, rng, angle):
    pose = rng.normal(size=(3, len(body.parents), 3))
    pose *= angle / np.linalg.norm(pose, axis=-1, keepdims=True)
    return pose, rng.normal(size=(3, 3))


KINDS = [
    {},
    {"drivers": (4, 1)},
    {"posedirs": False},
    {"joints": 11, "influences": 4},
    {"joints": 2, "influences": 1},
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.5, 1.0, np.pi - 1e-6, np.pi, 4.5])
def test_linearization_agrees_with_autodiff(kind, angle):
    body, betas, attachment, rng = setting(3, **kind)
    pose, trans = states(body, rng, angle)
    soft = rng.normal(size=(3, len(betas))) * 0.3
    found = BodyMarkers(body, betas, attachment).jacobian(pose, trans, soft)
    by_trans = np.broadcast_to(np.eye(3), (3, MARKERS, 3, 3))
    markers = found.markers
    jacobian = np.concatenate([by_trans, found.by_pose, found.by_betas], axis=-1)
    np.testing.assert_allclose(
        predict(marker_rig(body, betas, attachment), pose, trans, soft), markers, atol=1e-12
    )

    def reference(flat):
        move = flat[:3]
        turn = flat[3 : 3 + pose[0].size].reshape(-1, 3)
        shape = flat[3 + pose[0].size :]
        return predict_markers(surface(body, torch.tensor(betas) + shape, turn, move), attachment)

    for t in range(3):
        flat = torch.tensor(np.concatenate([trans[t], pose[t].ravel(), soft[t]]))
        np.testing.assert_allclose(markers[t], reference(flat), atol=1e-12)
        np.testing.assert_allclose(
            jacobian[t], torch.autograd.functional.jacobian(reference, flat), atol=1e-10
        )


@pytest.mark.parametrize("kind", [MarkerRig, BodyMarkers])
def test_no_soft_tissue_is_zero_soft_tissue(kind):
    body, betas, attachment, rng = setting(5)
    pose, trans = (
        np.tile(each, (BATCH, *[1] * (each.ndim - 1))) for each in states(body, rng, 0.7)
    )
    marked = (
        marker_rig(body, betas, attachment)
        if kind is MarkerRig
        else BodyMarkers(body, betas, attachment)
    )
    none = predict(marked, pose, trans)
    np.testing.assert_allclose(
        none, predict(marked, pose, trans, np.zeros((len(pose), len(betas)))), atol=1e-14
    )
    np.testing.assert_allclose(none[3 * BATCH - 3 :], none[:3], atol=1e-14)
    assert predict(marked, pose[:0], trans[:0]).shape == (0, MARKERS, 3)
    np.testing.assert_allclose(
        marked.rest_joints, body.rest_joints(torch.tensor(betas)), atol=1e-14
    )


@pytest.mark.parametrize(
    "change", [{"skinning": "dqbs"}, {"pose_features": "angles"}, {"shape_features": 2}]
)
def test_bodies_of_other_kinds_go_by_the_body(change):
    body, betas, attachment, rng = setting(6)
    per_joint = 3 if "pose_features" in change else 9
    blocks = 1 + change.get("shape_features", 0)
    count = 5 * per_joint * blocks
    body = replace(body, posedirs=0.02 * rng.normal(size=(40, 3, count)), **change)
    pose, trans = states(body, rng, 0.7)
    marked = marked_body(body, betas, attachment)
    assert isinstance(marked, BodyMarkers) and isinstance(
        marked_body(replace(body, posedirs=None, skinning="lbs"), betas, attachment), MarkerRig
    )
    posed = body(torch.tensor(betas), torch.tensor(pose), torch.tensor(trans)).vertices
    np.testing.assert_allclose(
        predict(marked, pose, trans), predict_markers(posed, attachment), atol=1e-13
    )


@pytest.mark.parametrize("degrees", [40.0, 100.0, 140.0])
def test_deep_folds_are_the_bodys(degrees):
    """Markers on a real body's knee, with soft tissue that changes the betas."""
    body = with_hinges(load_body("female"))
    betas = np.array([1.0, -0.5, *np.zeros(body.num_betas - 2)])
    near = np.flatnonzero(body.hinges.directions[body.faces].any((1, 2, 3, 4)))[::60]
    rest = body.rest_vertices(betas)
    triangles = body.faces[near]
    attachment = attach(rest[triangles[:, 0]] + 0.01, rest, body.faces, triangles=triangles)
    pose = np.zeros((3, body.num_joints, 3))
    pose[:, body.joint_names.index(KNEE)] = [np.radians(degrees), 0.1, 0.0]
    soft = np.random.default_rng(0).normal(size=(3, body.num_betas))
    trans = np.zeros((3, 3))
    rig = marked_body(body, betas, attachment)
    assert isinstance(rig, MarkerRig)
    exact = BodyMarkers(body, betas, attachment)
    for change in (None, soft):
        np.testing.assert_allclose(
            predict(rig, pose, trans, change), exact.predict(pose, trans, change), atol=1e-9
        )


def test_soft_tissue_is_a_change_of_betas():
    body, betas, attachment, rng = setting(6)
    pose, trans = states(body, rng, 0.7)
    change = rng.normal(size=len(betas))
    moved = predict(marker_rig(body, betas + change, attachment), pose, trans)
    same = predict(marker_rig(body, betas, attachment), pose, trans, np.tile(change, (3, 1)))
    np.testing.assert_allclose(moved, same, atol=1e-12)


def test_rest_pose_returns_the_latent_markers():
    body, betas, attachment, _ = setting(7)
    rest = body.v_template + body.shapedirs @ betas
    latent = predict_markers(rest, attachment)
    rig = marker_rig(body, betas, attachment)
    np.testing.assert_allclose(
        predict(rig, np.zeros((1, 6, 3)), np.zeros((1, 3)))[0], latent, atol=1e-13
    )


def test_bases_are_the_derivative_to_the_coefficients():
    body, betas, attachment, rng = setting(8)
    pose, trans = states(body, rng, 0.9)
    change = rng.normal(size=(MARKERS, 3))
    bases = marker_jacobian(body, attachment, betas, pose, trans).bases
    one = predict(marker_rig(body, betas, attachment), pose, trans)
    moved = MarkerAttachment(attachment.triangles, attachment.coefficients + change)
    other = predict(marker_rig(body, betas, moved), pose, trans)
    np.testing.assert_allclose(other - one, (bases @ change[None, :, :, None])[..., 0], atol=1e-13)


def test_a_turn_of_the_world_turns_the_markers():
    body, betas, attachment, rng = setting(9)
    pose, _ = states(body, rng, 0.9)
    rig = marker_rig(body, betas, attachment)
    pose[:, 0] = 0.0
    still = predict(rig, pose, np.zeros((3, 3)))
    pose[:, 0] = (0.0, np.pi / 2, 0.0)
    turned = predict(rig, pose, np.zeros((3, 3)))
    quarter = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    root = rig.rest_joints[0]
    np.testing.assert_allclose(turned - root, (still - root) @ quarter.T, atol=1e-12)


def test_bodies_that_kernels_do_not_know_are_refused():
    body, betas, attachment, _ = setting(10)
    with pytest.raises(HabitusError, match="linearly"):
        marker_rig(replace(body, skinning="dqbs"), betas, attachment)
    for features, shapes, count in (("angles", 0, 15), ("rotations", 2, 135)):
        posedirs = np.zeros((40, 3, count))
        other = replace(body, pose_features=features, shape_features=shapes, posedirs=posedirs)
        with pytest.raises(
            HabitusError, match=f"driven by '{features}'.*; marker fits need 'rotations' alone"
        ):
            marker_rig(other, betas, attachment)
    assert (
        marker_rig(replace(other, posedirs=None), betas, attachment).corner_posedirs.shape[2] == 0
    )
    with pytest.raises(HabitusError, match="sit on vertex"):
        marker_rig(
            body, betas, MarkerAttachment(attachment.triangles + 1000, attachment.coefficients)
        )
    with pytest.raises(HabitusError, match="betas"):
        marker_rig(body, np.zeros(99), attachment)
