"""Which points are markers, and whose: names, copies, pieces and subjects."""

from pathlib import Path

import numpy as np
import pytest
from mannequin import LABELS, world_points, write_raw_c3d

from habitus.errors import HabitusError
from habitus.io.captures.people import computed_labels, is_unlabelled, split_subjects
from habitus.io.captures.read import Capture, read_capture, read_captures


def _read(folder: Path, labels: tuple[str, ...], points: np.ndarray, **options: object) -> Capture:
    return read_capture(write_raw_c3d(folder / "a.c3d", labels, points * 1e3, **options))


def _with(extra: dict[str, np.ndarray]) -> tuple[tuple[str, ...], np.ndarray]:
    return (*LABELS, *extra), np.concatenate(
        [world_points(), np.stack(list(extra.values()), axis=1)], axis=1
    )


@pytest.mark.parametrize(
    "label",
    [
        "*",
        "*12",
        "uname*4",
        "uname4",
        "U_1",
        "u12",
        "Unlabeled_1023",
        "unlabeled",
        "Unlabelled12",
        "New_0001",
        "17",
    ],
)
@pytest.mark.parametrize(
    "more",
    ["", "Unknown_3", "ghost", "nan", "M012", "C_12", "h00b03m1", "Marker_1", "Trajectory_12"],
)
def test_fillers_are_no_names(label: str, more: str) -> None:
    assert is_unlabelled(label) and is_unlabelled(more)


@pytest.mark.parametrize(
    "label",
    [*LABELS, "MAN", "NAV", "M1TH", "U_ELB", "C7", "MT5", "LMT1", "POINTER", "Chest", "UA1", "T10"],
)
def test_names_are_no_fillers(label: str) -> None:
    assert not is_unlabelled(label)


def test_computed_names_are_told_from_markers_that_look_like_them() -> None:
    computed = (
        "LHipAngles LAbsAnkleAngle PELAng LNormalisedGRF LKneePower CentreOfMass "
        "CentreOfMassFloor CoM LHJC"
    )
    computed += (
        " R_HJC_reg RGHJC PELVIS_CGM_2.4O LHJC_CGM_2.4 R.Ankle_projection mid_hip "
        "projLKAX R.HipJoint"
    )
    computed += " LKneeGround SolvingHips Xglobal"
    labels = (*computed.split(), *LABELS)
    assert set(computed_labels(labels, {})) == set(computed.split())
    # RANG is a scapula's tip, LIndex a finger; PELA..D a plate; LTIB1 a cluster; RFTA..D a foot;
    # KAX a rod with its KD1
    markers = (
        "RANG LIndex RIndex PELA PELB PELC PELD LTIB1 LTIB2 LTIB3 LHLX RFTA RFTB LKAX LKD1 "
        "LKD2 LANK LHIP"
    )
    markers += " C_7__IOR_CV7__CGM_C7"
    assert computed_labels(tuple(markers.split()), {}) == {}


def test_names_that_are_computed_only_in_company() -> None:
    bones = tuple(f"{bone}{letter}" for bone in ("HED", "PEL", "LFE", "RTO") for letter in "OALP")
    assert set(computed_labels((*bones, *LABELS), {})) == set(bones)
    oxford = ("LHDF0", "LTIB1", "LTIB2", "LHLX1", "RFOF3", "LANK1")
    assert set(computed_labels((*oxford, "LHLX", *LABELS), {})) == set(oxford)
    copies = ("LKAX", "MIHD", "JUG", "r.ASIS_study")
    assert set(computed_labels((*copies, "r.ASIS", *LABELS), {})) == set(copies)
    assert set(computed_labels(("LFTA", *LABELS), {})) == {"LFTA"}
    skeleton = ("Hips", "Spine", "Neck", "Head", "LeftArm", "LeftHand", "RightArm", "RightHand")
    assert set(computed_labels((*skeleton, *LABELS), {})) == set(skeleton)
    assert computed_labels(("Head", "Neck", *LABELS), {}) == {}


def test_keypoints_of_video_go_where_the_predicted_markers_stay() -> None:
    predicted = (
        "C7_study",
        "r_shoulder_study",
        "L_shoulder_study",
        "r.ASIS_study",
        "L.ASIS_study",
        "r_knee_study",
    )
    keypoints = ("Neck", "RShoulder", "midHip", "LBigToe", "RHJC_study")
    assert set(computed_labels((*keypoints, *predicted), {})) == set(keypoints)
    assert computed_labels(("RShoulder", "LShoulder", "LHeel", *LABELS), {}) == {}


def test_what_the_file_declares_is_believed_first(tmp_path: Path) -> None:
    angle = np.random.default_rng(0).normal(scale=0.03, size=(60, 3))
    labels, points = _with({"ODD1": angle, "ODD2": angle + 0.01, "ODD3": angle - 0.02})
    groups = {
        ("POINT", "ANGLES"): ["ODD1"],
        ("POINT", "POWERS2"): ["ODD2"],
        ("POINT", "TYPE_GROUPS"): ["OWN", "own"],
    }
    groups |= {("POINT", "POWERS"): [], ("POINT", "OWN"): ["ODD3"]}
    capture = _read(
        tmp_path,
        labels,
        points,
        parameters={key: value or ["none"] for key, value in groups.items()},
    )
    assert capture.labels == LABELS
    assert {label: reason.split()[-1] for label, reason in capture.dropped} == {
        "ODD1": "ANGLES",
        "ODD2": "POWERS",
        "ODD3": "OWN",
    }


def test_copies_midpoints_and_strangers_are_found_by_value(tmp_path: Path) -> None:
    points = world_points()
    prop = np.stack([np.linspace(-3, 3, 60), np.full(60, 1.0), np.linspace(0.5, 2.5, 60)], axis=1)
    extra = {
        "XX": points[:, 4],
        "HEADMID": (points[:, 0] + points[:, 18]) / 2,
        "SHIELD": prop,
        "ZERO": np.zeros((60, 3)),
        "NEVER": np.full((60, 3), np.nan),
    }
    capture = _read(tmp_path, *_with(extra))
    reasons = dict(capture.dropped)
    assert capture.labels == LABELS and set(reasons) == set(extra)
    assert "copy of LELB" in reasons["XX"] and "midpoint of LFHD and RFHD" in reasons["HEADMID"]
    assert "no other point" in reasons["SHIELD"] and "never visible" in reasons["ZERO"]


def test_a_copy_goes_before_the_marker_it_copies(tmp_path: Path) -> None:
    """The copies of HDM files come first: *0 and others; the one whose name says where it is
    stays.
    """
    points = world_points()
    labels = ("ORIGIN", "*0", *LABELS)
    capture = _read(
        tmp_path, labels, np.concatenate([points[:, 9:10], points[:, :1], points], axis=1)
    )
    assert capture.labels == LABELS
    assert dict(capture.dropped) == {"*0": "unlabelled", "ORIGIN": "an exact copy of LFWT"}


def test_rigid_segments_of_a_solver_stay(tmp_path: Path) -> None:
    """A head, pelvis and trunk that a solver has made rigid are markers still."""
    points = world_points()
    sway = points.mean(axis=1, keepdims=True) - points[:1].mean(axis=1, keepdims=True)
    assert _read(tmp_path, LABELS, points[:1] + sway).labels == LABELS


def test_a_stuck_point_is_missing_while_its_neighbours_move(tmp_path: Path) -> None:
    points = world_points()
    steps = np.linspace(0, 2, 60)[:, None] * (0.0, 1.0, 0.0)
    points = points + steps[:, None]
    points[20:45, 3] = points[20, 3]
    points[:, 7] = points[0, 7]
    capture = _read(tmp_path, LABELS, points)
    assert dict(capture.dropped) == {LABELS[7]: "never moves while the others do"}
    column = capture.labels.index(LABELS[3])
    assert np.isnan(capture.markers[20:45, column]).all()
    assert (
        np.isfinite(capture.markers[:20, column]).all()
        and np.isfinite(capture.markers[46:, column]).all()
    )
    assert np.isfinite(np.delete(capture.markers, column, axis=1)).all()


def test_who_stands_still_is_not_stuck(tmp_path: Path) -> None:
    still = np.repeat(world_points()[:1], 60, axis=0)
    capture = _read(tmp_path, LABELS, still)
    assert capture.labels == LABELS and np.isfinite(capture.markers).all()


def test_pieces_of_a_marker_join_and_others_stay_apart(tmp_path: Path) -> None:
    points = world_points()
    early = points[:, 40].copy()
    late = points[:, 40].copy()
    early[30:], late[:30] = np.nan, np.nan
    labels = (*LABELS[:40], "RBAC-1", "RBAC", "LELB", "LUPA_2")
    other = points[:, 4] + (0.1, 0.0, 0.0)
    cluster = points[:, 3] + (0.0, 0.06, 0.0)
    stacked = [points[:, :40], late[:, None], early[:, None], other[:, None], cluster[:, None]]
    capture = _read(tmp_path, labels, np.concatenate(stacked, axis=1))
    assert set(capture.labels) == {*LABELS, "LELB_2", "LUPA_2"}
    np.testing.assert_allclose(
        capture.markers[:, capture.labels.index("RBAC")], points[:, 40], atol=1e-6
    )
    assert any("LELB" in warning for warning in capture.warnings)


def test_the_second_knee_of_old_files_is_the_joint(tmp_path: Path) -> None:
    points = world_points()
    inner = points[:, 12] + (0.0, 0.05, 0.0)
    capture = _read(tmp_path, (*LABELS, "LKNE"), np.concatenate([points, inner[:, None]], axis=1))
    assert capture.labels == LABELS and "joint" in dict(capture.dropped)["LKNE"]


@pytest.mark.parametrize(
    "prefix", ["Ann:", "Subject 8:", "Karlie_", "251112_KUO_", "Q_", "T3_671_"]
)
def test_a_subjects_prefix_is_taken_off(tmp_path: Path, prefix: str) -> None:
    capture = _read(tmp_path, tuple(prefix + label for label in LABELS), world_points())
    assert capture.labels == LABELS
    assert capture.subject == (None if prefix == "Q_" else prefix.rstrip(":_"))


@pytest.mark.parametrize(
    "labels",
    [("R_IAS", "R_IPS", "R_FTC", "R_FLE", "R_FME", "R_FAX", "R_TTC", "R_FAL", "R_TAM", "R_FCC")],
)
def test_a_side_is_no_subject(labels: tuple[str, ...]) -> None:
    (owner,) = split_subjects(labels)
    assert owner.labels == labels and owner.name is None
    both = tuple(f"{side}{label[1:]}" for side in "LR" for label in labels)
    assert [o.labels for o in split_subjects(both)] == [both]
    anonymous = tuple(f"Marker_{i}" for i in range(20))
    assert split_subjects(anonymous)[0].labels == anonymous
    combined = tuple(f"{label}__IOR_{label}" for label in labels)
    assert split_subjects(combined)[0].labels == combined


@pytest.mark.parametrize("separator", [":", "_"])
def test_people_of_one_file_are_told_apart_and_props_left_out(
    tmp_path: Path, separator: str
) -> None:
    ann = world_points()
    ben = world_points(seed=5) + np.array([0.0, 1.5, 0.0])
    labels = tuple(f"{name}{separator}{label}" for name in ("Ann", "Ben") for label in LABELS)
    points = np.concatenate([ann, ben[:, ::-1]], axis=1)
    labels = (*labels[:41], *labels[:40:-1])
    if separator == ":":
        labels = (*labels, "Sword:tip", "Sword:hilt", "*7")
        points = np.concatenate([points, ann[:, :3] + 0.4], axis=1)
    path = write_raw_c3d(tmp_path / "two.c3d", labels, points * 1e3)
    captures = read_captures(path)
    assert [capture.subject for capture in captures] == ["Ann", "Ben"]
    np.testing.assert_allclose(captures[1].markers, ben[:, ::-1], atol=1e-6)
    first = read_capture(path)
    assert first.subject == "Ann" and "2 subjects" in first.warnings[-1]
    assert read_capture(path, subject="ben").labels == LABELS[::-1]
    with pytest.raises(HabitusError, match="Ann, Ben"):
        read_capture(path, subject="Cleo")


def test_nameless_markers_are_kept_where_there_is_nothing_else(tmp_path: Path) -> None:
    capture = _read(tmp_path, tuple(f"*{i}" for i in range(41)), world_points())
    assert len(capture.labels) == 41 and any("anonymous" in warning for warning in capture.warnings)


def test_a_file_of_computed_points_only_says_so(tmp_path: Path) -> None:
    labels = tuple(f"{bone}{letter}" for bone in ("HED", "PEL", "LFE", "RTO") for letter in "OALP")
    with pytest.raises(HabitusError, match="computed"):
        _read(tmp_path, labels, world_points()[:, :16])


def test_a_capture_prints_as_one_line():
    labels = tuple(f"M{k}" for k in range(41))
    markers = np.zeros((4499, 41, 3))
    said = repr(Capture("85_12", labels, markers, 120.0, "+y", "B\x1bob", ("odd",)))
    assert len(said) < 120 and said.isprintable()
    for word in ("85_12", "4499", "41", "120", "+y", "1 warning"):
        assert word in said


@pytest.mark.parametrize("axis", range(3))
def test_a_marker_without_one_coordinate_is_missing(axis):
    markers = np.arange(18.0).reshape(2, 3, 3)
    markers[1, 2, axis] = np.nan
    capture = Capture("walk", ("A", "B", "C"), markers, 100.0, "+y")
    assert np.isnan(capture.markers[1, 2]).all() and np.isfinite(capture.markers[:, :2]).all()
    assert np.isfinite(markers[1, 2]).sum() == 2 and not capture.markers.flags.writeable
