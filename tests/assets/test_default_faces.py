"""Faces of the shipped bodies: lips closed, lids that meet in a blink, skin that does not cut
itself, a jaw that keeps its chin, faces that differ, parts that follow.
"""

import numpy as np
import pytest

from habitus.io.models.bodies import load_body
from habitus.mesh.intersections import intersecting_pairs

SPACES = ("female", "male", "neutral")
UPPER_LID, LOWER_LID = 13353, 13370  # the left lids' front edges, above and below the pupil
UPPER_LIP, LOWER_LIP = 520, 523  # where the lips touch, on the midline
CHIN = 732
HEAD_ROOM = 0.06  # metres of height over the neck joint from which triangles are the head's


@pytest.fixture(scope="module", params=SPACES)
def body(request):
    return load_body(request.param, detail="full", joints="smplx")


def head_skin(body):
    """Triangles of head and neck without eyeballs, and which vertices lie inside no lining."""
    rest = body.v_template
    high = rest[:, 1] > body.joint_template[body.joint_names.index("neck"), 1]
    eyes = [body.joint_names.index(f"{side}_eye_smplhf") for side in ("left", "right")]
    skin = ~np.isin(body.strongest_joint, eyes)
    faces = body.faces[(high & skin)[body.faces].all(1)]
    quads, hidden = body.mesh.quads, body.mesh.hidden
    shown = np.ones(body.num_vertices, bool)
    shown[np.setdiff1d(quads[hidden], quads[~hidden])] = False
    return faces, shown


def cuts(body, face):
    faces, shown = head_skin(body)
    pairs = intersecting_pairs(body(face=face).vertices, faces)
    return int(shown[faces[pairs]].any((1, 2)).sum())


def test_units_are_arkits(body):
    names = body.face_unit_names
    assert len(names) == 52 == len(set(names))
    assert {"jawOpen", "mouthClose", "tongueOut", "cheekPuff", "browInnerUp"} < set(names)
    sides = [name.removesuffix("Left") for name in names if name.endswith("Left")]
    assert {f"{stem}Right" for stem in sides} <= set(names)


def test_left_units_mirror_right_ones(body):
    flip = np.array([-1, 1, 1])
    for stem in ("eyeBlink", "mouthSmile", "eyeLookOut", "jaw"):
        left = body(face={f"{stem}Left": 1.0}).vertices
        right = body(face={f"{stem}Right": 1.0}).vertices
        np.testing.assert_allclose(left, right[body.mirror] * flip, atol=2e-5)


def test_lips_are_closed_at_rest_and_over_an_open_jaw(body):
    for weight in (0.0, 0.5, 1.0):
        seen = body(face={"jawOpen": weight, "mouthClose": weight}).vertices
        assert abs(seen[UPPER_LIP, 1] - seen[LOWER_LIP, 1]) < 8e-4
    opened = body(face={"jawOpen": 1.0}).vertices
    assert opened[UPPER_LIP, 1] - opened[LOWER_LIP, 1] > 0.025


def test_a_blink_closes_the_lids_before_the_eyeball(body):
    aperture = {}
    for weight in (0.0, 0.5, 1.0):
        seen = body(face={"eyeBlinkLeft": weight}).vertices
        aperture[weight] = abs(seen[UPPER_LID, 1] - seen[LOWER_LID, 1])
        eye = np.flatnonzero(body.strongest_joint == body.joint_names.index("left_eye_smplhf"))
        centre = 0.5 * (seen[eye].min(0) + seen[eye].max(0))
        radius = np.linalg.norm(seen[eye] - centre, axis=1).max()
        for lid in (UPPER_LID, LOWER_LID):
            assert np.linalg.norm(seen[lid] - centre) > radius - 6e-4
    assert aperture[0.0] > 6e-3
    assert aperture[1.0] < 1.2e-3
    assert aperture[0.5] == pytest.approx(0.5 * aperture[0.0], rel=0.25)


def test_gaze_turns_eyes_and_moves_lids(body):
    looked = body(face={"eyeLookDownLeft": 1.0})
    rest = body()
    assert looked.vertices[UPPER_LID, 1] < rest.vertices[UPPER_LID, 1] - 1e-3
    pupil = body.landmarks["left_eye"]
    assert looked.vertices[pupil, 1] < rest.vertices[pupil, 1] - 2e-3
    np.testing.assert_allclose(looked.joints, rest.joints, atol=1e-9)


def test_no_unit_pushes_skin_through_skin(body):
    few = {name: cuts(body, {name: 1.0}) for name in body.face_unit_names}
    close = few.pop("mouthClose")  # alone it is no face: it belongs to an open jaw
    assert close >= 0
    blinks = [few.pop(f"eyeBlink{side}") for side in ("Left", "Right")]
    assert max(blinks) <= 120  # edges of closed lids, on the eyeball's side
    assert max(few.values()) <= 30, few
    assert sum(count > 0 for count in few.values()) <= 12


def test_a_turned_jaw_keeps_its_chin(body):
    before = body().vertices
    after = body(pose={"jaw": (np.radians(25), 0, 0)}).vertices
    assert before[CHIN, 1] - after[CHIN, 1] > 0.022
    assert before[CHIN, 2] - after[CHIN, 2] < 0.032
    pivot = body.rest_joints()[body.joint_names.index("jaw")]
    assert before[CHIN, 1] + 0.03 < pivot[1] < before[UPPER_LIP, 1] + 0.03


def test_faces_differ_by_millimetres_and_bodies_do_not(body):
    rng = np.random.default_rng(0)
    drawn = body(face_betas=rng.normal(size=(20, body.num_face_betas))).vertices - body().vertices
    feet = body.v_template[:, 1] < body.joint_template[body.joint_names.index("neck"), 1] - 0.1
    assert np.abs(drawn[:, feet]).max() < 1e-5
    face = body.v_template[:, 2] > body.joint_template[body.joint_names.index("jaw"), 2] + 0.03
    face &= body.v_template[:, 1] > body.v_template[CHIN, 1]
    assert 2e-3 < np.sqrt((drawn[:, face] ** 2).sum(2).mean()) < 7e-3


def test_parts_follow_jaw_shape_and_lids(body):
    whole = load_body(body.name, detail="parts", joints="smplx")
    first = body.num_vertices
    index, names = whole.extras["part_index"], whole.extras["part_names"].tolist()
    assert set(names) == {"upper_teeth", "lower_teeth", "tongue", "lashes"}

    def part(surface, name):
        return surface.vertices[first:][index == names.index(name)]

    rest = whole()
    np.testing.assert_allclose(rest.vertices[:first], body().vertices, atol=1e-12)
    opened = whole(pose={"jaw": (0.4, 0, 0)})
    assert (part(rest, "lower_teeth") - part(opened, "lower_teeth"))[:, 1].min() > 0.005
    np.testing.assert_allclose(part(rest, "upper_teeth"), part(opened, "upper_teeth"), atol=1e-3)
    blink = whole(face={"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0})
    assert (part(rest, "lashes") - part(blink, "lashes"))[:, 1].max() > 0.004
    out = whole(face={"tongueOut": 1.0})
    assert (part(out, "tongue") - part(rest, "tongue"))[:, 2].max() > 0.01
    tall = whole([2.0])
    gap = part(tall, "upper_teeth").mean(0) - tall.vertices[UPPER_LIP]
    same = part(rest, "upper_teeth").mean(0) - rest.vertices[UPPER_LIP]
    assert np.linalg.norm(gap - same) < 0.006
    assert load_body(body.name).full.full.num_vertices == whole.num_vertices
