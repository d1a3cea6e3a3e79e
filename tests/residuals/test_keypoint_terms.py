"""The term of keypoints: derivatives, and one shape of keypoints and joints in one solve."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import habitus as hb
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus_lab.population.camera_scenes import CameraScene, camera_scene

FRAMES = 3


@cache
def _scene() -> CameraScene:
    body = hb.load_body("neutral")
    rng = np.random.default_rng(0)
    prior = prior_of(body).for_joints(body.joint_names)
    own = (
        prior.mean
        + 0.4 * rng.normal(size=(FRAMES, len(prior.mean))) @ np.linalg.cholesky(prior.covariance).T
    )
    pose = np.concatenate([np.zeros((FRAMES, 3)), own], 1).reshape(FRAMES, -1, 3)
    return camera_scene(body, pose, np.zeros((FRAMES, 3)), 50.0, 3, rng, definition=0.0)


def _term(**changes) -> hb.terms.Keypoints:
    scene = _scene()
    return replace(hb.terms.Keypoints.of(scene.body, scene.detections, scene.rig), **changes)


def test_the_gradient_is_that_of_the_cost():
    scene = _scene()
    term = _term()
    rng = np.random.default_rng(1)
    state = {
        "betas": scene.betas + 0.1 * rng.normal(size=scene.betas.shape),
        "pose": scene.pose + 0.03 * rng.normal(size=scene.pose.shape),
        "trans": scene.trans + 0.02,
    }
    gradient, blocks = term(**state).derivatives()
    step = 1e-6
    for name in state:
        flat = gradient[name].ravel()
        for n in rng.choice(flat.size, min(6, flat.size), replace=False):
            ends = []
            for sign in (1.0, -1.0):
                moved = state[name].copy().ravel()
                moved[n] += sign * step
                ends.append(term(**{**state, name: moved.reshape(state[name].shape)}).cost)
            numeric = (ends[0] - ends[1]) / (2.0 * step)
            assert abs(flat[n] - numeric) < 1e-5 * max(1.0, np.abs(flat).max())
    assert np.linalg.eigvalsh(blocks["betas", "betas"]).min() > -1e-6
    np.testing.assert_allclose(blocks["pose", "pose"], blocks["pose", "pose"].swapaxes(1, 2))


def test_rows_of_other_poses_are_left_alone():
    scene = _scene()
    term = _term(pixels=_term().pixels[1:2], weights=_term().weights[1:2], rows=[2])
    pose, trans = np.roll(scene.pose, 1, axis=0), scene.trans
    gradient, _ = term(scene.betas, pose, trans).derivatives()
    assert gradient["pose"][2].any() and not gradient["pose"][:2].any()
    with pytest.raises(HabitusError, match="for 3 poses; name their rows"):
        replace(term, rows=None)(scene.betas, pose, trans)


def test_keypoints_and_other_terms_give_one_person():
    """Two cameras and three joints: each leaves something open."""
    scene = _scene()
    start = {
        "betas": np.zeros_like(scene.betas),
        "pose": np.tile(
            np.concatenate(
                [np.zeros((1, 3)), prior_of(scene.body).for_joints(scene.body.joint_names)
                 .mean.reshape(-1, 3)]
            ), (FRAMES, 1, 1),
        ),
        "trans": scene.trans + 0.05,
    }  # fmt: skip
    terms = {
        "keypoints": _term(reach=30.0),
        "pose": hb.terms.PosePrior(scene.body),
        "betas": hb.terms.ShapePrior(),
    }
    found = hb.minimize(terms, start, blocks=("trans", "pose"), max_iterations=40)
    joints = np.asarray(
        scene.body(found.values["betas"], found.values["pose"], found.values["trans"]).joints
    )
    truth = np.asarray(scene.body(scene.betas, scene.pose, scene.trans).joints)
    assert np.linalg.norm(joints - truth, axis=-1)[:, :22].mean() < 0.03
    assert found.costs["keypoints"] < 0.3 * _term(reach=30.0)(**start).cost


def test_a_person_who_is_not_there_is_refused():
    scene = _scene()
    with pytest.raises(HabitusError, match="person is 1"):
        hb.terms.Keypoints.of(scene.body, scene.detections, scene.rig, person=1)
