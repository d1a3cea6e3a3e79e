"""Seated measures: limbs are at right angles whoever sits, heights add up, and sizes scale."""

import csv
import json

import numpy as np
import pytest

from habitus.body.seated import SEATED, UNRELIABLE, seated_pose
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.jobs.measuring import measure_file


@pytest.mark.parametrize("name", ["female", "male"])
def test_limbs_are_at_right_angles_for_everybody(name):
    body = load_body(name)
    betas = np.random.default_rng(0).normal(size=body.num_betas)
    at = dict(zip(body.joint_names, body.rest_joints(betas), strict=True))
    pose = np.zeros((body.num_joints, 3))
    for joint, turn in seated_pose(at).items():
        pose[body.joint_names.index(joint)] = turn
    joints = dict(zip(body.joint_names, np.asarray(body(betas, pose).joints), strict=True))
    for side in ("left", "right"):
        hip, knee, ankle, shoulder, elbow, wrist = (
            joints[f"{side}_{part}"]
            for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
        )
        np.testing.assert_allclose((knee - hip)[:2], 0.0, atol=1e-6)
        np.testing.assert_allclose((ankle - knee)[[0, 2]], 0.0, atol=1e-6)
        np.testing.assert_allclose((wrist - elbow)[:2], 0.0, atol=1e-6)
        assert knee[2] > hip[2]
        assert ankle[1] < knee[1]
        assert elbow[1] < shoulder[1]


def test_heights_add_up_and_sizes_scale():
    body = load_body("female")
    rest = np.asarray(body.rest_vertices(np.zeros(body.num_betas)))
    measured = body.measure_rest(rest, posture="seated")
    assert set(measured) == set(SEATED)
    np.testing.assert_allclose(
        measured["elbow_rest_height_m"] + measured["shoulder_elbow_length_m"],
        measured["shoulder_height_sitting_m"],
    )
    larger = body.measure_rest(1.1 * rest, posture="seated")
    for name, value in measured.items():  # pose blend shapes do not grow with the person
        rtol = 0.08 if name in UNRELIABLE else 0.015
        np.testing.assert_allclose(larger[name], 1.1 * value, rtol=rtol, err_msg=name)


def test_longer_shanks_lift_the_knees_alone():
    body = load_body("male")
    rest = np.asarray(body.rest_vertices(np.zeros(body.num_betas)))
    knee = body.joint_regressor[body.joint_names.index("left_knee")] @ rest
    longer = rest.copy()
    below = knee[1] - 0.12
    longer[rest[:, 1] < below, 1] -= 0.05
    one, other = (body.measure_rest(each, posture="seated") for each in (rest, longer))
    for name in ("knee_height_sitting_m", "popliteal_height_m"):
        np.testing.assert_allclose(other[name] - one[name], 0.05, atol=2e-3)
    for name in ("buttock_knee_length_m", "thigh_clearance_m", "elbow_fingertip_length_m"):
        np.testing.assert_allclose(other[name], one[name], atol=4e-3)


def test_both_levels_of_detail_agree():
    full = load_body("default", detail="full")
    coarse = load_body("default")
    one, other = (body.measure(posture="seated") for body in (full, coarse))
    for name in SEATED:
        np.testing.assert_allclose(one[name], other[name], atol=0.006, err_msg=name)


def test_files(tmp_path):
    measured = measure_file("male", posture="seated")
    assert "not simulated" in measured.notes[0]
    unreliable = measured.notes[1].removeprefix("not reliable: ").split(", ")
    assert len(unreliable) == 3 and set(unreliable) < set(measured.values)
    measured.save(tmp_path / "a.json")
    measured.save(tmp_path / "a.csv")
    facts = json.loads((tmp_path / "a.json").read_text())
    assert set(facts["postures"].values()) == {facts["pose"]}
    assert "seated" in facts["pose"]
    with (tmp_path / "a.csv").open() as lines:
        rows = list(csv.reader(lines))
    assert len(rows) >= len(SEATED)
    with pytest.raises(HabitusError, match="pattern programs take standing people"):
        measured.save(tmp_path / "a.smis")
    with pytest.raises(HabitusError, match="seated dimensions have no picture"):
        measured.draw(tmp_path / "a.svg")
    assert measured.segment_rows() == measure_file("male").segment_rows()
    with pytest.raises(HabitusError, match="expected one of standing, seated"):
        measure_file("male", posture="lying")
