"""The ends of head, hands and feet are found on a surface, and poses that no bank has by them."""

from dataclasses import replace

import numpy as np
import pytest

from habitus import load_body
from habitus.body.prior import prior_of
from habitus.body.state import BodyState
from habitus.fit.points.limb_ends import END_JOINTS, EndSearch, aligned, find_ends
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_start import Candidate, _is_found, find_start
from habitus.fit.points.scans import Registrar
from habitus.fit.points.settings import SCANS
from habitus.mesh.normals import vertex_normals
from habitus.rotations import matrix_from_rotvec
from habitus_lab.population.coarse_bodies import coarse_body

KICK = {
    "pelvis": (0.2, 0.5, 1.0),
    "spine1": (0.0, 0.0, -0.3),
    "left_hip": (0.2, 0.0, 1.3),
    "right_hip": (0.0, 0.0, 0.9),
    "left_shoulder": (0.0, -0.6, -0.6),
    "left_elbow": (0.0, -1.6, 0.0),
    "right_shoulder": (0.0, 0.9, 0.2),
    "right_elbow": (0.0, 1.9, 0.0),
}
"""A kick to the side, the trunk leant over; without the ends the search is 1.3 m off."""


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    body = load_body("default")
    return Registrar.of(coarse_body(body, 1800), prior_of(body))


def _state(registrar: Registrar, turns: dict) -> BodyState:
    body = registrar.body
    pose = np.zeros((1, body.num_joints, 3))
    for name, turn in turns.items():
        pose[0, body.joint_names.index(name)] = turn
    return BodyState(np.zeros(body.num_betas), pose, np.zeros((1, 3)))


def _cloud(registrar: Registrar, state: BodyState, count: int = 6000) -> Cloud:
    faces, surface = registrar.body.faces, registrar.fitter.vertices(state)
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


def _joints(registrar: Registrar, state: BodyState) -> np.ndarray:
    return np.asarray(registrar.body(state.betas, state.pose[0], state.trans[0]).joints)


def _error(registrar: Registrar, one: BodyState, other: BodyState) -> float:
    names = registrar.body.joint_names
    rows = [k for k, name in enumerate(names) if not name.endswith(("_hand", "_foot"))]
    off = _joints(registrar, one)[rows] - _joints(registrar, other)[rows]
    return float(np.linalg.norm(off, axis=1).max())


def test_the_first_ends_lie_at_head_hands_and_feet_in_any_pose_and_place(registrar):
    names = registrar.body.joint_names
    turn = matrix_from_rotvec(np.array([0.4, -1.1, 0.7]))
    for turns in ({}, KICK):
        state = _state(registrar, turns)
        cloud = _cloud(registrar, state, SCANS.ends.points)
        ends = find_ends(cloud.points, cloud.normals, SCANS.ends)
        joints = _joints(registrar, state)[[names.index(name) for name in END_JOINTS]]
        gaps = np.linalg.norm(cloud.points[ends.points][:, None] - joints, axis=2)
        assert sorted(gaps.argmin(1)[:5]) == [0, 1, 2, 3, 4] and gaps.min(1)[:5].max() < 0.25
        moved = find_ends(cloud.points @ turn.T + 1.0, cloud.normals @ turn.T, SCANS.ends)
        np.testing.assert_array_equal(moved.points, ends.points)


def test_distances_over_the_surface_are_a_metric_longer_than_the_straight_way(registrar):
    cloud = _cloud(registrar, _state(registrar, KICK), SCANS.ends.points)
    ends = find_ends(cloud.points, cloud.normals, SCANS.ends)
    places = cloud.points[ends.points]
    straight = np.linalg.norm(places[:, None] - places, axis=2)
    np.testing.assert_allclose(ends.distances, ends.distances.T, atol=1e-9)
    assert (ends.distances >= straight - 1e-9).all()
    over = (ends.distances[:, :, None] + ends.distances[None]).min(1)
    assert (ends.distances <= over + 1e-9).all()


def test_pieces_of_a_scan_are_joined(registrar):
    state = _state(registrar, {})
    cloud = _cloud(registrar, state, SCANS.ends.points)
    wrist = _joints(registrar, state)[registrar.body.joint_names.index("left_wrist"), 0]
    kept = np.abs(cloud.points[:, 0] - wrist) > 0.06
    ends = find_ends(cloud.points[kept], cloud.normals[kept], SCANS.ends)
    assert len(ends.points) >= len(END_JOINTS) and np.isfinite(ends.distances).all()


def test_a_motion_and_a_scale_are_found_again():
    rng = np.random.default_rng(0)
    places = rng.normal(size=(4, 6, 3))
    turn = matrix_from_rotvec(rng.normal(size=3))
    target = 0.9 * places[2] @ turn.T + (1.0, 2.0, 3.0)
    distance, turns, shift = aligned(places, target)
    assert distance.argmin() == 2 and distance[2] < 1e-9
    np.testing.assert_allclose(turns[2], turn, atol=1e-9)
    np.testing.assert_allclose(
        (places[2] @ turns[2].T + shift[2]).mean(0), target.mean(0), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)


def test_a_kick_that_no_pose_of_the_bank_resembles_is_found_by_its_ends(registrar):
    planted = _state(registrar, KICK)
    cloud = _cloud(registrar, planted)
    guesser = registrar.guesser()
    starts = guesser.ends.starts(cloud)
    assert min(_error(registrar, start, planted) for start in starts) < 0.25
    assert _error(registrar, find_start(guesser, cloud, np.eye(3)[None])[0].state, planted) < 0.06


def test_a_limb_elsewhere_calls_for_more_candidates(registrar):
    guesser = registrar.guesser()
    planted = _state(registrar, {"left_elbow": (0.0, -1.0, 0.0)})
    cloud = _cloud(registrar, planted)

    def candidate(state: BodyState) -> Candidate:
        return Candidate(state, np.eye(3), guesser.scene(cloud).misfit(state))

    elsewhere = candidate(_state(registrar, {"left_elbow": (0.0, 1.0, 0.0)}))
    assert _is_found(guesser, cloud, candidate(planted))
    assert elsewhere.misfit < SCANS.search.max_misfit and not _is_found(guesser, cloud, elsewhere)


def test_a_body_without_such_ends_has_no_search(registrar):
    fitter = registrar.fitter
    reach = replace(SCANS, ends=replace(SCANS.ends, reach=5.0))
    assert EndSearch.of(replace(fitter, settings=reach), registrar.guesser().bank) is None
