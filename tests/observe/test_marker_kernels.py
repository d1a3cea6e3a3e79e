"""The compiled marker function against the torch twin: values, and every derivative against autodiff."""

import numpy as np
import pytest
import torch
from rigged_body import random_body, surface

from habitus.errors import HabitusError
from habitus.observe.marker_prediction import linearize, marker_bases, predict, predict_plainly
from habitus.observe.marker_rig import marker_rig
from habitus.observe.markers import MarkerAttachment, attach, predict_markers
from habitus.observe.plain_kernels import rotation_series

MARKERS = 7


def setting(seed, **kind):
    body, rng = random_body(seed, **kind), np.random.default_rng(seed + 100)
    betas = rng.normal(size=body.shapedirs.shape[2])
    rest = body.v_template + body.shapedirs @ torch.tensor(betas)
    triangles = body.faces[:MARKERS].numpy()
    latent = rest[body.faces[:MARKERS, 0]].numpy() + rng.normal(size=(MARKERS, 3)) * 0.05
    return body, betas, attach(latent, rest, body.faces, triangles=triangles), rng


def states(body, rng, angle):
    pose = rng.normal(size=(3, len(body.parents), 3))
    pose *= angle / np.linalg.norm(pose, axis=-1, keepdims=True)
    return pose, rng.normal(size=(3, 3))


KINDS = [{}, {"posedirs": False}, {"joints": 11, "influences": 4}, {"joints": 2, "influences": 1}]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.5, 1.0, np.pi - 1e-6, np.pi, 4.5])
def test_linearization_agrees_with_autodiff(kind, angle):
    body, betas, attachment, rng = setting(3, **kind)
    pose, trans = states(body, rng, angle)
    soft = rng.normal(size=(3, len(betas))) * 0.3
    rig = marker_rig(body, betas, attachment)
    markers, jacobian = linearize(rig, pose, trans, soft)
    np.testing.assert_allclose(predict_plainly(rig, pose, trans, soft), markers, atol=1e-14)
    np.testing.assert_allclose(predict(rig, pose, trans, soft), markers, atol=1e-12)

    def twin(flat):
        move, turn, shape = flat[:3], flat[3 : 3 + pose[0].size].reshape(-1, 3), flat[3 + pose[0].size :]
        return predict_markers(surface(body, torch.tensor(betas) + shape, turn, move), attachment)

    for t in range(3):
        flat = torch.tensor(np.concatenate([trans[t], pose[t].ravel(), soft[t]]))
        np.testing.assert_allclose(markers[t], twin(flat), atol=1e-12)
        np.testing.assert_allclose(jacobian[t], torch.autograd.functional.jacobian(twin, flat), atol=1e-10)


def test_no_soft_tissue_means_no_columns_and_zero_soft_tissue():
    body, betas, attachment, rng = setting(5)
    pose, trans = states(body, rng, 0.7)
    rig = marker_rig(body, betas, attachment)
    plain = linearize(rig, pose, trans)
    full = linearize(rig, pose, trans, np.zeros((3, len(betas))))
    np.testing.assert_allclose(plain[0], full[0], atol=1e-14)
    np.testing.assert_allclose(plain[1], full[1][..., : plain[1].shape[-1]], atol=1e-14)


def test_soft_tissue_is_a_change_of_betas():
    body, betas, attachment, rng = setting(6)
    pose, trans = states(body, rng, 0.7)
    change = rng.normal(size=len(betas))
    moved = predict(marker_rig(body, betas + change, attachment), pose, trans)
    same = predict(marker_rig(body, betas, attachment), pose, trans, np.tile(change, (3, 1)))
    np.testing.assert_allclose(moved, same, atol=1e-12)


def test_rest_pose_returns_the_latent_markers():
    body, betas, attachment, _ = setting(7)
    rest = body.v_template + body.shapedirs @ torch.tensor(betas)
    latent = predict_markers(rest, attachment).numpy()
    rig = marker_rig(body, betas, attachment)
    np.testing.assert_allclose(predict(rig, np.zeros((1, 6, 3)), np.zeros((1, 3)))[0], latent, atol=1e-13)


def test_bases_are_the_derivative_to_the_coefficients():
    body, betas, attachment, rng = setting(8)
    pose, trans = states(body, rng, 0.9)
    change = rng.normal(size=(MARKERS, 3))
    bases = marker_bases(marker_rig(body, betas, attachment), pose, trans)
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
    quarter, root = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), rig.rest_joints[0]
    np.testing.assert_allclose(turned - root, (still - root) @ quarter.T, atol=1e-12)


def test_the_rotation_series_is_continuous_where_it_changes_formula():
    below, above = rotation_series(0.25 - 1e-15), rotation_series(0.25 + 1e-15)
    np.testing.assert_allclose(below, above, rtol=1e-14)


def test_bodies_that_kernels_do_not_know_are_refused():
    body, betas, attachment, _ = setting(10)
    body.skinning = "dqbs"
    with pytest.raises(HabitusError, match="linearly"):
        marker_rig(body, betas, attachment)
    body.skinning = "lbs"
    for features, shapes in (("angles", 0), ("rotations", 2)):
        body.pose_features, body.shape_features = features, shapes
        with pytest.raises(HabitusError, match=f"driven by '{features}'.*; marker fits need 'rotations' alone"):
            marker_rig(body, betas, attachment)
    posedirs, body.posedirs = body.posedirs, None
    assert marker_rig(body, betas, attachment).corner_posedirs.shape[2] == 0  # nothing there to be driven
    body.posedirs, body.pose_features, body.shape_features = posedirs, "rotations", 0
    with pytest.raises(HabitusError, match="sit on vertex"):
        marker_rig(body, betas, MarkerAttachment(attachment.triangles + 1000, attachment.coefficients))
    with pytest.raises(HabitusError, match="betas"):
        marker_rig(body, np.zeros(99), attachment)
