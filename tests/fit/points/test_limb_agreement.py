"""A limb that is turned about itself in one scan of a person shows in its skin's offsets."""

from dataclasses import replace

import numpy as np
import pytest
from page_samples import registered
from scipy.spatial import KDTree

from habitus.fit.points.limb_agreement import limbs_compared
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_result import LIMBS, LIMITS, ScanFit, judge_scan
from habitus.io.models.bodies import load_body
from habitus.mesh.normals import vertex_normals
from habitus.rotations import matrix_from_rotvec

BODY = load_body("default")
MODEL = BODY.rest_vertices()
NORMALS = vertex_normals(MODEL, BODY.faces)


def offsets(rng):
    """Skin off the model by 20 mm (sd), alike over some centimetres."""
    centres = MODEL[rng.integers(0, len(MODEL), 400)]
    near = np.exp(-np.square(np.linalg.norm(MODEL[:, None] - centres, axis=-1) / 0.04))
    field = near @ rng.normal(size=len(centres))
    return 0.02 * field / field.std()


def scan(off, weights=None):
    zero = np.zeros(0)
    count = len(MODEL)
    return ScanFit(
        scan_name="s", body_name="default", body=BODY, betas=np.zeros(BODY.num_betas),
        pose=np.zeros((BODY.num_joints, 3)), trans=np.zeros(3), vertices=MODEL,
        model_vertices=MODEL, rest_vertices=MODEL + off[:, None] * NORMALS,
        weights=np.ones(count) if weights is None else weights,
        cloud=Cloud(np.zeros((0, 3)), np.zeros((0, 3))), to_surface=zero, to_model=zero,
        far_from_surface=zero, matched=1.0, lost=0.0, rival=None, pose_distance=1.0,
        to_body=np.eye(4), up_axis="y",
    )  # fmt: skip


def turned(off, joint, degrees):
    """The offsets of a limb that is turned about the line of the arms, x, as registered skin then
    has them.
    """
    names = BODY.joint_names
    rows = np.flatnonzero(np.asarray(BODY.skinning_weights).argmax(1) == names.index(joint))
    centre = BODY.rest_joints()[names.index(joint)]
    turn = matrix_from_rotvec(np.array([np.radians(degrees), 0.0, 0.0]))
    there = (MODEL[rows] - centre) @ turn.T + centre
    moved = off.copy()
    moved[rows] = off[rows][KDTree(MODEL[rows]).query(there)[1]]
    return moved


def unlike(fit):
    return {
        joint
        for joint, limb in fit.limbs.items()
        if limb.correlation < LIMITS.limb_agreement and limb.deviation > LIMITS.limb_deviation
    }


@pytest.mark.parametrize("seed", [0, 1])
def test_an_arm_turned_about_itself_is_unlike_itself_in_other_scans(seed):
    rng = np.random.default_rng(seed)
    person = offsets(rng)
    scans = [person + 0.2 * offsets(rng) for _ in range(5)]
    scans[3] = turned(scans[3], "left_elbow", 180.0)
    fits = limbs_compared([scan(off) for off in scans])
    assert [unlike(fit) for fit in fits] == [set(), set(), set(), {"left_elbow"}, set()]
    assert all(set(fit.limbs) == set(LIMBS) for fit in fits)


def test_limbs_that_are_not_seen_and_people_with_two_scans_are_not_compared():
    rng = np.random.default_rng(2)
    off = offsets(rng)
    two = limbs_compared([scan(off), scan(turned(off, "left_elbow", 120.0))])
    assert all(not fit.limbs for fit in two)
    hidden = np.ones(len(MODEL))
    hidden[np.asarray(BODY.skinning_weights).argmax(1) == BODY.joint_names.index("left_elbow")] = 0
    nobody = replace(scan(off), person=False)
    fits = limbs_compared([scan(off, hidden), scan(off), nobody, scan(off)])
    assert "left_elbow" not in fits[0].limbs and "left_knee" in fits[0].limbs
    assert not fits[2].limbs and fits[1].limbs["left_elbow"].correlation > 0.99


@pytest.mark.parametrize(("share", "doubted"), [(1.0, False), (0.6, False), (0.1, True)])
def test_a_limb_that_the_scan_does_not_show_is_a_doubt(share, doubted):
    fit = registered("arm")
    weights = np.ones(fit.body.num_vertices)
    joint = fit.body.joint_names.index("left_elbow")
    weights[fit.body.strongest_joint == joint] = share
    fit = replace(fit, weights=weights)
    assert fit.limbs_seen["left_elbow"] == pytest.approx(share)
    assert fit.limbs_seen["right_knee"] == 1.0
    assert any("left forearm" in each for each in judge_scan(fit).reasons) == doubted


@pytest.mark.parametrize(("degrees", "crossed"), [(0.0, False), (-4.0, False), (11.0, True)])
def test_lower_legs_that_pass_through_each_other_are_a_doubt(degrees, crossed):
    pose = np.zeros((BODY.num_joints, 3))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[BODY.joint_names.index(f"{side}_hip"), 2] = sign * np.radians(degrees)
    surface = np.asarray(BODY(pose=pose).vertices)
    fit = replace(registered("legs"), vertices=surface)
    assert (fit.crossed_legs > LIMITS.legs.doubtful) == crossed
    assert any("lower legs" in each for each in judge_scan(fit).reasons) == crossed
