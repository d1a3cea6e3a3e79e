"""Gaps: what is not seen moves on as it did on both sides, and what is seen decides where it is
seen.
"""

import numpy as np
import pytest
from planted import attach, degrees_apart, fit, plant, rest, settings
from scipy.spatial.transform import Rotation, Slerp

from habitus.fit.markers import gaps
from habitus.fit.markers.start import start_sequence
from habitus.observe.marker_rig import marker_rig

QUICK = settings(annealing=(10.0, 1.0), soft_tissue=False)
ARM = ("LELB", "LFRM", "LWRA", "LWRB", "LFIN")


@pytest.fixture(scope="module")
def clean():
    return plant()


@pytest.fixture(scope="module")
def rig(clean):
    where = attach(clean.latent_markers, rest(clean.betas), np.asarray(clean.body.faces))
    return marker_rig(clean.body, clean.betas, where)


def hidden(frames: int, *parts: slice) -> np.ndarray:
    known = np.ones(frames, dtype=bool)
    for part in parts:
        known[part] = False
    return known


def test_a_straight_motion_goes_on_and_ends_hold():
    values = np.outer(np.arange(60.0), [1.0, -2.0])
    known = hidden(60, slice(0, 5), slice(20, 40), slice(55, 60))
    found = gaps.bridge(np.where(known[:, None], values, 77.0), known, 30.0)
    np.testing.assert_allclose(found[5:55], values[5:55], atol=1e-9)
    np.testing.assert_array_equal(found[:5], np.repeat(values[5:6], 5, axis=0))
    np.testing.assert_array_equal(found[55:], np.repeat(values[54:55], 5, axis=0))
    np.testing.assert_array_equal(gaps.bridge(values, ~known & False, 30.0), values)


@pytest.mark.parametrize("seconds,share", [(0.5, 0.3), (2.0, 1.2)])
def test_velocities_last_for_a_while(seconds, share):
    """A swing of 1 Hz: far better than the straight line through half a second, hardly worse
    through two.
    """
    rate = 100.0
    time = np.arange(400) / 100.0
    values = np.sin(2 * np.pi * time + 0.4)[:, None]
    known = hidden(400, slice(120, 120 + int(seconds * rate)))
    bent, straight = (
        np.abs(gaps.bridge(values, known, speed) - values)[~known].mean() for speed in (rate, 0.0)
    )
    assert bent < share * straight


@pytest.mark.parametrize("size", [0.01, 100.0])
def test_bridges_do_not_depend_on_units_or_places(size):
    rate = 100.0
    time = np.arange(400) / 100.0
    values = np.stack([np.sin(2 * np.pi * time + 0.4), np.cos(5 * time)], axis=1)
    known = hidden(400, slice(120, 170))
    expected = size * gaps.bridge(values, known, rate) + 3.0
    np.testing.assert_allclose(
        gaps.bridge(size * values + 3.0, known, rate), expected, atol=1e-9 * size
    )


def test_rotations_turn_the_short_way_at_an_even_pace():
    ends = Rotation.from_rotvec([[0.0, 3.0, 0.2], [0.3, -2.9, 0.0]])
    pose = np.repeat(ends.as_rotvec(), 20, axis=0)
    known = hidden(40, slice(10, 30))
    found = gaps.bridge_rotations(pose, known)
    expected = Slerp([9, 30], ends)(np.arange(10, 30)).as_rotvec()
    assert degrees_apart(found[10:30], expected).max() < 1e-6
    turning = Rotation.from_rotvec(np.outer(np.linspace(0, 2.0, 60), [0.6, 0.0, 0.8])).as_rotvec()
    bridged = gaps.bridge_rotations(turning, hidden(60, slice(15, 45)), 30.0)
    assert degrees_apart(bridged, turning).max() < 1e-6


def test_short_gaps_are_filled_and_long_ones_left():
    time = np.linspace(0, 2, 200)
    whole = np.stack([np.sin(3 * time), np.cos(2 * time), time], axis=1)[:, None].repeat(2, axis=1)
    observed = whole.copy()
    observed[50:58, 0], observed[100:130, 0], observed[:3, 1] = np.nan, np.nan, np.nan
    filled = gaps.fill_short_gaps(observed, 100.0)
    np.testing.assert_allclose(filled[50:58], whole[50:58], atol=1e-3)
    assert np.isnan(filled[100:130, 0]).all() and np.isnan(filled[:3, 1]).all()
    assert np.isnan(observed[50:58, 0]).all() and gaps.fill_short_gaps(whole, 100.0) is whole


def test_a_joint_is_known_where_its_markers_are_seen(clean, rig):
    seen = np.isfinite(clean.observed[..., 0])
    seen[10:20, clean.columns("LWRA", "LWRB", "LFIN", "LFRM")] = False
    known = gaps.known_joints(rig, clean.pose, seen)
    names = clean.body.joint_names
    assert set(np.flatnonzero(~known.all(axis=1))) == set(range(10, 20))
    lost = {names[j] for j in np.flatnonzero(~known.all(axis=0))}
    assert (
        {"left_elbow", "left_wrist"}
        <= lost
        <= {"left_elbow", "left_wrist", "left_hand", "left_shoulder"}
    )


def test_a_marker_tells_more_of_a_joint_the_further_it_is_away_up_to_fifteen_centimetres(
    clean, rig
):
    lever = gaps._leverage(rig, np.zeros((clean.body.num_joints, 3)), gaps.GAPS.max_lever)
    wrist, elbow = (clean.body.joint_names.index(f"left_{name}") for name in ("wrist", "elbow"))
    assert (
        lever.max() == gaps.GAPS.max_lever**2
        and (lever[clean.columns("LWRA", "LWRB", "LFIN"), elbow] == 0.0225).all()
    )
    assert 1e-4 < lever[clean.column("LWRA"), wrist] < 0.0225
    assert np.abs(lever[clean.column("RWRA"), [wrist, elbow]]).max() < 1e-6


@pytest.mark.parametrize("weights", [None, np.random.default_rng(0).uniform(0.1, 1.0, size=(9, 5))])
def test_markers_that_are_left_out_have_no_say_and_the_others_theirs(weights):
    whole = gaps.MarkerTargets(np.zeros((9, 5, 3)), weights)
    expected = np.ones((9, 5)) if weights is None else weights.copy()
    expected[:, [1, 4]] = 0.0
    np.testing.assert_array_equal(gaps.without(whole, [4, 1]).weights, expected)
    assert gaps.without(whole, []) is whole


def test_a_start_goes_straight_through_empty_frames(clean, rig):
    observed = clean.exact.copy()
    observed[20:44] = np.nan
    observed[30, :3] = 50.0  # three markers tell no root
    pose, trans = start_sequence(rig, clean.pose[:1], clean.body.joint_names, observed)
    share = (np.arange(19, 45) - 19.0)[:, None] / 25.0
    np.testing.assert_allclose(trans[19:45], trans[19] + share * (trans[44] - trans[19]), atol=1e-9)
    expected = Slerp([19, 44], Rotation.from_rotvec(pose[[19, 44], 0]))(
        np.arange(19, 45)
    ).as_rotvec()
    assert degrees_apart(pose[19:45, 0], expected).max() < 1e-6


@pytest.fixture(scope="module")
def through(clean):
    """Everything hidden for two thirds of a second, and the ends for half a second."""
    observed = clean.observed.copy()
    observed[:8], observed[22:42], observed[-8:] = np.nan, np.nan, np.nan
    return observed, fit(clean, observed, settings(annealing=(10.0, 1.0)))


def test_the_body_moves_on_through_an_empty_stretch(clean, through):
    _, found = through
    off = np.linalg.norm(found.predicted_soft_tissue - clean.exact, axis=2).mean(axis=1)
    ends = [found.predicted_soft_tissue[k] for k in (21, 42)]
    share = (np.arange(22, 42) - 21.0)[:, None, None] / 21.0
    straight = np.linalg.norm(
        ends[0] + share * (ends[1] - ends[0]) - clean.exact[22:42], axis=2
    ).mean()
    assert off[22:42].mean() < 0.7 * straight and off[22:42].max() < 0.12
    assert found.flagged_frames.sum() == 36 and (found.marker_weights[~found.visible] == 0).all()
    assert np.isnan(found.errors()[~found.visible]).all()


def test_ends_hold(through):
    _, found = through
    still = np.linalg.norm(
        found.predicted_pose_stage - found.predicted_pose_stage[[8] * 30 + [51] * 30], axis=2
    )
    assert still[:7].max() < 0.02 and still[-7:].max() < 0.02


def test_nothing_jumps_at_a_gap(clean, through):
    _, found = through
    speed = np.linalg.norm(np.diff(found.predicted_soft_tissue, axis=0), axis=2).max(axis=1)
    usual = np.linalg.norm(np.diff(clean.exact, axis=0), axis=2).max()
    assert speed[[21, 41]].max() < 1.5 * usual


@pytest.fixture(scope="module")
def thinned(clean):
    """An arm hidden for a third of a second, and one sample in five lost."""
    observed = clean.observed.copy()
    observed[np.random.default_rng(0).random(observed.shape[:2]) < 0.2] = np.nan
    observed[24:36, clean.columns(*ARM)] = np.nan
    return observed, fit(clean, observed, QUICK)


def test_an_arm_moves_on_while_the_rest_is_seen(clean, thinned):
    off = np.linalg.norm(thinned[1].predicted_pose_stage - clean.exact, axis=2)
    arm = clean.columns(*ARM)
    assert off[24:36, arm].mean() < 0.05
    others = np.delete(off, arm, axis=1)
    assert others[24:36].mean() < 1.5 * others.mean()


def test_one_sample_in_five_lost_changes_little(clean, thinned):
    observed, found = thinned
    np.testing.assert_array_equal(found.visible, np.isfinite(observed[..., 0]))
    away = np.linalg.norm(found.predicted_pose_stage - clean.exact, axis=2)
    away[24:36, clean.columns(*ARM)] = 0.0
    assert away.mean() < 5e-3 and found.suspects == ()
