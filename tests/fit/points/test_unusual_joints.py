"""A joint bent further than people bend it, and the limb that is searched again because of it."""

import numpy as np
import pytest

from habitus.body.prior import PosePrior, prior_of
from habitus.body.state import BodyState
from habitus.fit.points.limbs import forearm_twists, limb_joint_deviations, with_usual_joints
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_start import Candidate
from habitus.fit.points.scan_states import Registered, Start
from habitus.fit.points.scans import Registrar
from habitus.fit.points.settings import SCANS
from habitus.io.models.bodies import load_body
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.coarse_bodies import coarse_body


def test_a_joints_deviation_is_that_of_its_own_gaussian():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(9, 9))
    prior = PosePrior(("a", "b", "c"), rng.normal(size=9), root @ root.T)
    pose = rng.normal(size=(4, 3))
    found = prior.joint_deviations(pose)
    for k in range(3):
        own = slice(3 * k, 3 * k + 3)
        off = pose[k + 1] - prior.mean[own]
        expected = np.sqrt(off @ np.linalg.inv(prior.covariance[own, own]) @ off)
        assert found[k] == pytest.approx(expected, rel=1e-9)


def test_an_arm_held_to_the_scan_by_its_collar_is_found():
    body = coarse_body(load_body("default"), 600)
    registrar = Registrar.of(body, prior_of(load_body("default")))
    prior, names = registrar.fitter.prior, body.joint_names
    pose = np.concatenate([np.zeros((1, 3)), prior.mean.reshape(-1, 3)])
    true = np.asarray(body(np.zeros(body.num_betas), pose).vertices)
    wrong = pose.copy()
    wrong[names.index("left_collar")] = 0.3, 1.1, -0.1
    wrong[names.index("left_shoulder")] = -2.2, -0.5, -1.9
    cloud = Cloud(true, vertex_normals(true, body.faces))
    before = BodyState(np.zeros(body.num_betas), wrong[None], np.zeros((1, 3)))
    after = with_usual_joints(registrar.guesser(), before, cloud, registrar.settings.stages[1:])
    arm = np.isin(body.strongest_joint, [names.index(f"left_{j}") for j in ("shoulder", "elbow")])
    off = [
        np.linalg.norm(registrar.fitter.vertices(each) - true, axis=1)[arm].mean()
        for each in (before, after)
    ]
    assert off[0] > 0.15 and off[1] < 0.02
    usual = limb_joint_deviations(body, prior, after.pose[0])
    assert usual.max() < registrar.settings.limbs.unusual
    same = with_usual_joints(registrar.guesser(), after, cloud, registrar.settings.stages[1:])
    np.testing.assert_array_equal(same.pose, after.pose)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_twisted_forearm_deviates_by_all_of_its_twist(share):
    """However much of it is the wrist's; 110 degrees are more than people have, 40 are not."""
    body = load_body("default")
    prior, names = prior_of(body).for_joints(body.joint_names), body.joint_names
    rest = body.rest_joints(np.zeros(body.num_betas))
    for side in ("left", "right"):
        elbow, wrist = (names.index(f"{side}_{joint}") for joint in ("elbow", "wrist"))
        along = (rest[wrist] - rest[elbow]) / np.linalg.norm(rest[wrist] - rest[elbow])
        found = []
        for twist in np.radians([-110.0, -40.0, 40.0, 110.0]):
            pose = np.zeros((body.num_joints, 3))
            pose[elbow] = (1.0 - share) * twist * along
            pose[wrist] = share * twist * along
            found.append(forearm_twists(body, prior, pose)[f"{side}_elbow"])
        assert max(found[1:3]) < 2.0 and min(found[::3]) > SCANS.limbs.twisted


def outstretched(side: str, twisted: bool) -> tuple[Registrar, np.ndarray, BodyState]:
    """A body, its surface with an arm forward, and that state; with the forearm twisted or not."""
    body = load_body("default")
    names = body.joint_names
    pose = np.zeros((1, body.num_joints, 3))
    sign = 1.0 if side == "left" else -1.0
    pose[0, names.index(f"{side}_shoulder")] = 0.0, -1.2 * sign, -0.2 * sign
    if twisted:
        pose[0, names.index(f"{side}_elbow")] = -1.9, 0.0, 0.0
        pose[0, names.index(f"{side}_wrist")] = -1.0, 0.0, 0.0
    surface = np.asarray(body(np.zeros(body.num_betas), pose[0]).vertices)
    state = BodyState(np.zeros(body.num_betas), pose, np.zeros((1, 3)))
    return Registrar.of(body, prior_of(body)), surface, state


def forearm_error(registrar: Registrar, state: BodyState, true: np.ndarray, side: str) -> float:
    names = registrar.body.joint_names
    own = [names.index(f"{side}_{joint}") for joint in ("elbow", "wrist")]
    rows = np.isin(registrar.body.strongest_joint, own)
    return np.linalg.norm(registrar.fitter.vertices(state) - true, axis=1)[rows].mean()


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_forearm_that_is_half_a_turn_off_is_turned_back(side):
    registrar, true, _ = outstretched(side, False)
    _, _, wrong = outstretched(side, True)
    cloud = Cloud(true[::2], vertex_normals(true, registrar.body.faces)[::2])
    after = with_usual_joints(registrar.guesser(), wrong, cloud, registrar.settings.stages[1:])
    assert forearm_error(registrar, wrong, true, side) > 0.05
    assert forearm_error(registrar, after, true, side) < 0.015


@pytest.mark.parametrize("twisted", [False, True])
def test_a_forearm_that_ends_twisted_is_turned_back_where_that_costs_less(twisted):
    registrar, true, _ = outstretched("left", twisted)
    _, _, state = outstretched("left", True)
    cloud = Cloud(true, vertex_normals(true, registrar.body.faces))
    start = Start(Candidate(state, np.eye(3), 0.0), "+y", None)
    surface = registrar.fitter.vertices(state)
    scan = Registered(Scan("anna", cloud.points), cloud, start, state, surface, True)
    (scan,) = registrar._fitted([scan], registrar.settings.last_stages)
    (ended,) = registrar._forearms_turned_back([scan])
    assert (ended is scan) == twisted
    assert forearm_error(registrar, ended.state, true, "left") < 0.015
    if not twisted:
        assert registrar._forearms_turned_back([ended]) == [ended]
