"""Following one person: who leaves is let go, who returns is found again, a body that is astray
begins anew.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from marker_scene import degrees_apart, scene

from habitus.fit.markers.live import Quality, QualityLimits, marker_tracker
from habitus.fit.markers.settings import MoshSettings

RATE = 30.0


@pytest.fixture
def s():
    return scene(frames=90)


def tracker(s, exchanged=(), misplaced=()):
    prior = s.prior
    subject = SimpleNamespace(
        prior=prior,
        rig=s.rig,
        shape=SimpleNamespace(pose=s.pose[::6]),
        exchanged=exchanged,
        misplaced=misplaced,
    )
    return marker_tracker(subject, MoshSettings(), RATE)


def follow(s, **told):
    following = tracker(s, **told)
    return [following.step(markers) for markers in s.observed]


def test_somebody_who_is_there_is_followed(s):
    frames = follow(s)
    assert [frame.state for frame in frames] == ["started"] + ["tracked"] * 89
    assert degrees_apart(np.array([f.pose for f in frames]), s.pose) < 5.0
    assert max(np.nanmax(frame.distances) for frame in frames) < 0.02


def test_a_rehearsal_changes_nothing(s):
    following = tracker(s)
    frames = follow(s)
    following.rehearse()
    for frame, markers in zip(frames, s.observed, strict=True):
        found = following.step(markers)
        following.rehearse()
        np.testing.assert_array_equal(found.pose, frame.pose)


def test_who_leaves_is_let_go_and_who_returns_is_found_elsewhere(s):
    s.observed[20:50] = np.nan
    s.observed[50:] += (3.0, 0.0, -2.0)
    frames = follow(s)
    states = [frame.state for frame in frames]
    assert (
        states[20:35] == ["held"] * 15
        and states[35:50] == ["nobody"] * 15
        and states[50] == "started"
    )
    assert all(np.isnan(frame.pose).all() for frame in frames[35:50])
    assert max(np.nanmax(frame.distances) for frame in frames[50:]) < 0.02


def test_somebody_of_whom_few_markers_show_is_waited_for_a_moment(s):
    s.observed[:, 6:] = np.nan
    states = [frame.state for frame in follow(s)]
    assert (
        states[:5] == ["nobody"] * 5 and states[5] == "started" and set(states[6:]) == {"tracked"}
    )


def test_a_body_that_is_astray_begins_anew(s):
    following = tracker(s)
    following.step(s.observed[0])
    turned = s.observed.copy()
    turned[..., :2] = np.stack(
        [-turned[..., 1], turned[..., 0]], axis=-1
    )  # a quarter turn within a frame
    turned[..., 0] += 4.0
    frames = [following.step(markers) for markers in turned[1:]]
    assert np.nanmedian(frames[-1].distances) < 0.01


def test_labels_that_are_exchanged_and_markers_that_are_misplaced_are_known(s):
    s.observed[:, [2, 5]] = s.observed[:, [5, 2]]
    s.observed[:, 7] += 0.5
    frames = follow(s, exchanged=((2, 5),), misplaced=(7,))
    assert max(np.nanmax(frame.distances) for frame in frames) < 0.02
    assert np.isnan(frames[9].distances[7])


def test_quality_tells_what_is_wrong_and_nothing_else(s):
    limits = QualityLimits.of_markers(MoshSettings())
    quality = Quality(tuple(f"m{k}" for k in range(25)), RATE, limits)
    assert quality.verdict.level == "failed"
    s.observed[60:, 3] += (0.0, 0.4, 0.0)
    for k, frame in enumerate(follow(s)):
        quality.add(frame)
        if k == 59:
            assert quality.verdict.level == "good" and quality.seen == 25 and quality.mean_mm < 5
    assert (
        quality.verdict.level != "good"
        and "m3" in str(quality.verdict)
        and "m4 " not in str(quality.verdict)
    )
