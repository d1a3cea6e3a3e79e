"""Captures below a folder: which are found, where their results go, which are taken for one
subject's.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

from habitus.errors import HabitusError
from habitus.export.trc import write_trc
from habitus.io.captures.read import Capture, read_capture
from habitus.io.captures.trc import is_fit_export
from habitus.jobs.finding import CaptureFile, MarkerSet, find_captures, grouped


def touched(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def places(found: list[CaptureFile]) -> list[str]:
    return [str(one.place / one.name) for one in found]


def test_captures_are_found_as_deep_as_they_lie(tmp_path):
    names = [
        "b/two.C3D",
        "b/one.trc",
        "a.c3d",
        "b/deep/three.npz",
        "b/readme.txt",
        ".x.c3d",
        ".git/d.c3d",
    ]
    data = touched(
        tmp_path / "data",
        *names,
        "out/old/a.c3d",
        "results/walk/body.npz",
        "results/walk/metrics.json",
    )
    found = find_captures([data], data / "out")
    assert places(found) == ["a", "b/one", "b/two", "b/deep/three"] and not any(
        one.given for one in found
    )


def test_files_that_differ_in_their_endings_get_folders_of_their_own(tmp_path):
    data = touched(tmp_path, "walk.c3d", "walk.trc", "run.c3d")
    assert places(find_captures([data], tmp_path / "out")) == ["run", "walk_c3d", "walk_trc"]


def test_results_may_go_where_a_link_leads_to_itself(tmp_path):
    data = touched(tmp_path / "data", "walk.c3d", "deep/run.c3d")
    (tmp_path / "out").symlink_to("out")
    assert places(find_captures([data], tmp_path / "out")) == ["walk", "deep/run"]


def test_two_folders_keep_their_names(tmp_path):
    data = touched(tmp_path, "a/walk.c3d", "b/walk.c3d", "walk.c3d")
    found = find_captures([data / "a", data / "b", data / "walk.c3d"], tmp_path / "out")
    assert places(found) == ["a/walk", "b/walk", "walk"] and [one.given for one in found] == [
        False,
        False,
        True,
    ]


def test_names_that_would_meet_and_folders_without_captures_are_refused(tmp_path):
    data = touched(tmp_path, "a/walk.c3d", "b/walk.c3d", "empty/notes.txt")
    with pytest.raises(HabitusError, match="several captures are called walk"):
        find_captures([data / "a" / "walk.c3d", data / "b" / "walk.c3d"], tmp_path / "out")
    assert places(find_captures([data / "a", data / "b" / "walk.c3d"], tmp_path / "out")) == [
        "walk_c3d",
        "walk",
    ]
    with pytest.raises(HabitusError, match="no capture in this folder"):
        find_captures([data / "empty"], tmp_path / "out")


def test_real_captures_are_grouped_by_who_wears_which_markers(shared):
    """One folder with captures of nine people, three of whom come twice or more; generic names tell
    nobody apart.
    """
    mocap = shared / "mocap"
    names = (
        "85_02 HC030A05 HC030A22 HC042A13 HC042A40 RoboStatic Running_0002 right_knee "
        "right_hip testsample testsample2"
    )
    worn = [
        (
            CaptureFile(mocap / f"{name}.c3d", Path(), name, False),
            MarkerSet.of(read_capture(mocap / f"{name}.c3d")),
        )
        for name in names.split()
    ]
    found = {tuple(one.name for one in group) for group in grouped(worn)}
    several = {("HC030A05", "HC030A22"), ("HC042A13", "HC042A40"), ("testsample", "testsample2")}
    assert found == {
        *several,
        ("right_knee", "right_hip"),
        ("85_02",),
        ("RoboStatic",),
        ("Running_0002",),
    }
    nameless = [(one, replace(seen, subject=None)) for one, seen in worn]
    assert {tuple(one.name for one in group) for group in grouped(nameless)} == found


def rigid(scale=1.0, subject=None, noise=0.0, labels=12, seed=0) -> MarkerSet:
    rng = np.random.default_rng(seed)
    markers = scale * rng.uniform(0, 0.3, (1, labels, 3)) + rng.normal(size=(30, 1, 3))
    markers = markers + noise * rng.normal(size=markers.shape)
    return MarkerSet.of(
        Capture("x", tuple(f"M{k}" for k in range(labels)), markers, 100.0, "+y", subject)
    )


def test_what_makes_two_captures_alike():
    one = rigid()
    assert one.matches(rigid(noise=1e-3)) and one.matches(rigid(scale=1.01))
    assert (
        not one.matches(rigid(scale=1.06))
        and not one.matches(rigid(seed=1))
        and not one.matches(rigid(subject="Ann"))
    )
    assert not one.matches(rigid(noise=0.06))  # nothing keeps its distance: nothing is known
    assert not rigid(labels=5).matches(rigid(labels=5))


def test_a_pose_that_is_held_tells_nothing_of_a_person():
    """Two segments of six markers each, 1 m apart, and 0.9 m apart in the other capture."""
    rng = np.random.default_rng(0)
    segments = rng.uniform(0, 0.2, (2, 6, 3))
    sets = []
    for apart in (1.0, 0.9):
        markers = np.concatenate([segments[0], segments[1] + [apart, 0.0, 0.0]])
        held = np.repeat(markers[None], 30, axis=0)
        sets.append(
            MarkerSet.of(Capture("x", tuple(f"M{k}" for k in range(12)), held, 100.0, "+y"))
        )
    assert sets[0].matches(sets[1])


def test_a_file_of_several_people_and_captures_of_other_folders_stay_alone(tmp_path):
    one = rigid()
    found = [
        CaptureFile(tmp_path / name, Path(), name, False) for name in ("a/1", "a/2", "b/3", "a/4")
    ]
    groups = grouped(list(zip(found, (one, None, one, one), strict=True)))
    assert [[f.name for f in group] for group in groups] == [["a/1", "a/4"], ["a/2"], ["b/3"]]


def test_gaps_do_not_hide_what_is_rigid():
    one = rigid()
    rng = np.random.default_rng(3)
    markers = rng.uniform(0, 0.3, (1, 12, 3)) + np.zeros((30, 1, 1))
    holed = np.where(rng.random((30, 12, 1)) < 0.4, np.nan, markers)
    capture = Capture("x", tuple(f"M{k}" for k in range(12)), holed, 100.0, "+y")
    whole = replace(capture, markers=np.array(markers))
    np.testing.assert_allclose(MarkerSet.of(capture).rigid, MarkerSet.of(whole).rigid, atol=1e-12)
    assert not MarkerSet.of(capture).matches(one) and MarkerSet.of(capture).matches(
        MarkerSet.of(whole)
    )


def test_what_habitus_exported_is_no_capture(tmp_path):
    """A TRC of a fit beside its capture; the capture's results keep their name."""
    data = touched(tmp_path / "data", "walk.c3d", "other.trc")
    fit = synthetic_fit(5)
    fit.export(data / "walk.trc")
    found = find_captures([data], tmp_path / "out")
    assert [(one.path.name, one.exported) for one in found] == [
        ("other.trc", False),
        ("walk.c3d", False),
        ("walk.trc", True),
    ]
    assert places(found[:2]) == ["other", "walk"]
    (given,) = find_captures([data / "walk.trc"], tmp_path / "out")
    assert not given.exported and given.name == "walk"
    capture = read_capture(data / "walk.trc")  # named by itself it is read as before
    assert set(fit.body.joint_names) <= {label.removesuffix("_joint") for label in capture.labels}
    write_trc(capture, data / "again.trc")  # a capture that was written is one
    assert not is_fit_export(data / "again.trc")
