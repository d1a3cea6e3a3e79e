"""A generic OpenSim model scaled to a person: planted factors, places and motions come back."""

from pathlib import Path

import numpy as np
import pytest
from opensim_models import SIDED, posed_markers, small_model

from habitus.body.anatomy import SACRUM
from habitus.errors import HabitusError
from habitus.export.opensim_scaling import carriers, measured, placed, scale_to

PLACES = {
    "ASI": "asis", "PSI": "psis", "ACR": "acromion", "LFC": "knee_lateral", "MFC": "knee_medial",
    "LMAL": "ankle_lateral", "MMAL": "ankle_medial", "CAL": "heel", "MT5": "mt5_head",
    "TOE": "big_toe",
}  # fmt: skip
LANDMARKS = {"C7": "c7"} | {
    f"{end}{label}": f"{side}_{place}"
    for label, place in PLACES.items()
    for end, side in (("R", "right"), ("L", "left"))
}
PLANTED = {
    "pelvis": (1.1, 1.0, 0.9), "torso": (0.92, 0.92, 1.05),
    **{f"{body}_{end}": (factor,) * 3 for end in "rl"
       for body, factor in (("femur", 0.93), ("tibia", 1.08), ("talus", 1.04), ("calcn", 1.04))},
}  # fmt: skip
POSE = {
    "pelvis_tx": 0.3, "pelvis_ty": 0.9, "pelvis_tilt": 0.1, "hip_adduction_r": -0.12,
    "hip_adduction_l": 0.1, "hip_flexion_l": 0.15, "knee_angle_r": -0.1, "ankle_angle_l": 0.1,
    "lumbar_extension": -0.08,
}  # fmt: skip


@pytest.fixture(scope="module")
def opensim():
    pytest.importorskip("opensim", reason="pip install opensim")
    from habitus.export.opensim_engine import engine

    return engine()


def test_planted_factors_are_found_in_another_pose(opensim):
    """Of a person who is the model with other proportions, standing otherwise."""
    from habitus.export.opensim_engine import joint_centres, scaled

    generic = small_model(opensim)
    person = scaled(generic, PLANTED, 60.0)
    assert person.getTotalMass(person.initSystem()) == pytest.approx(60.0)
    labels, markers = posed_markers(person, {name: np.array([v]) for name, v in POSE.items()})
    places = {LANDMARKS[k]: p for k, p in zip(labels, markers[0], strict=True) if k in LANDMARKS}
    state = person.initSystem()
    for name, value in POSE.items():
        person.getCoordinateSet().get(name).setValue(state, value, False)
    person.realizePosition(state)
    for side in ("left", "right"):
        hip = person.getBodySet().get(f"femur_{side[0]}").getPositionInGround(state)
        places[f"{side}_hip"] = hip.to_numpy()
    found = scale_to(generic, LANDMARKS, places, 60.0, "small.osim")
    for body, factor in PLANTED.items():
        np.testing.assert_allclose(found.factors[body], factor, atol=2e-3, err_msg=body)
    assert found.landmark_error < 5e-4
    own, truth = joint_centres(found.model), joint_centres(person)
    for body in ("femur_r", "tibia_l", "calcn_r"):
        np.testing.assert_allclose(own[body], truth[body], atol=2e-3)


def test_scaling_does_not_know_how_large_the_generic_model_was(opensim):
    from habitus.export.opensim_engine import joint_centres, scaled

    generic = small_model(opensim)
    labels, markers = posed_markers(generic, {"pelvis_ty": np.array([0.9])})
    places = {LANDMARKS[k]: p for k, p in zip(labels, markers[0], strict=True) if k in LANDMARKS}
    centres = joint_centres(generic)
    for side in ("left", "right"):
        places[f"{side}_hip"] = centres[f"femur_{side[0]}"] + [0.0, 0.9, 0.0]
    bodies = [body.getName() for body in generic.getBodySet()]
    twice = scaled(generic, dict.fromkeys(bodies, (1.3, 1.3, 1.3)), 60.0)
    one, other = (scale_to(m, LANDMARKS, places, 60.0, "m.osim") for m in (generic, twice))
    for body in bodies:
        np.testing.assert_allclose(
            1.3 * np.array(other.factors[body]), one.factors[body], rtol=2e-3
        )


def test_inverse_kinematics_finds_the_motion_that_made_the_markers(opensim):
    from habitus.export.opensim_engine import coordinate_names, track

    model = small_model(opensim)
    waves = np.sin(np.linspace(0.0, 3.0, 20))
    motion = {name: value * (1.0 + waves) for name, value in POSE.items()}
    labels, markers = posed_markers(model, motion)
    markers[3, 4] = np.nan  # a marker that is missing in a frame
    found = track(model, labels, markers, 100.0, ("femur_r",))
    seen = np.isfinite(markers)
    assert np.abs(found.markers - markers)[seen].max() < 5e-4  # of its accuracy
    for name, values in motion.items():
        own = found.coordinates[:, coordinate_names(model).index(name)]
        np.testing.assert_allclose(own, values, atol=2e-3)
    turns, k = found.turns[:, 0], labels.index("RLFC")
    place = placed(found.turns, found.origins, markers[:, [k]], [0])
    np.testing.assert_allclose(place[0], SIDED["LFC"][1], atol=1e-3)
    square = np.broadcast_to(np.eye(3), turns.shape)
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), square, atol=1e-9)


def test_models_that_cannot_be_scaled_are_refused_in_a_line(opensim):
    from habitus.export.opensim_engine import load_model

    model = small_model(opensim)
    person = {place: np.zeros(3) for place in LANDMARKS.values()}
    person |= {f"{side}_hip": np.zeros(3) for side in ("left", "right")}
    feet = {k: v for k, v in LANDMARKS.items() if "knee" not in v}
    with pytest.raises(HabitusError, match="no markers measure its thigh") as caught:
        scale_to(model, feet, person, 60.0, "small.osim")
    assert "\n" not in str(caught.value)
    model.updBodySet().get("tibia_l").setName("shin")
    with pytest.raises(HabitusError, match="no body tibia_l") as caught:
        scale_to(model, LANDMARKS, person, 60.0, "small.osim")
    assert "\n" not in str(caught.value)
    with pytest.raises(HabitusError, match=r"OpenSim cannot read none\.osim") as caught:
        load_model(Path("none.osim"))
    assert "\n" not in str(caught.value)


def test_places_are_means_over_seen_frames():
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.normal(size=(30, 2, 3, 3)))[0]
    origins = rng.normal(size=(30, 2, 3))
    truth, carrier = rng.normal(size=(4, 3)), [0, 1, 1, 0]
    markers = np.einsum("tmij,mj->tmi", turns[:, carrier], truth) + origins[:, carrier]
    markers[rng.random((30, 4)) < 0.3] = np.nan
    markers[:, 3] = np.nan
    found = placed(turns, origins, markers, carrier)
    np.testing.assert_allclose(found[:3], truth[:3], atol=1e-12)
    assert np.isnan(found[3]).all()


def test_lengths_are_of_pairs_that_both_have():
    person = {"left_asis": np.zeros(3), "left_psis": np.array([0.2, 0, 0]), SACRUM: np.ones(3)}
    model = {name: 2.0 * place for name, place in person.items()} | {"right_asis": np.ones(3)}
    (name,) = measured(person, model)
    mine, its = measured(person, model)[name]
    assert name == "pelvis depth" and its == pytest.approx(2.0 * mine)
    model["left_psis"] = np.full(3, np.nan)
    assert measured(person, model)[name][0] == pytest.approx(np.sqrt(3.0))


@pytest.mark.parametrize(
    ("joint", "place", "own", "wanted"),
    [("left_hip", "left_thigh_lateral", None, "femur_l"),
     ("left_knee", "left_knee_lateral", None, "femur_l"),
     ("left_hip", "left_asis", None, "pelvis"),
     ("right_foot", "right_big_toe", None, "calcn_r"),
     ("right_shoulder", "right_acromion", None, "torso"),
     ("spine3", "t6", None, "torso"),
     ("spine1", SACRUM, None, "pelvis"),
     ("left_elbow", "left_wrist_ulnar", None, None),
     ("head", "glabella", None, None),
     ("right_ankle", "right_mt5_head", "toes_r", "toes_r")],
)  # fmt: skip
def test_markers_ride_on_the_bone_that_their_landmark_is_of(joint, place, own, wanted):
    """None where the model has no such body: gait2392 has no arms and no head of its own."""
    legs = [f"{body}_{end}" for body in ("femur", "tibia", "calcn", "toes") for end in "rl"]
    assert carriers([joint], [place], [own], ["pelvis", "torso", *legs]) == [wanted]
