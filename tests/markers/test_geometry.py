"""What marker positions say of a body, on a hand-made figure: y up, facing +z, its left at +x."""

import numpy as np
import pytest

from habitus.markers import geometry
from habitus.markers.geometry import Scene

TRUNK = {
    "left_asis": (0.12, 1.0, 0.1), "right_asis": (-0.12, 1.0, 0.1), "left_psis": (0.05, 1.0, -0.1),
    "right_psis": (-0.05, 1.0, -0.1), "c7": (0.0, 1.5, -0.08), "jugular_notch": (0.0, 1.5, 0.08),
    "left_acromion": (0.2, 1.45, 0.0), "right_acromion": (-0.2, 1.45, 0.0),
}  # fmt: skip
BACK = (0, 0, -1)
FRONT = (0, 0, 1)
LEFT = (1, 0, 0)
RIGHT = (-1, 0, 0)
UP = (0, 1, 0)
SIDES = (("left", 1.0), ("right", -1.0))


def scene(**extra) -> Scene:
    places = TRUNK | extra
    return Scene(
        np.array([list(places.values())], dtype=float), {name: k for k, name in enumerate(places)}
    )


def arm(side: str, elbow, wrist) -> dict:
    sign = 1.0 if side == "left" else -1.0
    start = np.array(TRUNK[f"{side}_acromion"])
    places = {"elbow_lateral": start + (sign, 1, 1) * np.array(elbow)}
    places["wrist_radial"] = places["elbow_lateral"] + (sign, 1, 1) * np.array(wrist)
    return {f"{side}_{name}": tuple(place) for name, place in places.items()}


def leg(side: str, knee, ankle, toe=(0.0, 0.0, 0.2)) -> dict:
    sign = 1.0 if side == "left" else -1.0
    start = np.array(TRUNK[f"{side}_asis"])
    places = {"knee_lateral": start + (sign, 1, 1) * np.array(knee)}
    places["ankle_lateral"] = places["knee_lateral"] + (sign, 1, 1) * np.array(ankle)
    places["heel"] = places["ankle_lateral"] + (0.0, -0.05, -0.05)
    places["toe_tip"] = places["heel"] + (sign, 1, 1) * np.array(toe)
    return {f"{side}_{name}": tuple(place) for name, place in places.items()}


HANGING = (0.0, -0.3, 0.0)
RAISED = (0.0, 0.3, 0.0)
ALONG = (0.3, 0.0, 0.0)
FORWARD = (0.0, 0.0, 0.25)
DOWN = (0.0, -0.4, 0.0)
BACKWARD = (0.0, 0.0, -0.4)


def test_the_trunk_knows_left_up_and_front():
    whole = scene()
    for found, expected in (
        (geometry.trunk_left(whole), LEFT),
        (geometry.trunk_front(whole), FRONT),
    ):
        np.testing.assert_allclose(found[0], expected, atol=1e-12)
    assert geometry.trunk_up(whole)[0] @ UP > 0.99


@pytest.mark.parametrize("without", ["asis", "psis"])
def test_half_of_a_pelvis_is_enough(without):
    kept = {name: place for name, place in TRUNK.items() if without not in name}
    part = Scene(np.array([list(kept.values())]), {name: k for k, name in enumerate(kept)})
    assert geometry.trunk_up(part)[0] @ UP > 0.95 and geometry.trunk_front(part)[0] @ FRONT > 0.95


@pytest.mark.parametrize(("side", "sign"), SIDES)
@pytest.mark.parametrize(
    ("upper", "lower", "axis"), [(HANGING, FORWARD, LEFT), (ALONG, FORWARD, UP)]
)
def test_a_bent_elbow_has_its_lateral_end_outside(side, sign, upper, lower, axis):
    """Arm hanging and forearm forward: outward. Arm held sideways, forearm forward (palm down):
    up.
    """
    found = geometry.flexion_axis(scene(**arm(side, upper, lower)), side, "elbow")
    np.testing.assert_allclose(
        found[0], (sign if axis == LEFT else 1.0) * np.array(axis), atol=1e-9
    )


@pytest.mark.parametrize(("side", "sign"), SIDES)
def test_a_bent_knee_has_its_lateral_end_outside(side, sign):
    found = geometry.flexion_axis(scene(**leg(side, DOWN, BACKWARD)), side, "knee")
    assert sign * found[0] @ LEFT > 0.95


@pytest.mark.parametrize("degrees", [10.0, 24.0, 26.0, 60.0])
def test_a_joint_that_is_nearly_straight_says_nothing(degrees):
    turned = np.radians(degrees)
    forearm = (0.0, -0.25 * np.cos(turned), 0.25 * np.sin(turned))
    bent = scene(**arm("left", HANGING, forearm))
    for found in (
        geometry.flexion_axis(bent, "left", "elbow"),
        geometry.thumb_direction(bent, "left"),
    ):
        assert np.isfinite(found).all() == (degrees > 25.0) and np.isfinite(found).any() == (
            degrees > 25.0
        )


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("fallen", ["acromion", "wrist_radial"])
def test_an_arm_with_a_marker_on_the_ground_says_nothing(side, fallen):
    places = TRUNK | arm(side, HANGING, FORWARD)
    x, _, z = places[f"{side}_{fallen}"]
    whole = scene(**places | {f"{side}_{fallen}": (x + 0.9, 0.0, z)})
    for found in (
        geometry.flexion_axis(whole, side, "elbow"),
        geometry.thumb_direction(whole, side),
    ):
        assert np.isnan(found).all()
    assert np.isnan(geometry.hanging_elbow_outward(whole, side)).all()


def test_an_elbow_label_down_at_the_thigh_says_nothing():
    """Standing with straight arms: the arm only seems to be bent."""
    places = TRUNK | arm("left", HANGING, HANGING)
    shoulder = np.array(places["left_acromion"])
    for off, bent in (((0.0, -0.27, 0.13), True), ((0.0, -0.18, 0.1), False)):
        whole = scene(**places | {"left_elbow_lateral": tuple(shoulder + off)})
        assert np.isfinite(geometry.thumb_direction(whole, "left")).all() == bent


def test_a_shoulder_that_falls_says_little_on_its_way():
    """Once it is below the elbow, the thumb seems to be on the other side."""
    places = TRUNK | arm("left", HANGING, FORWARD)
    still = scene(**places)
    markers = np.repeat(still.markers[:1], 100, axis=0)
    fall = np.minimum(0.5 * 9.81 * (np.clip(np.arange(100) - 60, 0, None) / 100) ** 2, 1.3)
    markers[:, still.columns["left_acromion"], 1] -= fall
    markers[:, still.columns["left_acromion"], 2] += 0.1 * (fall > 0)
    up = geometry.thumb_direction(Scene(markers, still.columns), "left")[:, 1]
    assert (up[:61] > 0.9).all() and (up < 0).sum() < 6


def test_the_thumb_points_away_from_the_upper_arm():
    """Hanging arm, forearm forward: the thumb is on top."""
    np.testing.assert_allclose(
        geometry.thumb_direction(scene(**arm("left", HANGING, FORWARD)), "left")[0], UP, atol=1e-9
    )


@pytest.mark.parametrize(("side", "sign"), SIDES)
@pytest.mark.parametrize("degrees", [0.0, 30.0, 40.0, 90.0, 150.0, 180.0])
def test_only_an_arm_that_hangs_has_its_elbow_outside(side, sign, degrees):
    turned = np.radians(degrees)
    upper = (0.3 * np.sin(turned), -0.3 * np.cos(turned), 0.0)
    found = geometry.hanging_elbow_outward(scene(**arm(side, upper, FORWARD)), side)[0]
    assert np.isfinite(found).all() == (degrees < 35.0)
    if degrees < 35.0:
        assert sign * found @ LEFT > 0.8 and abs(found @ ((sign, 1, 1) * np.array(upper))) < 1e-9


@pytest.mark.parametrize(("side", "sign"), SIDES)
def test_the_outer_side_of_a_foot_is_that_of_the_little_toe(side, sign):
    found = geometry.foot_outward(scene(**leg(side, DOWN, DOWN)), side)[0]
    assert sign * found @ LEFT > 0.99
    turned_out = geometry.foot_outward(scene(**leg(side, DOWN, DOWN, (0.14, 0.0, 0.14))), side)[0]
    assert sign * turned_out @ LEFT > 0.6 and turned_out @ BACK > 0.6


@pytest.mark.parametrize(("side", "sign"), SIDES)
def test_the_outer_side_of_a_leg_is_away_from_the_other(side, sign):
    np.testing.assert_allclose(
        geometry.leg_outward(scene(), side)[0], sign * np.array(LEFT), atol=1e-12
    )


def test_what_lacks_is_none():
    whole = scene()
    assert (
        geometry.flexion_axis(whole, "left", "elbow") is None
        and geometry.foot_outward(whole, "left") is None
    )
    assert (
        geometry.hanging_elbow_outward(whole, "right") is None
        and geometry.thumb_direction(whole, "left") is None
    )
    empty = Scene(np.zeros((1, 0, 3)), {})
    assert geometry.trunk_left(empty) is None and geometry.trunk_front(empty) is None
    assert geometry.along(None, np.zeros((1, 3))).shape == (0,)


def test_a_missing_marker_gives_nan_and_no_warning():
    place = dict(arm("left", HANGING, FORWARD), left_wrist_radial=(np.nan,) * 3)
    assert np.isnan(geometry.flexion_axis(scene(**place), "left", "elbow")).all()
    assert np.isnan(geometry.unit(np.zeros((1, 3)))).all()
