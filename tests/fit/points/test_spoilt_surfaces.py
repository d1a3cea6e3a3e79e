"""Nothing that is wrong is called good: scans and depth views spoilt as wholes (all kinds, on whole
bodies: benchmarks/surface_faults.py).
"""

import numpy as np
import pytest
from rgbd_scene_small import QUICK_DEPTH, small_scene
from sensor_people import QUICK_SCANS

from habitus import load_body
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.points.depth import fit_views
from habitus.fit.points.scan import Scan, cleaned
from habitus.fit.points.scans import Registrar
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.rgbd_people import planted_rest, rgbd_scene
from habitus_lab.population.scans import stance
from habitus_lab.population.spoilt_surfaces import SCAN_FAULTS, spoilt_capture


@pytest.fixture(scope="module")
def registrar() -> Registrar:
    body = load_body("default")
    return Registrar.of(coarse_body(body, 1200), prior_of(body), settings=QUICK_SCANS)


@pytest.fixture(scope="module")
def person(registrar) -> tuple[Scan, np.ndarray]:
    """A scan, evenly all over, and the true vertices."""
    body = registrar.body
    rng = np.random.default_rng(2)
    pose = stance("A", body.joint_names, rng)
    surface = np.asarray(body(np.clip(rng.normal(size=body.num_betas), -1.5, 1.5), pose).vertices)
    corners = surface[body.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    face = rng.choice(body.num_faces, 12_000, p=area / area.sum())
    points = np.einsum("pk,pkc->pc", rng.dirichlet((1.0, 1.0, 1.0), len(face)), corners[face])
    return Scan("person", points), surface


def spoilt(kind: str, scan: Scan) -> Scan:
    return SCAN_FAULTS[kind](scan, np.random.default_rng(0))


def test_an_upside_down_scan_is_found(registrar, person):
    scan, truth = person
    (fit,) = registrar.register([spoilt("upside down", scan)])
    there = truth * [-1.0, -1.0, 1.0] @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    assert fit.up_axis == "-y"
    assert np.linalg.norm(fit.model_vertices - there, axis=1).mean() < 0.02


def test_who_stands_beside_the_person_is_counted(person):
    assert cleaned(spoilt("two people", person[0])).islands == pytest.approx(0.5, abs=0.05)
    assert cleaned(spoilt("two people who touch", person[0])).islands == 0.0
    assert cleaned(person[0]).islands == 0.0


def test_a_hand_beyond_a_hole_in_the_forearm_is_the_persons(registrar, person):
    """A scanner's hole of 10 cm made an island of a hand."""
    scan, surface = person
    body = registrar.body
    elbow, wrist = (
        surface[body.skinning_weights[:, body.joint_names.index(f"left_{name}")] > 0.5].mean(0)
        for name in ("elbow", "wrist")
    )
    way = wrist - elbow
    way = way / np.linalg.norm(way)
    along = (scan.points - elbow) @ way
    near = np.linalg.norm(scan.points - elbow - along[:, None] * way, axis=1) < 0.15
    hand = near & (along > 0.11)
    for hole, share in ((0.12, 0.0), (0.25, hand.mean())):
        kept = ~near | (along < 0.11 - hole) | hand
        found = cleaned(Scan("hole", scan.points[kept])).islands
        assert found == pytest.approx(share, rel=0.2, abs=1e-9)


def test_the_scan_of_nobody_in_any_unit_is_refused(person):
    with pytest.raises(HabitusError, match="large"):
        cleaned(spoilt("scaled by 0.001", person[0]))


@pytest.fixture(scope="module")
def others():
    """Somebody else in the same views."""
    body, _ = small_scene()
    rng = np.random.default_rng(11)
    return rgbd_scene(body, planted_rest(body, rng), rng, sensor="azure-kinect", scale=0.35)


@pytest.mark.parametrize("kind", ["all masks empty", "depth x 1000", "depth / 1000"])
def test_depth_views_without_a_person_are_refused(others, kind):
    body, scene = small_scene()
    with pytest.raises(HabitusError) as error:
        fit_views(spoilt_capture(kind, scene, others), body)
    assert "\n" not in str(error.value) and "pixels of a person" in str(error.value)


def test_depth_views_of_a_wrong_focal_length_fail(others):
    """Other ways of spoiling: benchmarks/surface_faults.py."""
    body, scene = small_scene()
    fit = fit_views(spoilt_capture("focal length x 1.3", scene, others), body, settings=QUICK_DEPTH)
    assert fit.verdict.level == "failed"
