"""What a scanned person wears: weights of points outside the skin, and the skin under clothes."""

from dataclasses import replace

import numpy as np
import pytest

from habitus.body.state import BodyState
from habitus.fit.points.clothes import REGIONS, Clothes
from habitus.fit.points.correspondences import Correspondences, hidden_vertices
from habitus.fit.points.settings import CLOTHES, SCANS
from habitus.io.models.bodies import load_body
from habitus.jobs.register import made_ready
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.clothed import OUTFITS, clothed
from habitus_lab.population.scans import Scanner, scanned, stance

BODY = load_body("default")
VARIANCE = 0.0025**2


def above(distance: float, count: int = 50) -> tuple[Correspondences, np.ndarray, np.ndarray]:
    """Points at a distance (m) outside of faces of a trunk, in the direction of the normals."""
    trunk = BODY.strongest_joint == BODY.joint_names.index("spine2")
    face = np.flatnonzero(trunk[BODY.faces].all(1))[:count]
    corners = BODY.faces[face]
    closest = BODY.v_template[corners].mean(1)
    normal = vertex_normals(BODY.v_template, BODY.faces)[corners].mean(1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    share = np.full((count, 3), 1.0 / 3.0)
    found = Correspondences(face, share, closest, normal, np.ones(count))
    return found, corners, closest + distance * normal


@pytest.mark.parametrize("name", ["none", "tight"])
def test_without_loose_clothes_all_points_keep_their_weight(name):
    clothes = Clothes.of(BODY, CLOTHES[name])
    for distance in (-0.02, 0.0, 0.02):
        assert np.all(clothes.factor(*above(distance), VARIANCE) == 1.0)
        assert not clothes.hanging(*above(distance)).any()
    assert not clothes.loose and not clothes.covered.any()


@pytest.mark.parametrize("distance", [0.005, 0.02, 0.05])
def test_cloth_off_the_skin_pulls_by_the_slope_of_an_exponential_distribution(distance):
    clothes = Clothes.of(BODY, CLOTHES["loose"])
    found, corners, points = above(distance)
    slope = distance * clothes.factor(found, corners, points, VARIANCE) / VARIANCE
    np.testing.assert_allclose(slope, 1.0 / clothes.ease[corners].mean(1), rtol=1e-9)
    assert np.all(clothes.hanging(found, corners, points))


def test_a_scan_inside_the_skin_counts_in_full_under_loose_clothes():
    clothes = Clothes.of(BODY, CLOTHES["loose"])
    assert np.all(clothes.factor(*above(-0.01), VARIANCE) == 1.0)
    assert not clothes.hanging(*above(-0.01)).any()
    assert not clothes.hanging(*above(0.001)).any()


def test_head_hands_and_feet_are_never_under_clothes():
    clothes = Clothes.of(BODY, CLOTHES["loose"])
    for joint, hair in (("left_hand", False), ("right_foot", False), ("head", True)):
        rows = BODY.skinning_weights[:, BODY.joint_names.index(joint)] > 0.99
        worn = clothes.ease[rows]
        assert worn.max() == pytest.approx(clothes.settings.hair_ease if hair else 0.0, abs=1e-4)
        assert worn.min() == pytest.approx(0.0, abs=1e-4)  # a face is bare


def test_the_skin_under_loose_clothes_is_estimated_and_doubtful():
    rng = np.random.default_rng(3)
    body = load_body("male", detail="full")
    pose = stance("A", body.joint_names, rng)
    skin = np.asarray(body(0.7 * rng.normal(size=body.num_betas), pose).vertices)
    faces = body.faces[~hidden_vertices(body)[body.faces].all(1)]
    person = clothed(body, skin, faces, OUTFITS[1], rng)
    scan = scanned(person.vertices, person.faces, Scanner(15_000, holes=0.0), rng)
    start = BodyState(np.zeros(body.num_betas), pose[None], np.zeros((1, 3)))
    bare, dressed = (
        replace(
            made_ready("male", settings=replace(SCANS, clothes=CLOTHES[clothes])), detailed=None
        ).register([scan], up="+y", unit="m", previous=start)[0]
        for clothes in ("none", "loose")
    )
    worn = (person.covered > 0.5)[dressed.body.full_vertices]
    outside = []
    for fit in (bare, dressed):
        true = (skin @ fit.to_body[:3, :3].T + fit.to_body[:3, 3])[fit.body.full_vertices]
        off = ((fit.vertices - true) * vertex_normals(true, fit.body.faces)).sum(1)
        outside.append(float(off[worn].mean()))
    assert outside[0] > 0.010 and abs(outside[1]) < 0.5 * outside[0]
    assert dressed.verdict.level == "doubtful" and "clothed" in dressed.verdict.keys
    assert set(dressed.cloth) == set(REGIONS) and dressed.cloth["trunk"] > 0.003
    assert not bare.cloth and bare.weights.mean() > 2.0 * dressed.weights.mean()
