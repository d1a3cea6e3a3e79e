import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from synthetic import synthetic_body

from habitus.body.measurement_names import (
    DEFINITIONS,
    HANGING_ARMS,
    find_measurement,
    posture_of,
)
from habitus.body.measurements import circumference, measure, volume
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body


def test_tapes_and_scales_agree_with_geometry():
    ball = trimesh.creation.icosphere(5, radius=0.5)
    assert volume(ball.vertices + 7, ball.faces) == pytest.approx(math.pi / 6, rel=2e-3)
    for normal in np.random.default_rng(0).normal(size=(5, 3)):
        tape = circumference(ball.vertices, ball.faces, np.zeros(3), normal)
        assert tape == pytest.approx(math.pi, rel=2e-3)
    shifted = circumference(ball.vertices, ball.faces, np.array([0, 0.3, 0]), np.array([0, 1.0, 0]))
    assert shifted == pytest.approx(2 * math.pi * 0.4, rel=3e-3)
    assert (
        circumference(ball.vertices, ball.faces, np.array([0, 2.0, 0]), np.array([0, 1.0, 0])) == 0
    )


def test_a_tape_takes_the_loop_that_it_is_held_to_and_spans_hollows():
    thick = trimesh.creation.cylinder(0.2, 1, sections=96)
    thin = trimesh.creation.cylinder(0.1, 1, sections=96)
    thin.apply_translation([1, 0, 0])
    both = trimesh.util.concatenate([thick, thin])
    for place, radius in ((0.1, 0.2), (0.9, 0.1)):
        tape = circumference(
            both.vertices, both.faces, np.array([place, 0, 0.013]), np.array([0, 0, 1.0])
        )
        assert tape == pytest.approx(2 * math.pi * radius, rel=1e-3)
    thick.vertices[
        np.round(np.arctan2(*thick.vertices[:, :2].T) / (2 * math.pi / 96)) % 2 == 1, :2
    ] *= 0.5
    tape = circumference(
        thick.vertices, thick.faces, np.array([0, 0, 0.013]), np.array([0, 0, 1.0])
    )
    assert tape == pytest.approx(2 * math.pi * 0.2, rel=3e-3)  # a gear: from tooth to tooth


def test_a_default_person_measures_like_one():
    body = load_body("default")
    found = measure(body, body.v_template)
    ranges = {  # what adults of a survey span, generously, in metres and kilograms
        "height_m": (1.5, 1.95),
        "mass_kg": (45, 110),
        "arm_span_m": (1.45, 2.05),
        "inseam_m": (0.65, 0.98),
        "foot_length_m": (0.21, 0.31),
        "chest_circumference_m": (0.75, 1.3),
        "waist_circumference_m": (0.62, 1.25),
        "hip_circumference_m": (0.8, 1.3),
        "neck_circumference_m": (0.28, 0.48),
        "head_circumference_m": (0.5, 0.63),
        "thigh_circumference_m": (0.42, 0.8),
        "calf_circumference_m": (0.29, 0.5),
        "ankle_circumference_m": (0.18, 0.29),
        "upper_arm_circumference_m": (0.22, 0.45),
        "forearm_circumference_m": (0.2, 0.36),
        "wrist_circumference_m": (0.13, 0.21),
        "shoulder_breadth_m": (0.38, 0.58),
        "biacromial_breadth_m": (0.32, 0.46),
        "shoulder_height_m": (1.2, 1.6),
        "upper_arm_length_m": (0.26, 0.39),
        "forearm_length_m": (0.2, 0.31),
        "hand_length_m": (0.15, 0.22),
        "sitting_height_m": (0.78, 1.03),
        "waist_depth_m": (0.15, 0.34),
        "chest_depth_m": (0.18, 0.35),
        "hip_depth_m": (0.17, 0.33),
        "foot_breadth_m": (0.08, 0.12),
        "hand_breadth_m": (0.065, 0.1),
        "head_length_m": (0.17, 0.22),
        "head_breadth_m": (0.13, 0.17),
        "knee_height_m": (0.38, 0.56),
    }
    assert found.keys() == DEFINITIONS.keys()
    for name, (low, high) in ranges.items():
        assert low < found[name] < high, f"{name} is {found[name]:.3f}"


def test_measurements_scale_with_the_person_and_not_with_the_place():
    body = replace(
        load_body("default"), posedirs=None
    )  # pose blend shapes, in metres, do not scale with the person
    found = measure(body, body.v_template)
    larger = measure(body, 1.1 * body.v_template + 3)
    for name, value in found.items():
        power = {"_m2": 2, "_m3": 3, "_kg": 3, "deg": 0}.get(name[-3:], 1)
        assert larger[name] == pytest.approx(value * 1.1**power, rel=1e-4), name
    unmarked = measure(
        replace(body, landmarks={}), body.v_template
    )  # joints stand in for landmarks
    assert {
        "height_m",
        "shoulder_breadth_m",
        "waist_depth_m",
        "chest_circumference_m",
        "knee_circumference_m",
    } <= set(unmarked)
    assert not {"head_circumference_m", "hand_length_m", "shoulder_height_m"} & set(unmarked)
    for name, value in unmarked.items():
        assert value == pytest.approx(found[name], rel=0.15), name


def test_measurements_never_jump():
    """Along straight lines through the space of shapes: a jump would show in the differences of the
    differences.
    """
    body = load_body("default")
    rng = np.random.default_rng(3)
    for _ in range(4):
        start, way = rng.normal(size=(2, body.num_betas))
        line = start + np.arange(-20, 21)[:, None] * 0.05 * way / np.abs(way).max()
        for name, values in body.measure_people(line).items():
            limit = {"_kg": 0.012, "deg": 0.1}.get(name[-3:], 0.001)
            assert np.abs(np.diff(values, 2)).max() < limit, name


def test_people_measured_together_are_measured_alike():
    body = load_body("default")
    betas = np.random.default_rng(0).normal(size=(3, body.num_betas))
    together = body.measure_people(betas)
    for k, each in enumerate(betas):
        assert body.measure(each) == pytest.approx(
            {name: values[k] for name, values in together.items()}
        )


def test_a_body_is_measured_where_its_own_template_is_cut():
    """On the template the material ring and the plane are one; a ring goes with the skin, whatever
    the plane does.
    """
    body = load_body("default")
    tape = next(tape for tape in body.measuring_kit.tapes if tape.name == "calf")
    joints = dict(zip(body.joint_names, body.joint_template, strict=True))
    for side, ring in zip(("left", "right"), tape.rings, strict=True):
        place = joints[f"{side}_knee"] + 0.3 * (joints[f"{side}_ankle"] - joints[f"{side}_knee"])
        sliced = circumference(body.v_template, body.faces, place, np.array([0.0, 1.0, 0.0]))
        assert ring.length(body.v_template) == pytest.approx(sliced)
    bent = body(pose={"left_knee": (1.2, 0.0, 0.0)}).vertices
    assert ring.length(bent) == pytest.approx(
        ring.length(body.v_template), abs=1e-6
    )  # the right one: it stood still


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("height", "height_m"), ("weight", "mass_kg"), ("waist", "waist_circumference_m"), ("hip girth",
        "hip_circumference_m"), ("chest_circumference_m", "chest_circumference_m"), ("hand-length", "hand_length_m"),
    ],
)  # fmt: skip
def test_measurements_are_found_by_common_names(said, meant):
    assert find_measurement(said) == meant


def test_unknown_measurements_are_told_with_what_is_near():
    with pytest.raises(HabitusError, match=r"no measurement 'waits'; expected one such as .*waist"):
        find_measurement("waits")


def test_the_arms_hang_when_shoulders_are_measured():
    body = load_body("default")
    acromion = body.v_template[body.landmarks["left_acromion"]]
    found = body.measure()
    sole = body.v_template[:, 1].min()
    assert found["shoulder_height_m"] < acromion[1] - sole - 0.005
    assert found["biacromial_breadth_m"] > 2 * acromion[0]


def test_hands_and_animals_are_not_measured_and_open_skins_not_weighed():
    for family in ("mano", "smal"):
        body = synthetic_body(family, 60)
        assert measure(body, body.v_template) == {}
    body = load_body("default")
    assert "mass_kg" not in measure(
        replace(body, faces=body.faces[1:]), torch.as_tensor(body.v_template)
    )


def test_the_page_tells_every_measurement():
    page = (Path(__file__).resolve().parents[2] / "docs" / "measurements.md").read_text("utf-8")
    for name, told in DEFINITIONS.items():
        arms = "hanging" if posture_of(name) == HANGING_ARMS else "level"
        assert f"| `{name}` | {told.says} | {arms} | {told.iso} | {told.column} |" in page


def test_a_name_of_the_standard_means_its_own_row():
    """`--also waist_girth=` once meant the girth at the navel. "waist height" is the navel's in
    ISO 7250-1's sense, which this project's `waist_height_m` follows.
    """
    for name, definition in DEFINITIONS.items():
        for iso in filter(None, definition.iso.split(", ")):
            with suppress(HabitusError):  # some are too long to be names
                assert find_measurement(iso) == name or iso == "waist height", iso
    assert find_measurement("waist_girth") == "natural_waist_circumference_m"
    assert find_measurement("chest_girth") == "chest_circumference_m"
