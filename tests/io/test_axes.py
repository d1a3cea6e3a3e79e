"""Units, up-axis and handedness are asked of the body: whatever a file claims, the same person
comes out.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mannequin import LABELS, world_points, write_raw_c3d
from scipy.spatial.transform import Rotation

from habitus.io.captures.read import read_capture
from habitus.io.units import METRES, extent, find_axes, find_unit

UPS = ("+x", "-x", "+y", "-y", "+z", "-z")


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("claim", [None, "+z", "-z", "+y"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_the_body_tells_which_way_is_up_and_whether_it_is_mirrored(
    up: str, claim: str | None, mirrored: bool
) -> None:
    axes = find_axes(LABELS, world_points(up, mirrored=mirrored), claim, "+z")
    assert (axes.up, axes.sure, axes.mirrored) == (up, True, mirrored)


@given(turn=st.floats(0, 6.28), up=st.sampled_from(UPS), hidden=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_turning_about_up_and_losing_markers_changes_nothing(
    turn: float, up: str, hidden: int
) -> None:
    axis = np.eye(3)["xyz".index(up[1])]
    points = world_points(up, frames=20) @ Rotation.from_rotvec(turn * axis).as_matrix().T
    points[np.random.default_rng(hidden).random(points.shape[:2]) < 0.3] = np.nan
    axes = find_axes(LABELS, points, None, "+z")
    assert (axes.up, axes.mirrored) == (up, False)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("claim", [None, "wrong"])
def test_who_lies_on_the_floor_lies_on_the_floor(up: str, side: float, claim: str | None) -> None:
    """On the back or on the belly for the whole capture, head towards a horizontal axis or its
    opposite.
    """
    points = world_points(up)
    i = "xyz".index(up[1])
    across = np.eye(3)[(i + 2) % 3]
    points = points @ Rotation.from_rotvec(side * np.pi / 2 * across).as_matrix().T
    height = np.eye(3)[i] * (1.0 if up[0] == "+" else -1.0)
    points += (
        height * (0.02 - (points @ height).min()) + np.eye(3)[(i + 1) % 3] * 3.0 + across * 1.5
    )
    wrong = {"+x": "-x", "-x": "+x", "+y": "-y", "-y": "+y", "+z": "-z", "-z": "+z"}[up]
    axes = find_axes(LABELS, points, wrong if claim else None, "+z")
    assert (axes.up, axes.mirrored) == (up, False)


def test_a_few_frames_on_the_floor_do_not_turn_the_world() -> None:
    points = world_points("+z", frames=100)
    points[60:] = points[60:, :, [2, 1, 0]] * (1.0, 1.0, -0.1) + (0.0, 0.0, 0.3)
    assert find_axes(LABELS, points, None, "+y").up == "+z"


def test_the_files_word_or_the_formats_custom_stands_where_the_body_says_nothing() -> None:
    labels = ("A1", "B2", "C3")
    points = np.random.default_rng(0).normal(size=(30, 3, 3)) + 5.0
    assert find_axes(labels, points, "+x", "+z").up == "+x"
    assert find_axes(labels, points, None, "+y").up == "+y"
    assert not find_axes(labels, points, None, "+y").sure


def test_an_anonymous_body_upright_on_a_floor_tells_up() -> None:
    labels = tuple(f"M{i}" for i in range(41))
    points = world_points("+x") + np.array([0.0, 0.0, 1.5])
    assert find_axes(labels, points, "+z", "+z").up == "+x"


@pytest.mark.parametrize("true", ["mm", "cm", "m"])
@pytest.mark.parametrize("claimed", ["mm", "cm", "m", "Millimeters", "", "furlongs"])
def test_a_person_has_the_size_of_a_person(tmp_path: Path, true: str, claimed: str) -> None:
    """A 1.7 mm or 1700 m person is set right, with a warning that says so; a true claim makes
    none.
    """
    path = write_raw_c3d(
        tmp_path / "a.c3d", LABELS, world_points() / METRES[true], unit=claimed or None
    )
    capture = read_capture(path)
    assert capture.unit == true
    np.testing.assert_allclose(capture.markers, world_points(), atol=1e-6)
    warned = [warning for warning in capture.warnings if "which is used" in warning]
    assert len(warned) == (0 if claimed in (true, {"mm": "Millimeters"}.get(true)) else 1)
    if warned and claimed in METRES:
        assert f"says {claimed}" in warned[0]


def test_small_sets_keep_the_files_unit() -> None:
    hand = np.random.default_rng(0).normal(scale=0.05, size=(20, 8, 3))
    labels = tuple(f"F{i}" for i in range(8))
    for unit in ("mm", "cm", "m"):
        assert find_unit(labels, hand / METRES[unit], unit) == (unit, None)


def test_extent_is_that_of_the_body_not_of_a_ghost() -> None:
    points = world_points()
    ghost = np.concatenate([points, points[:, :1] + 40.0], axis=1)
    assert extent(ghost) == pytest.approx(extent(points), rel=0.1)


@pytest.mark.parametrize("up", ["+y", "+z"])
def test_a_mirrored_capture_is_mirrored_back_and_says_so(tmp_path: Path, up: str) -> None:
    path = write_raw_c3d(tmp_path / "a.c3d", LABELS, world_points(up, mirrored=True) * 1e3)
    capture = read_capture(path)
    assert any("mirrored" in warning for warning in capture.warnings)
    again = find_axes(capture.labels, capture.markers, None, up)
    assert (again.up, again.mirrored) == (up, False)
    distances = [
        np.linalg.norm(p[:, :, None] - p[:, None], axis=3)
        for p in (capture.markers, world_points(up))
    ]
    np.testing.assert_allclose(distances[0], distances[1], atol=1e-6)


def test_real_captures_turned_mirrored_and_rescaled_come_out_alike(
    shared: Path, tmp_path: Path
) -> None:
    """Every real capture, in another file's axes and unit, gives the same up-axis, handedness and
    distances.
    """
    for source in sorted((shared / "mocap").glob("*.c3d")):
        capture = read_capture(source)
        points = capture.markers[:: max(1, len(capture.markers) // 50)]
        turned = (
            points[..., [1, 2, 0]] * np.array([1.0, 1.0, -1.0]) * 1000.0
        )  # mirrored by the odd sign
        path = write_raw_c3d(tmp_path / "b.c3d", capture.labels, turned, unit="m")
        again = read_capture(path)
        before = "xyz".index(capture.up_axis[1])
        place = [1, 2, 0].index(before)
        assert again.up_axis == f"{'-' if place == 2 else '+'}{'xyz'[place]}", source.name
        assert any("mirrored" in warning for warning in again.warnings), source.name
        assert again.unit == "mm" and set(again.labels) <= set(capture.labels)
        both = [capture.labels.index(label) for label in again.labels]
        spans = [
            np.linalg.norm(p[:, 1:] - p[:, :1], axis=2) for p in (again.markers, points[:, both])
        ]
        np.testing.assert_allclose(spans[0], spans[1], atol=1e-5)
