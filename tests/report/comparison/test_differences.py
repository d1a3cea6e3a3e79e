"""Two motions are as far apart as one was made to differ from the other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_fit import synthetic_fit, tube_body

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError
from habitus.report.comparison.differences import Alignment, differences, notes, transformed
from habitus.report.comparison.numbers import numbers, worst_moments
from habitus.report.comparison.page import comparison_page

RATE = 60.0
TURN = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()


@pytest.fixture(scope="module")
def fit():
    return synthetic_fit(frames=60, rate_hz=RATE, body=tube_body(posedirs=True))


def cut(fit, rows, rate_hz=RATE):
    """The motion of some frames only."""
    soft = None if fit.soft_tissue is None else fit.soft_tissue[rows]
    return replace(
        BodyMotion.of(fit),
        pose=fit.pose[rows],
        trans=fit.trans[rows],
        soft_tissue=soft,
        rate_hz=rate_hz,
    )


def test_a_result_has_no_distance_from_itself(fit):
    found = differences(fit, fit)
    told = numbers(found, ("a", "b"))
    assert max(found.skin.max(), found.joints.max(), found.at_rest.max()) < 1e-9 and not notes(
        found
    )
    assert found.rotations.max() < 1e-5 and np.nanmax(found.markers.predicted) == 0
    assert (
        told["compared"]["moments"] == 60
        and told["joints_mm"]["per_joint"]["left_knee"]["max"] == 0
    )
    assert told["a"]["verdict"] == told["b"]["verdict"] and told["a"]["marker_error_mm"]["mean"] > 1


def test_a_step_aside_is_what_is_measured(fit):
    aside = replace(fit, trans=fit.trans + np.array([0.012, 0, 0.016]))
    found = differences(fit, aside)
    assert found.skin == pytest.approx(20.0) and found.joints == pytest.approx(20.0)
    assert (
        found.root_aligned == pytest.approx(0.0, abs=1e-9)
        and found.rotations.max() < 1e-5
        and found.at_rest.max() == 0
    )
    assert not found.alignment.reason


@pytest.mark.parametrize("soft", [True, False])
def test_a_motion_is_moved_as_a_whole(soft):
    fit = synthetic_fit(frames=4, soft=soft, body=tube_body(posedirs=True))
    place = Alignment(TURN, np.array([0.5, -2.0, 0.1]))
    other = transformed(fit, place, "+z")
    np.testing.assert_allclose(other.vertices(), place.apply(fit.vertices()), atol=1e-6)
    np.testing.assert_allclose(other.joints(), place.apply(fit.joints()), atol=1e-6)
    np.testing.assert_allclose(other.errors_mm, fit.errors_mm, atol=1e-6)


def test_another_world_frame_is_aligned_and_noted(fit):
    elsewhere = transformed(fit, Alignment(TURN, np.array([0.5, -2.0, 0.1])), "+z")
    found = differences(fit, elsewhere)
    assert found.skin.max() < 1e-2 and "rotation by" in notes(found)[0]
    assert found.alignment.degrees == pytest.approx(
        np.degrees(Rotation.from_matrix(TURN).magnitude()), abs=1e-3
    )
    plain = differences(fit, elsewhere, align="none")
    assert plain.joints.mean() > 300 and not any("rotation" in note for note in notes(plain))
    assert (
        "not the same moments" in notes(plain)[0] and not plain.same_moments and found.same_moments
    )
    told = numbers(plain, ("a", "b"))
    assert "class='banner failed'" in comparison_page(plain, told, ("a", "b"))
    same = comparison_page(found, numbers(found, ("a", "b")), ("a", "b"))
    assert "class='banner" not in same


def test_another_up_is_no_difference(fit):
    turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # z up to y up
    found = differences(
        BodyMotion.of(fit),
        transformed(BodyMotion.of(fit), Alignment(turn, np.zeros(3)), "+y"),
        align="none",
    )
    assert found.skin.max() < 1e-2 and "+z is up" in notes(found)[0]


@pytest.mark.parametrize("swap", [False, True])
def test_rates_and_ranges_are_told(fit, swap):
    half = cut(fit, slice(0, 40, 2), RATE / 2)
    found = differences(*((half, fit) if swap else (fit, half)))
    assert len(found.pairing.times) == 20 and found.skin.max() < 1e-6
    said = " ".join(notes(found))
    assert (
        "60" in said
        and "30" in said
        and "0.67 s are compared" in said
        and "interpolated" not in said
    )


def test_between_frames_the_faster_one_is_interpolated(fit):
    slow = synthetic_fit(
        frames=38, rate_hz=38.0, body=tube_body(posedirs=True), soft=False
    )  # the same walk, sampled anew
    fast = synthetic_fit(frames=60, rate_hz=60.0, body=tube_body(posedirs=True), soft=False)
    found = differences(BodyMotion.of(slow), BodyMotion.of(fast))
    assert (
        found.skin.max() < 2.0 and "interpolated" in notes(found)[0]
    )  # a foot's acceleration times dt²/8


def test_an_offset_brings_moments_together(fit):
    later = cut(fit, slice(12, None))
    assert differences(fit, later).skin.mean() > 20
    found = differences(fit, later, offset=12 / RATE)
    assert (
        found.skin.max() < 1e-6
        and found.pairing.times[0] == pytest.approx(0.2)
        and len(found.pairing.times) == 48
    )
    with pytest.raises(HabitusError, match="no moment in common"):
        differences(fit, later, offset=5.0)


def test_the_worst_moment_is_where_it_was_made(fit):
    pose = fit.pose.copy()
    joint = fit.body.joint_names.index("right_knee")
    pose[40:44, joint] += [0.2, 0, 0]
    found = differences(fit, replace(fit, pose=pose))
    worst = worst_moments(found)
    assert 40 <= worst[0]["frame_a"] < 44 and worst[0]["worst_joint"] in (
        "right_ankle",
        "right_foot",
    )
    assert (
        found.rotations[41, joint] == pytest.approx(np.degrees(0.2), abs=1e-3) and len(worst) == 1
    )
    assert np.delete(found.rotations[41], joint).max() < 1e-5


def test_other_meshes_are_compared_by_joints_and_markers(fit):
    body = tube_body(posedirs=True)
    other = replace(
        fit, body=replace(body, faces=body.faces[:, [1, 2, 0]], name="others"), body_name="others"
    )
    found = differences(fit, other)
    assert (
        found.skin is found.at_rest is None
        and found.joints.max() < 1e-6
        and found.markers is not None
    )
    assert found.distance.max() < 1e-6 and "different meshes (tubes, others)" in notes(found)[0]
    told = numbers(found, ("a", "b"))
    assert told["skin_mm"] is None and not told["compared"]["skin"] and told["worst_moments"]


def test_what_cannot_be_compared(fit):
    names = tuple(f"bone{k}" for k in range(24))
    with pytest.raises(HabitusError, match="share 0 joints"):
        differences(fit, replace(fit, body=replace(fit.body, joint_names=names)))
    with pytest.raises(HabitusError, match="align is 'so'"):
        differences(fit, fit, align="so")
    with pytest.raises(HabitusError, match="offset is nan"):
        differences(fit, fit, offset=float("nan"))
