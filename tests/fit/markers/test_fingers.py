"""Fingers: a prior for their joints, and markers on them that drive them."""

from dataclasses import replace

import numpy as np
import pytest

from habitus.body.hand_space import hand_joints
from habitus.body.joint_layouts import LAYOUTS
from habitus.body.prior import UNKNOWN_JOINT_SD, prior_of, shipped_prior
from habitus.fit.markers.energy import FINGER_SHARE, sequence_terms
from habitus.fit.markers.marker_sequence import marker_sequence
from habitus.fit.markers.recipe import Recording, fit_markers
from habitus.fit.markers.settings import MoshSettings, SequenceSettings
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body
from habitus.markers.layouts import Marker
from habitus.observe.marker_prediction import BodyMarkers, marked_body
from habitus.observe.markers import attach, default_markers, predict_markers
from habitus.observe.simulated_markers import smooth_motion

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
RATE_HZ = 30.0


@pytest.mark.parametrize("joints", ["smpl", "smplh", "smplx"])
def test_the_prior_knows_every_joint_left_and_right_alike(joints):
    names = LAYOUTS[joints].joint_names
    prior = shipped_prior().for_joints(names)
    assert set(prior.joint_names) <= set(shipped_prior().joint_names)
    assert np.linalg.eigvalsh(prior.covariance).min() > 0
    sd = np.sqrt(np.diag(prior.covariance)).reshape(-1, 3)
    mean = prior.mean.reshape(-1, 3)
    for k, name in enumerate(prior.joint_names):
        if name.startswith("left_") and "foot" not in name:
            other = prior.joint_names.index(name.replace("left_", "right_"))
            assert np.allclose(sd[k], sd[other], atol=1e-6) and np.allclose(
                mean[k], mean[other] * [1, -1, -1]
            )
            if not np.allclose(sd[k], UNKNOWN_JOINT_SD):
                assert sd[k].min() > 0.03 and sd[k].max() < 1.0


def test_fingers_bend_towards_the_palm_one_joint_with_the_next():
    names = LAYOUTS["smplx"].joint_names
    prior = shipped_prior().for_joints(names)
    place = {name: 3 * k + 2 for k, name in enumerate(names[1:])}  # about z, forward
    sd = np.sqrt(np.diag(prior.covariance))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        for finger in FINGERS[1:]:
            knuckle, middle, last = (place[f"{side}_{finger}{k}"] for k in (1, 2, 3))
            assert all(sign * prior.mean[k] > 0.1 for k in (knuckle, middle, last))
            assert prior.covariance[middle, last] > 0.8 * sd[middle] * sd[last]
            assert sd[knuckle] > 2 * sd[knuckle - 1] > 0.1  # flexion is wider than spreading
    jaw = place["jaw"] - 2
    eye = place["left_eye_smplhf"] - 2
    assert np.all(prior.mean[jaw : jaw + 3] == 0) and np.all(prior.mean[eye : eye + 3] == 0)


def hands(body):
    """A layout of the body's markers and twenty on the tips and the middle joints of all
    fingers.
    """
    layout = load_layout("cmu-41")
    found = []
    for side in ("left", "right"):
        for finger in FINGERS:
            for part in ("tip", "ip" if finger == "thumb" else "pip"):
                place = f"{side}_{finger}_{part}"
                found.append(
                    Marker(
                        f"{side}{finger}{part}", landmark=place, distance=0.004, place_spread=0.003
                    )
                )
    return replace(layout, markers=(*layout.markers, *found))


def test_twenty_finger_markers_recover_both_hands():
    body = load_body("default", joints="smplh").with_betas(4)
    layout = hands(body)
    prior = shipped_prior()
    rng = np.random.default_rng(0)
    own = prior.for_joints(body.joint_names)
    pose, trans = smooth_motion(own.mean, 0.6 * np.sqrt(np.diag(own.covariance)), 30, RATE_HZ, rng)
    betas = np.array([1.2, -0.8, 0.6, -1.0])
    latent = default_markers(body, betas, layout.vertices(body), layout.distances())
    attachment = attach(latent, body.rest_vertices(betas), body.faces)
    truth = body(betas, pose, trans)
    exact = predict_markers(truth.vertices, attachment)
    observed = exact + 5e-4 * rng.normal(size=exact.shape)
    settings = MoshSettings(frames=4, soft_tissue=False)
    fit = fit_markers(body, prior, layout, [Recording("hands", observed, RATE_HZ, "+y")], settings)[
        0
    ]
    off = 1e3 * np.linalg.norm(fit.predicted_pose_stage[:, 41:] - exact[:, 41:], axis=-1)
    assert off.mean() < 3.0 and np.percentile(off, 95) < 6.0
    fingers = [
        k for k, name in enumerate(body.joint_names) if name[-1] in "123" and "spine" not in name
    ]
    joints = 1e3 * np.linalg.norm(fit.joints()[:, fingers] - truth.joints[:, fingers], axis=-1)
    assert joints.mean() < 3.5
    pose = np.array(fit.pose)
    pose[:, fingers] = own.mean.reshape(-1, 3)[np.array(fingers) - 1]
    stiff = 1e3 * np.linalg.norm(body(fit.betas, pose, fit.trans).joints - truth.joints, axis=-1)
    assert stiff[:, fingers].mean() > 2 * joints.mean()  # it is the bends that were found


def test_the_prior_of_fingers_has_its_share_in_kernels_and_terms():
    body = load_body("default", joints="smplh").with_betas(2)
    prior = prior_of(body).for_joints(body.joint_names)
    layout = load_layout("cmu-41")
    latent = default_markers(body, np.zeros(2), layout.vertices(body), layout.distances())
    attachment = attach(latent, body.rest_vertices(), body.faces)
    observed = np.zeros((3, len(layout), 3))
    given = (observed, None, None, prior, SequenceSettings())
    rig = marked_body(body, np.zeros(2), attachment)
    precision = marker_sequence(rig, *given, 0).data.precision[6:, 6:]
    size = 3 * (body.num_joints - 1)
    fingers = np.isin(prior.joint_names, hand_joints()).repeat(3)
    share = np.where(fingers, FINGER_SHARE, 1.0) ** 0.5
    wanted = share[:, None] * prior.precision * share
    np.testing.assert_allclose(precision[:size, :size], wanted, rtol=1e-6, atol=1e-6)
    pose = np.random.default_rng(0).normal(size=(3, body.num_joints, 3))
    terms = sequence_terms(BodyMarkers(body, np.zeros(2), attachment), *given)
    away = pose[:, 1:].reshape(3, -1) - prior.mean
    residual = terms["pose"]({"pose": pose}).residual
    assert np.sum(residual**2) == pytest.approx(np.sum((away @ wanted) * away), rel=1e-6)
