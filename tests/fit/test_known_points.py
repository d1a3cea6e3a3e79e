"""A person from points at known places: planted people, motions, and the person's own surface."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from habitus.body.prior import shipped_prior
from habitus.errors import HabitusError
from habitus.fit.known_points import fit_known_points, own_surface
from habitus.io.models.bodies import load_body
from habitus.io.topologies import load_topology
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix


@pytest.fixture(scope="module")
def body():
    full = load_body("female").full
    assert full is not None
    return full


@pytest.fixture(scope="module")
def places(body):
    return load_topology("smpl", body)


@pytest.fixture(scope="module")
def planted(body, places):
    rng = np.random.default_rng(5)
    prior = shipped_prior().for_joints(body.joint_names)
    spread = np.sqrt(np.diag(prior.covariance))
    pose = 0.5 * rng.normal(size=(2, body.num_joints, 3))
    pose[:, 1:] = (prior.mean + spread * rng.normal(size=(2, len(spread)))).reshape(2, -1, 3)
    trans = rng.normal(size=(2, 3))
    betas = np.clip(rng.normal(size=body.num_betas), -2, 2)
    surface = np.asarray(body(np.tile(betas, (2, 1)), pose, trans).vertices)
    return betas, pose, trans, places.vertices(surface)


@pytest.fixture(scope="module")
def fit(body, places, planted):
    return fit_known_points(body, places.face, places.barycentric, planted[3])


def degrees(pose, other):
    between = np.swapaxes(matrix_from_rotvec(other), -1, -2) @ matrix_from_rotvec(pose)
    return np.degrees(np.linalg.norm(rotvec_from_matrix(between), axis=-1))


def test_a_planted_person_is_found(fit, planted, body):
    betas, pose, trans, _ = planted
    assert fit.verdict.level == "good" and fit.error_mm["mean"] < 0.3
    # the prior keeps hands, which few of the points tell of, a little nearer to rest
    arms = [k for k, name in enumerate(body.joint_names) if "hand" not in name]
    assert degrees(fit.pose, pose)[:, arms].max() < 0.3
    assert np.abs(fit.betas - betas).max() < 0.05
    assert np.abs(fit.trans - trans).max() < 1e-3


def test_a_motion_of_the_points_is_one_of_the_root(fit, planted, body, places):
    turn, shift = Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix(), np.array([3.0, -1.0, 0.5])
    again = fit_known_points(
        body, places.face, places.barycentric, planted[3] @ turn.T + shift, betas=fit.betas
    )
    first = fit_known_points(body, places.face, places.barycentric, planted[3], betas=fit.betas)
    assert degrees(again.pose[:, 1:], first.pose[:, 1:]).max() < 0.05
    root = turn @ matrix_from_rotvec(first.pose[:, 0])
    assert degrees(again.pose[:, 0], rotvec_from_matrix(root)).max() < 0.05
    np.testing.assert_allclose(again.distances.mean(), first.distances.mean(), rtol=0.05)


def test_the_own_surface_holds_what_the_shapes_lack(fit, planted, body, places):
    betas, pose, trans, _ = planted
    upright = np.zeros_like(pose)
    upright[:, 0] = pose[:, 0]
    turn = matrix_from_rotvec(pose[:, 0])
    rest, root = body.rest_vertices(betas), body.rest_joints(betas)[0]
    bump = 0.01 * np.exp(-((rest - rest[4000]) ** 2).sum(1) / 0.1**2)[:, None] * [0.0, 0.0, 1.0]
    posed = (rest + bump - root) @ np.swapaxes(turn, 1, 2) + root + trans[:, None]
    known = replace(fit, betas=betas, pose=upright, trans=trans)
    surface = own_surface(body, places, known, places.vertices(posed))
    off = places.vertices(surface) - places.vertices(rest + bump)
    assert np.linalg.norm(bump, axis=1).max() > 0.009
    assert np.linalg.norm(off, axis=1).max() < 0.001
    assert np.linalg.norm(surface - rest - bump, axis=1).mean() < 0.0001


def test_vertices_in_another_order_fail(body, places, planted):
    order = np.random.default_rng(0).permutation(places.num_vertices)
    wrong = fit_known_points(
        body, places.face, places.barycentric, planted[3][:1, order], betas=planted[0]
    )
    assert wrong.verdict.level == "failed"
    assert "another order of vertices" in wrong.verdict.reasons[0]


def test_too_few_points_are_refused(body, places, planted):
    with pytest.raises(HabitusError, match="expected one frame at least, and 30 points or more"):
        fit_known_points(body, places.face[:9], places.barycentric[:9], planted[3][:, :9])
