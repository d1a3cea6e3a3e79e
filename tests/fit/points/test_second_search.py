"""A limb that was lost is sought where a piece of the scan lies off the surface, and nothing is
spent elsewhere.
"""

from dataclasses import replace

import numpy as np
import pytest

from habitus import load_body
from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.fit.points.limbs import limbs_near, limbs_searched_again
from habitus.fit.points.scan import Cloud, Scan
from habitus.fit.points.scan_evidence import lost_share
from habitus.fit.points.scan_start import Candidate, _about_face
from habitus.fit.points.scans import Registered, Registrar, Start
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.coarse_bodies import coarse_body


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    body = load_body("default")
    return Registrar.of(coarse_body(body, 1200), prior_of(body))


def a_pose(registrar: Registrar, **turns: tuple[float, float, float]) -> BodyState:
    """Arms down a little, and these joints."""
    body = registrar.body
    pose = np.zeros((1, body.num_joints, 3))
    for name, turn in (
        {"left_shoulder": (0, 0, -0.8), "right_shoulder": (0, 0, 0.8)} | turns
    ).items():
        pose[0, body.joint_names.index(name)] = turn
    return BodyState(np.zeros(body.num_betas), pose, np.zeros((1, 3)))


def seen(registrar: Registrar, state: BodyState, count: int = 8000) -> Cloud:
    faces = registrar.body.faces
    surface = registrar.fitter.vertices(state)
    rng = np.random.default_rng(0)
    corners = surface[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    face = rng.choice(len(faces), count, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), count)
    normals = np.einsum("pk,pkc->pc", share, vertex_normals(surface, faces)[faces[face]])
    points = np.einsum("pk,pkc->pc", share, corners[face])
    return Cloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def error(registrar: Registrar, one: BodyState, other: BodyState) -> float:
    places = [registrar.fitter.vertices(state) for state in (one, other)]
    return float(np.linalg.norm(places[0] - places[1], axis=1).max())


@pytest.mark.parametrize(
    "lost", [{"left_shoulder": (0, 0, 1.0)}, {"neck": (0.0, 2.0, 0.0), "head": (-0.8, 0.5, 0.0)}]
)
def test_a_lost_limb_or_head_is_found(registrar, lost):
    truth = a_pose(registrar)
    begin = a_pose(registrar, **lost)
    cloud = seen(registrar, truth)
    found = limbs_searched_again(
        registrar.guesser(), begin, cloud, registrar.fitter.vertices(begin)
    )
    assert found is not None and error(registrar, found, truth) < 0.2 * error(
        registrar, begin, truth
    )


def test_the_limbs_beside_the_lost_piece_are_tried(registrar):
    state = a_pose(registrar)
    body = registrar.body
    joints = body(state.betas, state.pose[0]).joints
    surface = registrar.fitter.vertices(state)
    for name in ("left_wrist", "right_ankle", "head"):
        joint = body.joint_names.index(name)
        near = limbs_near(registrar.guesser(), surface, np.asarray(joints[joint]))
        assert any(joint in limb.joints for limb in near) and len(near) <= 2


def test_a_piece_that_no_limb_explains_changes_nothing(registrar):
    state = a_pose(registrar)
    cloud = seen(registrar, state)
    hand = np.asarray(
        registrar.body(state.betas, state.pose[0]).joints[
            registrar.body.joint_names.index("left_wrist")
        ]
    )
    ball = np.random.default_rng(1).normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    parts = [(cloud.points, hand + 0.04 * ball + (0.12, 0.0, 0.0)), (cloud.normals, ball)]
    held = Cloud(*(np.concatenate(each) for each in parts))
    assert (
        limbs_searched_again(registrar.guesser(), state, held, registrar.fitter.vertices(state))
        is None
    )


def registered(registrar: Registrar, state: BodyState, cloud: Cloud) -> Registered:
    start = Start(Candidate(state, np.eye(3), 0.0), "+y", None)
    surface = registrar.fitter.vertices(state)
    return Registered(Scan("anna", cloud.points), cloud, start, state, surface, True)


def test_the_search_is_begun_where_a_piece_is_off_and_only_there(registrar, monkeypatch):
    truth = a_pose(registrar)
    begun = []
    cloud = seen(registrar, truth)
    monkeypatch.setattr(
        "habitus.fit.points.scans.limbs_searched_again", lambda *given: begun.append(given)
    )
    registrar._limbs_searched([registered(registrar, truth, cloud)])
    assert not begun
    wrong = a_pose(registrar, left_shoulder=(0, 0, 1.0))
    registrar._limbs_searched([registered(registrar, wrong, cloud)])
    assert len(begun) == 1
    mouth = with_mouth(registrar, truth, cloud)
    distances = registrar.fitter.distances(registrar.fitter.vertices(truth), mouth)
    assert lost_share(mouth.points, distances) > 0.005
    registrar._limbs_searched([registered(registrar, truth, mouth)])
    assert len(begun) == 1


def with_mouth(registrar: Registrar, state: BodyState, cloud: Cloud) -> Cloud:
    """A scan with 2 % more points on the inside of a mouth."""
    own = registrar.body.strongest_joint == registrar.body.joint_names.index("head")
    head = registrar.fitter.vertices(state)[own]
    ball = np.random.default_rng(1).normal(size=(len(cloud.points) // 50, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    inside = head.mean(0) + 0.035 * ball
    return Cloud(np.concatenate([cloud.points, inside]), np.concatenate([cloud.normals, -ball]))


def chair() -> Scan:
    rng = np.random.default_rng(0)
    parts = []
    boxes = [((0, 0.45, 0), (0.5, 0.05, 0.5)), ((0, 0.8, -0.22), (0.5, 0.6, 0.04))]
    boxes += [((x, 0.22, z), (0.05, 0.45, 0.05)) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]
    for middle, size in boxes:
        count = int(20_000 * np.prod(size) ** (2 / 3) / 0.3)
        points = rng.uniform(-0.5, 0.5, (count, 3))
        axis = rng.integers(0, 3, count)
        points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
        parts.append(np.array(middle) + points * size)
    return Scan("chair", np.concatenate(parts))


def test_a_chair_fails_without_a_whole_fit_and_a_person_beside_it_does_not_mind(
    registrar, monkeypatch
):
    truth = a_pose(registrar)
    begin = [Candidate(truth, np.eye(3), 0.0)]
    monkeypatch.setattr("habitus.fit.points.scans.find_start", lambda *given: begin)
    monkeypatch.setattr(
        "habitus.fit.points.scans.with_extremities", lambda fitter, state, cloud: state
    )
    person = Scan("anna", seen(registrar, truth).points)
    fit, anna = registrar.register([chair(), person], up="+y")
    assert fit.verdict.level == "failed" and len(fit.verdict.reasons) == 1
    assert fit.verdict.keys == ("person",) and fit.status == "no person"
    np.testing.assert_array_equal(fit.vertices, fit.model_vertices)
    assert anna.person and anna.status in ("converged", "iterations")
    assert set(anna.costs) == {"offset", "shape", "pose"}
    assert np.percentile(anna.to_surface, 95) < 0.01


def test_a_scan_follows_the_one_before_and_is_sought_where_that_is_too_far_off(
    registrar, monkeypatch
):
    def searched(*given: object) -> None:
        raise AssertionError

    truth = a_pose(registrar)
    scan = Scan("anna", seen(registrar, truth).points)
    before = a_pose(registrar, left_elbow=(0.0, -0.2, 0.0), right_knee=(0.2, 0.0, 0.0))
    monkeypatch.setattr("habitus.fit.points.scans.find_start", searched)
    monkeypatch.setattr(
        "habitus.fit.points.scans.with_extremities", lambda fitter, state, cloud: state
    )
    (fit,) = registrar.register([scan], up="+y", previous=before)
    assert np.percentile(fit.to_surface, 50) < 0.002
    with pytest.raises(AssertionError):
        far = replace(before, pose=before.pose + np.eye(len(before.pose[0]), 3) * (0.0, 2.0, 0.0))
        registrar.register([scan], up="+y", previous=replace(far, trans=far.trans + 0.5))


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_somebody_found_facing_away_is_turned_about(registrar, yaw):
    """With level arms front and back look alike, and a fit from there ends in a body bent out of
    all proportion.
    """
    level = {"left_shoulder": (0, 0, 0), "right_shoulder": (0, 0, 0), "pelvis": (0.0, yaw, 0.0)}
    truth = a_pose(registrar, **level)
    away = a_pose(registrar, **level | {"pelvis": (0.0, yaw + np.pi - 0.3, 0.0)})
    found = _about_face(
        registrar.guesser(), seen(registrar, truth), Candidate(away, np.eye(3), np.inf)
    )
    assert error(registrar, found.state, truth) < 0.15 < error(registrar, away, truth)
