"""The parts of registering a scan, each by a law of its own."""

from types import SimpleNamespace

import igl
import numpy as np
import pytest
import trimesh
from synthetic import synthetic_body

from habitus.body.state import BodyState
from habitus.errors import HabitusError
from habitus.fit.points.correspondences import Topology, find_correspondences, vertex_weights
from habitus.fit.points.free_surface import free_surface, new_cuts, stretched_surface
from habitus.fit.points.scan import (
    Cloud,
    Scan,
    agreed,
    cleaned,
    neighbours_of,
    outward,
    plane_normals,
    turned,
)
from habitus.fit.points.scan_evidence import lost_share
from habitus.fit.points.scan_result import judge_scan
from habitus.fit.points.scan_states import at_rest
from habitus.fit.points.settings import SCANS, SurfaceStage
from habitus.fit.verdict import PARTS
from habitus.mesh.normals import vertex_normals
from habitus.mesh.proximity import closest_points

BALL = trimesh.creation.icosphere(3, 0.4)


def on_ball(count: int, radius: float = 0.4, seed: int = 0) -> Cloud:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return Cloud(radius * points, points)


@pytest.mark.parametrize("whole", [True, False])
def test_normals_of_a_cloud_point_outward_also_of_its_front_alone(whole):
    cloud = on_ball(3000)
    points = cloud.points if whole else cloud.points[cloud.points[:, 2] > 0.1]
    normals, near = plane_normals(points)
    found = outward(points, normals, near)
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert ((found * unit).sum(1) > 0.9).mean() > 0.99


@pytest.mark.parametrize("neighbours", [None, 16])
def test_a_patch_that_looks_the_wrong_way_is_turned_over(neighbours):
    cloud = on_ball(3000)
    near = None if neighbours is None else neighbours_of(cloud.points, neighbours)
    wrong = cloud.points[:, 0] > 0.3
    normals = np.where(wrong[:, None], -1.0, 1.0) * cloud.normals
    found = agreed(normals, cloud.normals, near)
    assert ((found * cloud.normals).sum(1) > 0.0).mean() > 0.97


def test_signs_that_come_with_a_scan_are_reversed_in_patches_estimated_ones_singly():
    cloud = on_ball(3000)
    model = cloud.normals.copy()
    model[::50] *= -1.0  # single points whose closest point of a model is on the wrong side
    near = neighbours_of(cloud.points, 16)
    np.testing.assert_array_equal(agreed(cloud.normals, model, near), cloud.normals)
    np.testing.assert_array_equal(agreed(cloud.normals, model), model)


def test_normals_are_certain_on_a_ball_and_hardly_on_a_thin_rod():
    rng = np.random.default_rng(0)
    angle = rng.uniform(0.0, 2.0 * np.pi, 60)
    rod = np.column_stack(
        [0.006 * np.cos(angle), rng.uniform(-0.6, 0.6, 60), 0.006 * np.sin(angle)]
    )
    normals, _ = plane_normals(np.concatenate([on_ball(3000).points, rod]))
    length = np.linalg.norm(normals, axis=1)
    assert (length <= 1.0).all()
    assert np.median(length[:3000]) > 0.95
    assert np.median(length[3000:]) < 0.6


def test_an_uncertain_normal_counts_for_as_much_as_it_is_certain():
    topology = Topology.of(np.asarray(BALL.faces), len(BALL.vertices))
    points = on_ball(200, 0.41).points
    none, half = (
        find_correspondences(topology, np.asarray(BALL.vertices), points, -share * points / 0.41)
        for share in (1e-6, 0.5)
    )
    _, place = closest_points(points, np.asarray(BALL.vertices), np.asarray(BALL.faces))
    np.testing.assert_allclose(none.closest, place, atol=1e-9)
    np.testing.assert_allclose(none.cosine, 1.0, atol=1e-5)
    np.testing.assert_allclose(half.cosine, 0.0, atol=0.02)  # -1 for half, 1 for the other


def test_the_closest_point_is_on_the_nearest_face_that_looks_the_same_way():
    topology = Topology.of(np.asarray(BALL.faces), len(BALL.vertices))
    cloud = on_ball(200, 0.41)
    found = find_correspondences(topology, np.asarray(BALL.vertices), cloud.points, cloud.normals)
    _, place = closest_points(cloud.points, np.asarray(BALL.vertices), np.asarray(BALL.faces))
    np.testing.assert_allclose(found.closest, place, atol=1e-9)
    assert (found.cosine > 0.97).all()
    corners = BALL.vertices[BALL.faces[found.face]]
    np.testing.assert_allclose(
        np.einsum("pk,pkc->pc", found.barycentric, corners), found.closest, atol=1e-9
    )


def test_the_robust_scale_follows_points_that_are_noisy():
    ball = trimesh.creation.icosphere(4, 0.4)
    topology = Topology.of(np.asarray(ball.faces), len(ball.vertices))
    rng = np.random.default_rng(2)
    out = np.asarray(ball.vertices) / 0.4
    off = rng.normal(size=len(out))
    weights = []
    for noise in (0.0005, 0.004, 0.008):
        points = out * (0.4 + noise * off)[:, None]
        found = find_correspondences(topology, np.asarray(ball.vertices), points, out)
        weights.append(found.weights(points, 0.003, 0.5, 3.0))
        assert (found.weights(points, 0.003, 0.5) <= weights[-1]).all()
    np.testing.assert_allclose(weights[1], weights[2], atol=0.01)
    assert weights[0].mean() > 0.9 and weights[2].mean() > 0.6
    np.testing.assert_array_equal(
        found.weights(points, 0.1, 0.5, 3.0), found.weights(points, 0.1, 0.5)
    )


def test_a_free_surface_reaches_the_scan_and_goes_on_over_a_hole():
    topology = Topology.of(np.asarray(BALL.faces), len(BALL.vertices))
    cloud = on_ball(6000, 0.42)
    seen = cloud.points[:, 1] < 0.33
    cloud = Cloud(cloud.points[seen], cloud.normals[seen])
    stages = (SurfaceStage(0.1, 0.05), SurfaceStage(0.01, 0.02))
    surface = free_surface(topology, np.asarray(BALL.vertices), cloud, stages=stages)
    radius = np.linalg.norm(surface, axis=1)
    weights = vertex_weights(topology, surface, cloud)
    assert np.abs(radius[weights > 0.9] - 0.421).max() < 0.0015  # faces lie below their corners
    assert radius[weights == 0.0].min() > 0.41 and radius[weights == 0.0].max() < 0.43
    assert weights[surface[:, 1] > 0.39].max() == 0.0 and weights[surface[:, 1] < 0.2].min() == 1.0


def test_a_free_surface_goes_along_the_normals_and_nowhere_else():
    vertices = np.asarray(BALL.vertices) * (1.0, 2.0, 1.0)
    topology = Topology.of(np.asarray(BALL.faces), len(vertices))
    normal = vertex_normals(vertices, topology.faces)
    swollen = vertices + (0.01 + 0.01 * np.sin(5.0 * vertices[:, :1])) * normal
    face = np.random.default_rng(0).integers(0, len(BALL.faces), 6000)
    share = (1 / 3, 1 / 3, 1 / 3)
    cloud = Cloud(
        share @ swollen[BALL.faces[face]],
        vertex_normals(swollen, topology.faces)[BALL.faces[face][:, 0]],
    )
    found = free_surface(topology, vertices, cloud) - vertices
    assert np.linalg.norm(np.cross(found, normal), axis=1).max() < 1e-9
    assert np.linalg.norm(vertices + found - swollen, axis=1).mean() < 0.001


def test_a_stretched_surface_moves_where_the_scan_is_off_it_alone():
    topology = Topology.of(np.asarray(BALL.faces), len(BALL.vertices))
    ball = np.asarray(BALL.vertices)
    cloud = on_ball(6000)
    cap = np.clip((cloud.points[:, 0] - 0.1) / 0.1, 0.0, 1.0)
    cloud = Cloud(cloud.points + cap[:, None] * (0.02, 0.0, 0.0), cloud.normals)
    moved = stretched_surface(topology, ball, cloud)
    before, after = (
        find_correspondences(topology, surface, cloud.points, cloud.normals).distances(cloud.points)
        for surface in (ball, moved)
    )
    assert np.percentile(before, 90) > 0.015 and np.percentile(after, 90) < 0.003
    across = np.cross(moved - ball, ball / 0.4)[ball[:, 0] > 0.25]
    assert np.linalg.norm(across, axis=1).mean() > 0.004
    assert np.linalg.norm(moved - ball, axis=1)[ball[:, 0] < -0.05].max() < 0.002


def test_units_floor_and_dust_are_found():
    rng = np.random.default_rng(1)
    points = on_ball(5000).points * (0.5, 2.2, 0.5)
    floor = np.column_stack(
        [rng.uniform(-1, 1, 3000), np.full(3000, -0.9), rng.uniform(-1, 1, 3000)]
    )
    dust = np.array([0.8, 0.5, 0.8]) + 0.01 * rng.normal(size=(30, 3))
    one = cleaned(Scan("a", 1000.0 * np.concatenate([points, floor, dust])))
    assert one.scale == 1e-3 and one.kept[:5000].mean() > 0.99 and not one.kept[5000:].any()
    np.testing.assert_allclose(one.floor_up, (0, 1, 0), atol=1e-3)
    whole, cloud = turned(one, np.eye(3))
    assert np.ptp(cloud.points[:, 1]) == pytest.approx(1.76, abs=0.02)
    np.testing.assert_allclose(whole.to_body, np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    assert len(one.notes) == 3


@pytest.mark.parametrize(
    ("scan", "unit", "said"),
    [
        (Scan("a", np.zeros((10, 3))), "auto", "10 points"),
        (Scan("a", 5.0 * on_ball(2000).points), "auto", "expected a person of 0.5 to 2.7 m"),
        (Scan("a", 2.0 * on_ball(2000).points), "mm", "0.00159 m large in mm"),
        (Scan("a", on_ball(2000).points), "furlong", "expected auto, m"),
    ],
)
def test_what_is_no_person_is_said_before_a_fit(scan, unit, said):
    with pytest.raises(HabitusError, match=said):
        cleaned(scan, unit)


def test_an_offset_carried_back_to_rest_is_the_one_that_was_posed():
    body = synthetic_body("smpl", 120)
    rng = np.random.default_rng(2)
    state = BodyState(
        rng.normal(size=body.num_betas),
        0.4 * rng.normal(size=(1, body.num_joints, 3)),
        np.zeros((1, 3)),
    )
    rest = body.rest_vertices(state.betas)
    np.testing.assert_allclose(at_rest(body, state, np.zeros_like(rest)), rest, atol=1e-12)
    offset = 0.01 * rng.normal(size=rest.shape)
    still = BodyState(state.betas, 0 * state.pose, state.trans)
    np.testing.assert_allclose(at_rest(body, still, offset), rest + offset, atol=1e-12)


def test_what_is_off_the_surface_counts_where_it_is_together():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (10_000, 3))
    away = np.where(rng.random(10_000) < 0.01, 0.02, 0.001)
    assert lost_share(points, away) < 0.001  # a hundred points, all over
    away[np.linalg.norm(points - 0.5, axis=1) < 0.1] = 0.02
    inside = (np.linalg.norm(points - 0.5, axis=1) < 0.05).mean()
    assert lost_share(points, away) > 0.8 * inside > 0.0
    assert lost_share(points, np.zeros(10_000)) == 0.0


def test_a_lost_piece_counts_by_its_area_however_dense_the_points_are():
    """A plate of 1 m^2 whose corner of 0.01 m^2 has as many points as the rest, as hands of meshes."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(0, 1, (4000, 2)), rng.uniform(0, 0.1, (4000, 2))])
    points = np.column_stack([flat, np.zeros(8000)])
    away = np.where(np.linalg.norm(points - [0.05, 0.05, 0.0], axis=1) < 0.03, 0.02, 0.0)
    assert lost_share(points, away) == pytest.approx(np.pi * 0.03**2, rel=0.25)


def test_the_verdict_follows_the_numbers():
    good = {
        "betas": np.ones(4),
        "lost": 0.001,
        "cuts": {"body": 3, "head": 20},
        "crossed_legs": 20,
        "islands": 0.02,
        "head_seen": 0.9,
        "limbs_seen": {"left_elbow": 0.5, "right_knee": 1.0},
        "measurements": {"height_m": 1.75},
    }
    assert judge_scan(scan_evidence(**good)).level == "good"
    for change, level in (
        ({"matched": 0.85}, "doubtful"), ({"lost": 0.01}, "doubtful"), ({"lost": 0.02}, "failed"),
        ({"matched": 0.5}, "failed"), ({"cuts": {"body": 150}}, "doubtful"), ({"cuts": {"body": 2000}}, "failed"),
        ({"rival": 1.01}, "doubtful"), ({"islands": 0.4}, "doubtful"),
        ({"head_seen": 0.1}, "doubtful"), ({"points": 3000.0}, "doubtful"),
        ({"joint_deviation": 7.0}, "doubtful"), ({"unlike": 0.03}, "doubtful"),
        ({"clothed": 0.5}, "doubtful"), ({"crossed_legs": 200}, "doubtful"),
        ({"limbs_seen": {"left_elbow": 0.1}}, "doubtful"),
        ({"twists": {"left_elbow": 1.0, "right_elbow": 5.0}}, "doubtful"),
        ({"measurements": {"height_m": 2.4}}, "doubtful"),
        ({"seen": 0.4}, "doubtful"), ({"betas": np.full(4, 9.0)}, "doubtful"),
        ({"to_surface": np.full(100, np.nan)}, "failed"), ({"person": False}, "failed"),
        ({"status": "not finite"}, "failed"),
    ):  # fmt: skip
        verdict = judge_scan(scan_evidence(**(good | change)))
        assert verdict.level == level and len(verdict.reasons) >= 1


def test_a_mesh_is_sampled_on_its_faces_however_coarse_it_is():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.9)
    keep = ball.triangles_center[:, 1] > 0.3  # dense above, coarse below
    dense = ball.submesh([np.flatnonzero(keep)], append=True)
    coarse = trimesh.creation.icosphere(subdivisions=4, radius=0.9)
    coarse = coarse.submesh([np.flatnonzero(coarse.triangles_center[:, 1] <= 0.3)], append=True)
    mesh = trimesh.util.concatenate([dense, coarse])
    stray = np.zeros((50, 3))  # vertices of no face
    one = cleaned(Scan("a", np.concatenate([mesh.vertices, stray]), faces=np.asarray(mesh.faces)))
    cloud = one.cloud
    assert len(cloud.points) == SCANS.cleaning.max_points > 5 * len(mesh.vertices)
    share = mesh.area_faces[mesh.triangles_center[:, 1] > 0.3].sum() / mesh.area
    assert (cloud.points[:, 1] > 0.3).mean() == pytest.approx(share, abs=0.02)
    square = igl.point_mesh_squared_distance(cloud.points, mesh.vertices, np.asarray(mesh.faces))[0]
    assert square.max() < 1e-20
    out = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    assert ((out * cloud.normals).sum(1) > 0.9).mean() > 0.99


def scan_evidence(**changes):
    """What a verdict on a registered scan is drawn from; all of it good where nothing is changed."""
    good = {"betas": np.zeros(4), "to_surface": np.full(100, 5e-4), "to_model": np.full(100, 3e-3)}
    good |= {"matched": 0.99, "lost": 0.0, "pose_distance": 1.0, "seen": 0.9, "rival": None}
    good |= {"person": True, "lost_part": "body", "cuts": {"body": 0, "head": 0, "hands": 0}}
    good |= {"joint_deviation": 3.0, "unlike": 0.0, "rarest_joint": "neck", "twists": {}}
    good |= {"status": "iterations", "points": 40_000, "clothed": 0.0, "crossed_legs": 0}
    good |= {"limbs": {}, "islands": 0.0, "head_seen": 1.0, "limbs_seen": {}, "measurements": {}}
    good |= {"body": SimpleNamespace(age=None, v_template=np.zeros((2, 3)))}
    return SimpleNamespace(**(good | changes))


def test_one_wrong_hand_fails_the_hands_and_not_the_person():
    verdict = judge_scan(scan_evidence(lost=0.007, lost_part="hands"))
    levels = {name: part.level for name, part in verdict.parts.items()}
    assert levels == {"body": "good", "head": "good", "hands": "failed", "feet": "good"}
    assert verdict.level == "doubtful" and "hands" in verdict.reasons[0]
    assert judge_scan(scan_evidence(lost=0.02)).level == "failed"


@pytest.mark.parametrize(("part", "share"), [("hands", 0.004), ("head", 0.011)])
def test_what_is_a_little_off_at_an_end_is_a_doubt_on_that_end_alone(part, share):
    verdict = judge_scan(scan_evidence(lost=share, lost_part=part))
    assert verdict.level == "good" and verdict.parts[part].level == "doubtful"
    assert part in verdict.reasons[0]
    assert judge_scan(scan_evidence(lost=0.011)).level == "doubtful"


def test_a_rare_shape_is_a_doubt_by_degree_and_no_failure():
    betas = [
        np.array([5.0, -3.0, 3.5, *np.zeros(13)]),
        np.full(4, 3.1),
        np.full(4, 9.0),
        np.array([8.7, *np.zeros(23)]),
    ]
    levels = [judge_scan(scan_evidence(betas=each)).level for each in betas]
    assert levels == ["good", "doubtful", "doubtful", "doubtful"]


def test_hair_is_a_doubt_on_the_head_alone():
    """A head under hair is 76 cm around: no doubt on a body that lies on its scan."""
    hair = {"height_m": 1.75, "head_circumference_m": 0.76}
    verdict = judge_scan(scan_evidence(measurements=hair))
    assert verdict.level == "good" and verdict.parts["head"].level == "doubtful"
    waist = judge_scan(scan_evidence(measurements=hair | {"waist_circumference_m": 0.45}))
    assert waist.level == "doubtful" and waist.parts["body"].level == "doubtful"


def test_self_intersections_are_reported_where_they_are():
    verdict = judge_scan(scan_evidence(cuts={"body": 0, "head": 300, "hands": 10}))
    assert verdict.keys == ("cuts",) and "at the head" in verdict.reasons[0]
    assert verdict.parts["head"].level == "doubtful" and verdict.parts["hands"].level == "good"


@pytest.mark.parametrize("number", range(len(PARTS)))
def test_new_self_intersections_are_counted_by_part(number):
    """Two triangles that cut each other, one of them on the trunk."""
    flat = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0]])
    upright = np.array([[0.002, 0.002, -0.005], [0.003, 0.002, 0.005], [0.002, 0.003, 0.005]])
    surface = np.concatenate([flat, upright])
    model = np.concatenate([flat, upright + 1.0])
    topology = Topology.of(np.arange(6).reshape(2, 3), 6)
    part = np.array([0, 0, 0, number, number, number])
    assert new_cuts(topology, model, surface, part) == dict.fromkeys(PARTS, 0) | {PARTS[number]: 1}
    assert sum(new_cuts(topology, surface, surface, part).values()) == 0
