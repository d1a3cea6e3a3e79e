"""Ages of the default body: the tables are complete, straight lines between them follow growth, and
a stoop bends the spine alone.
"""

import numpy as np
import pytest

from habitus_lab.default_body.ages import CHARACTER, KNOTS, LOOK
from habitus_lab.default_body.growth import AGES, BETWEEN, KYPHOSIS, MEDIANS, SEXES, SPREAD
from habitus_lab.default_body.rig import JOINTS
from habitus_lab.default_body.stoop import SHARES, stooped

BONE = 0.1


@pytest.mark.parametrize("sex", SEXES)
def test_tables_have_a_value_for_every_age(sex):
    assert tuple(MEDIANS[sex]) == AGES and tuple(sorted(AGES)) == AGES
    assert set(SPREAD[sex]) <= set(AGES) and set(KYPHOSIS[sex]) <= set(AGES)
    assert all(len(values) == len(KNOTS) for values in (*LOOK[sex].values(), CHARACTER))
    assert KNOTS[0] == AGES[0] and KNOTS[-1] == AGES[-1]


@pytest.mark.parametrize("sex", SEXES)
def test_straight_lines_between_the_ages_follow_growth(sex):
    for k, (name, most) in enumerate((("stature", 0.01), ("weight", 0.7))):
        known = [getattr(MEDIANS[sex][years], name) for years in AGES]
        for years, published in BETWEEN[sex].items():
            assert abs(np.interp(years, AGES, known) - published[k]) < most, (years, name)


def test_a_stoop_bends_the_thorax_and_leaves_pelvis_head_and_arms_level():
    joints = np.zeros((len(JOINTS), 3))
    for k, name in enumerate(("pelvis", "spine1", "spine2", "spine3", "neck", "head")):
        joints[JOINTS.index(name), 1] = BONE * k
    for sign, side in ((1, "left"), (-1, "right")):
        for k, name in enumerate(("collar", "shoulder", "elbow", "wrist")):
            joints[JOINTS.index(f"{side}_{name}")] = sign * BONE * (k + 0.5), 3.5 * BONE, 0
    ends = joints + np.array([0.0, BONE, 0.0])
    body = np.concatenate([joints, ends])
    weights = np.tile(np.eye(len(JOINTS)), (2, 1))
    assert np.abs(stooped(body, joints, weights, 0.0) - body).max() < 1e-12
    moved = stooped(body, joints, weights, 20.0)
    place, up = moved[: len(JOINTS)], moved[len(JOINTS) :] - moved[: len(JOINTS)]
    lean = dict(zip(JOINTS, np.degrees(np.arctan2(up[:, 2], up[:, 1])), strict=True))
    assert lean["spine3"] - lean["spine1"] == pytest.approx(20.0)
    assert [lean[name] for name in ("pelvis", "head", "jaw", "left_elbow")] == pytest.approx(
        4 * [0]
    )
    assert lean["left_collar"] == pytest.approx(lean["spine3"]) and lean["spine3"] > 0
    top = JOINTS.index("head")
    assert place[top, 2] > 0.2 * BONE and place[top, 1] < joints[top, 1]
    arm = [JOINTS.index(f"left_{name}") for name in ("shoulder", "elbow", "wrist")]
    assert np.abs(np.diff(place[arm], axis=0) - np.diff(joints[arm], axis=0)).max() < 1e-12
    assert sum(SHARES[name] for name in ("spine1", "spine2", "spine3", "neck", "head")) == (
        pytest.approx(0.0)
    )
