"""A motion on another body: the same body moves the same, feet stay where they stood, nothing sinks
into the ground.
"""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

from habitus.body.measurements import find_soles
from habitus.body.motion import BodyMotion
from habitus.body.recentred import recentred
from habitus.errors import HabitusError
from habitus.fit.retarget import recipe
from habitus.fit.retarget.contacts import (
    ContactSettings,
    corrections,
    ground_height,
    standing,
)
from habitus.fit.retarget.legs import legs_of, reach, skeleton_of
from habitus.fit.retarget.recipe import retargeted
from habitus.rotations import matrix_from_rotvec, up_rotation


@pytest.fixture(scope="module")
def walk() -> BodyMotion:
    return BodyMotion.of(synthetic_fit(60, rate_hz=60.0))


@pytest.fixture(scope="module")
def step(walk) -> BodyMotion:
    """Both feet stand while the body sways and squats; then the left one takes a step, and stands
    again.
    """
    time = np.arange(60) / 60.0
    pose = np.repeat(walk.pose[:1], 60, axis=0)
    pose[:, 0] = [np.pi / 2, 0.0, 0.0]
    for leg in legs_of(walk.body):
        pose[:, [leg.hip, leg.knee, leg.ankle]] = [[-0.4, 0, 0], [0.8, 0, 0], [-0.4, 0, 0]]
    still = replace(walk, pose=pose, trans=np.repeat(walk.trans[:1], 60, axis=0), soft_tissue=None)
    goals = [skeleton_of(still).world[:, leg.ankle, :, 3] for leg in legs_of(walk.body)]
    share = np.clip((time - 0.4) / 0.25, 0, 1)
    goals[0] = goals[0] + np.stack(
        [0 * time, -0.2 * share**2 * (3 - 2 * share), 0.1 * np.sin(np.pi * share)], 1
    )
    sway = np.stack([0.04 * np.sin(6 * time), -0.1 * time, -0.05 * np.sin(3 * time)], 1)
    moved = replace(still, trans=still.trans + sway)
    for leg, goal in zip(legs_of(walk.body), goals, strict=True):
        moved = replace(moved, pose=reach(moved.pose, skeleton_of(moved), leg, goal))
    return moved


def _taller(motion: BodyMotion, legs: float, rest: float):
    """A character: legs and what is above them stretched by other factors, feet as they were."""
    points = motion.body.v_template.copy()
    hip = 0.88
    ankle = 0.08
    leg = (points[:, 1] < hip) & (points[:, 1] > ankle)
    points[leg, 1] = ankle + legs * (points[leg, 1] - ankle)
    points[points[:, 1] >= hip, 1] = (
        ankle + legs * (hip - ankle) + rest * (points[points[:, 1] >= hip, 1] - hip)
    )
    return recentred(motion.body, points, "stretched")


def test_the_same_body_moves_the_same(walk):
    found = retargeted(walk, walk.body, walk.betas, "itself")
    np.testing.assert_allclose(found.motion.pose, walk.pose, atol=1e-9)
    np.testing.assert_allclose(found.motion.trans, walk.trans, atol=1e-9)
    assert found.scale == pytest.approx(1.0) and found.slip[0] == pytest.approx(
        found.slip[2], abs=1e-6
    )
    assert found.motion.soft_tissue is walk.soft_tissue


def test_a_body_twice_as_large_moves_twice_as_far(walk):
    still = replace(walk, betas=np.zeros_like(walk.betas), soft_tissue=None)
    twice = recentred(walk.body, 2 * walk.body.v_template, "giant")
    found = retargeted(still, twice, still.betas, "giant").motion
    way, theirs = (np.ptp(each.joints()[:, 0, :2], axis=0) for each in (found, still))
    np.testing.assert_allclose(way, 2 * theirs, rtol=0.02)
    assert np.abs(np.diff(found.pose - still.pose, axis=0)).max() < 0.2


@pytest.mark.parametrize(("legs", "rest"), [(0.7, 1.2), (1.3, 0.9)])
def test_feet_stand_and_nothing_sinks(step, legs, rest):
    body = _taller(step, legs, rest)
    found = retargeted(step, body, np.zeros(body.num_betas), "stretched")
    slip = found.slip
    below = found.below
    assert found.scale == pytest.approx(legs, abs=0.12) and found.standing == pytest.approx(1.0)
    assert slip[0] < 0.02 and slip[2] < slip[0] + 0.02 and slip[1] > 2 * slip[2]
    assert below[2] > min(0.0, found.scale * below[0]) - 0.004
    assert (
        found.motion.body_name == "stretched" and "retargeted to stretched" in found.motion.made[-1]
    )
    rough = np.linalg.norm(np.diff(found.motion.joints(), 2, axis=0), axis=2).max(0)
    assert (
        rough < 2.0 * np.linalg.norm(np.diff(step.joints(), 2, axis=0), axis=2).max(0).clip(0.002)
    ).all()


def test_the_world_does_not_matter(step):
    turn = up_rotation("+z")
    other = replace(recipe.turned(step, turn), up_axis="+y")
    body = _taller(step, 1.2, 1.0)
    one, two = (retargeted(each, body, np.zeros(6), "x").motion for each in (step, other))
    np.testing.assert_allclose(one.joints() @ turn.T, two.joints(), atol=1e-6)


def test_legs_reach_their_goals_and_bones_keep_their_length(walk):
    skeleton = skeleton_of(walk)
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(skeleton.world[..., 3], walk.joints(), atol=1e-9)
    leg = legs_of(walk.body)[0]
    bent = walk.pose.copy()
    bent[:, leg.knee] = [0.9, 0.0, 0.0]
    motion = replace(walk, pose=bent)
    skeleton = skeleton_of(motion)
    goal = skeleton.world[:, leg.ankle, :, 3] + 0.03 * rng.normal(size=(60, 3))
    found = skeleton_of(replace(motion, pose=reach(bent, skeleton, leg, goal)))
    assert np.linalg.norm(found.world[:, leg.ankle, :, 3] - goal, axis=1).max() < 0.006
    np.testing.assert_allclose(
        found.world[:, leg.ankle, :, :3], skeleton.world[:, leg.ankle, :, :3], atol=1e-9
    )
    same = reach(bent, skeleton, leg, skeleton.world[:, leg.ankle, :, 3])
    np.testing.assert_allclose(same, bent, atol=1e-7)
    far = reach(bent, skeleton, leg, skeleton.world[:, leg.ankle, :, 3] - [0, 0, 3.0])
    straight = matrix_from_rotvec(far[:, leg.knee])
    assert np.isfinite(far).all() and (np.arccos(np.clip(straight[:, 1, 1], -1, 1)) < 0.25).all()


def test_corrections_hold_the_foot_and_go_smoothly():
    frames = 60
    source = np.zeros((frames, 1, 3))
    source[20:40, 0, 0] = np.linspace(0, 1, 20)
    source[40:, 0, 0] = 1.0
    moved = 1.3 * source + 0.002 * np.arange(frames)[:, None, None]  # slides all the time
    still = np.zeros((frames, 1), bool)
    still[:20], still[40:] = True, True
    shift = corrections(moved, still, source)
    placed = moved[:, 0] + shift
    for part in (slice(0, 20), slice(40, 60)):
        assert np.ptp(placed[part], axis=0).max() < 1e-12
        np.testing.assert_allclose(placed[part, 0], moved[part, 0, 0].mean())
        np.testing.assert_allclose(placed[part, 1], source[part, 0, 1], atol=1e-12)
    assert np.abs(np.diff(shift, axis=0)).max() < 0.02
    assert not corrections(moved, np.zeros_like(still), source).any()


def test_standing_and_the_ground():
    points = np.zeros((100, 1, 3))
    points[40:60, 0, 0] = np.linspace(0, 1, 20)
    points[60:, 0, 0] = 1.0
    points[..., 1] = 0.013
    still = standing(points, 100.0)
    assert still[:35].all() and still[65:].all() and not still[42:58].any()
    assert ground_height(points[..., 1], still) == pytest.approx(0.013)
    assert not standing(points[:1], 100.0).any()
    assert ground_height(points[..., 1], np.zeros_like(still)) == pytest.approx(0.013)


def test_soles_are_low_and_heel_to_toe(walk):
    soles = find_soles(walk.body)
    rest = soles.means(walk.body.v_template[None][:, soles.used])[0]
    assert (np.diff(rest[..., 2], axis=1) >= 0).all() and rest[..., 1].max() < 0.09
    assert (rest[0, :, 0] > 0).all() and (rest[1, :, 0] < 0).all()
    headless = replace(walk.body, joint_names=tuple(f"j{k}" for k in range(24)))
    with pytest.raises(HabitusError, match="left foot"):
        find_soles(headless)
    with pytest.raises(HabitusError, match="no joint left_hip"):
        retargeted(replace(walk, body=headless), headless, walk.betas, "x")


def test_settings_reach_the_soles_and_the_ground(walk):
    """A sole that reaches higher has more points; a floor without tolerance is the lowest stand."""
    thin, thick = (
        find_soles(walk.body, ContactSettings(sole_height=height)).used for height in (0.01, 0.05)
    )
    assert len(thick) > len(thin)
    heights = np.array([[0.0], [0.03], [0.03], [0.03]])
    still = np.ones_like(heights, bool)
    assert ground_height(heights, still) == pytest.approx(0.03)
    assert ground_height(heights, still, ContactSettings(floor_tolerance=0.0)) < 0.03
