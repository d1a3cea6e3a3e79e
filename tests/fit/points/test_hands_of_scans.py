"""Hands of scans: each of the named poses is found from another one, palm or back up."""

from functools import cache

import numpy as np
import pytest

from habitus.body.hand_space import has_hands
from habitus.body.hands import hand_pose
from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.fit.points.limbs import with_hands
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_states import SEARCH_BETAS, extended
from habitus.fit.points.scans import Registrar
from habitus.io.models.bodies import SHIPPED_BETAS, load_body
from habitus.jobs.register import made_ready
from habitus.mesh.normals import vertex_normals


@cache
def _registrar(joints: str) -> Registrar:
    body = load_body("neutral", joints=joints)
    return Registrar.of(body, prior_of(body))


def _state(grip: str) -> BodyState:
    body = _registrar("smplh").body
    pose = np.zeros((1, body.num_joints, 3))
    for joint, rotation in hand_pose(body, grip).items():
        pose[0, body.joint_names.index(joint)] = rotation
    return BodyState(np.zeros(body.num_betas), pose, np.zeros((1, 3)))


def _scan(state: BodyState) -> Cloud:
    """Points of a surface in random order: hands are looked at closely in it."""
    fitter = _registrar("smplh").fitter
    surface = fitter.vertices(state)
    normals = vertex_normals(surface, fitter.body.faces)
    rows = np.random.default_rng(0).permutation(fitter.topology.whole)
    return Cloud(surface[rows], normals[rows])


def _off(state: BodyState, true: BodyState) -> float:
    """Mean distance (mm) of the skin of fingers."""
    fitter = _registrar("smplh").fitter
    fingers = [k for k, name in enumerate(fitter.body.joint_names) if name[-1] in "123"]
    rows = np.isin(fitter.body.strongest_joint, fingers[3:])
    apart = fitter.vertices(state) - fitter.vertices(true)
    return 1e3 * float(np.linalg.norm(apart, axis=1)[rows].mean())


@pytest.mark.parametrize(("true", "begin"), [("fist", "relaxed"), ("flat", "fist")])
def test_a_planted_hand_is_found(true, begin):
    planted, start = _state(true), _state(begin)
    found = with_hands(_registrar("smplh").fitter, start, _scan(planted))
    assert _off(start, planted) > 20.0 and _off(found, planted) < 6.0


def test_a_hand_with_its_back_down_is_turned_over():
    fitter = _registrar("smplh").fitter
    planted = _state("fist")
    start = _state("relaxed")
    start.pose[0, fitter.body.joint_names.index("left_wrist")] = 2.8, 0.0, 0.0
    found = with_hands(fitter, start, _scan(planted))
    assert _off(found, planted) < 6.0


def test_a_scan_without_hands_leaves_them_as_they_are():
    fitter = _registrar("smplh").fitter
    start = _state("relaxed")
    cloud = _scan(_state("fist"))
    body = np.abs(cloud.points[:, 0]) < 0.4
    found = with_hands(fitter, start, Cloud(cloud.points[body], cloud.normals[body]))
    np.testing.assert_array_equal(found.pose, start.pose)


def test_a_body_without_fingers_is_left_alone():
    fitter = _registrar("smpl").fitter
    state = BodyState(np.zeros(fitter.body.num_betas), np.zeros((1, 24, 3)), np.zeros((1, 3)))
    assert with_hands(fitter, state, _scan(_state("fist"))) is state


def test_more_joints_begin_at_the_prior_and_further_betas_at_zero():
    small, large = _registrar("smpl"), _registrar("smplh")
    few = small.body.with_betas(20)
    pose = np.random.default_rng(1).normal(size=(2, 24, 3))
    state = BodyState(np.ones(20), pose, np.zeros((2, 3)))
    found = extended(few, large.body, large.fitter.prior, state)
    assert found.betas.tolist() == [1.0] * 20 + [0.0] * (large.body.num_betas - 20)
    names = large.body.joint_names
    for k, name in enumerate(small.body.joint_names):
        if name in names:
            np.testing.assert_array_equal(found.pose[:, names.index(name)], pose[:, k])
    thumb = names.index("left_thumb2")
    mean = large.fitter.prior.mean.reshape(-1, 3)[thumb - 1]
    np.testing.assert_array_equal(found.pose[:, thumb], [mean, mean])


def test_bodies_by_name_end_with_fingers_and_all_betas_and_are_found_again():
    registrar = made_ready("female")
    assert not has_hands(registrar.body) and has_hands(registrar.detailed().body)
    assert registrar.detailed().body.num_betas == SHIPPED_BETAS > registrar.body.num_betas
    assert registrar.detailed() is registrar.detailed()
    assert made_ready(load_body("female")).detailed is None
    assert made_ready("female", staged=False).detailed is None


def test_a_given_body_in_all_detail_is_sought_without_it_and_found_again():
    given = load_body("female", joints="smplh", num_betas=SHIPPED_BETAS)
    registrar = made_ready(given)
    assert registrar.detailed().body is given
    searched = registrar.body
    assert searched.num_betas == SEARCH_BETAS and not has_hands(searched)
    betas = np.random.default_rng(0).normal(size=SEARCH_BETAS)
    np.testing.assert_allclose(searched.rest_vertices(betas), given.rest_vertices(betas), atol=1e-9)
    assert made_ready(given, staged=False).body is given
