"""C3D files, real and odd: what is in them comes out, and nothing brings the reader down."""

import time
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from mannequin import LABELS, RECORDED, world_points, write_raw_c3d

from habitus.errors import HabitusError
from habitus.io.captures.c3d import parse_c3d
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_capture, read_captures
from habitus.parallel import blocks

# file -> (markers, unit, up, rate, what the file records of the person)
REAL = {
    "85_02.c3d": (41, "mm", "+z", 120.0, {}),
    "85_12.c3d": (41, "mm", "+z", 120.0, {}),
    "HDM_mm_01-02_03_120.c3d": (41, "mm", "+z", 120.0, {}),
    "HC030A01.c3d": (
        65,
        "mm",
        "+z",
        100.0,
        {"height_m": 1.48, "mass_kg": 45.8, "marker_diameter_m": 0.01},
    ),
    "HC030A05.c3d": (
        59,
        "mm",
        "+z",
        100.0,
        {"height_m": 1.48, "mass_kg": 45.8, "marker_diameter_m": 0.01},
    ),
    "HC030A22.c3d": (
        59,
        "mm",
        "+z",
        100.0,
        {"height_m": 1.48, "mass_kg": 45.8, "marker_diameter_m": 0.01},
    ),
    "HC042A13.c3d": (
        59,
        "mm",
        "+z",
        100.0,
        {"height_m": 1.79, "mass_kg": 59.9, "marker_diameter_m": 0.01},
    ),
    "HC042A40.c3d": (
        59,
        "mm",
        "+z",
        100.0,
        {"height_m": 1.79, "mass_kg": 59.9, "marker_diameter_m": 0.01},
    ),
    "testsample.c3d": (41, "mm", "+z", 100.0, {"height_m": 1.735, "mass_kg": 85.8}),
    "testsample2.c3d": (41, "mm", "+z", 100.0, {"height_m": 1.735, "mass_kg": 85.8}),
    "kinematics_tennis_serve.c3d": (39, "m", "+z", 50.0, {}),
    "anat_pose_ECH.c3d": (73, "mm", "+z", 100.0, {}),
    "right_hip.c3d": (73, "mm", "+z", 100.0, {}),
    "right_knee.c3d": (73, "mm", "+z", 100.0, {}),
    "static_rotated.c3d": (49, "mm", "+y", 100.0, {}),
    "Running_0002.c3d": (64, "mm", "+z", 200.0, {}),
    "nick_freeform_001.c3d": (52, "mm", "+y", 120.0, {}),  # 53 less CLAV, which no frame shows
}

# odd file -> markers, or a word of the one line that says what is wrong
ODD = {
    "1123x01EMG.c3d": "0 points",
    "BKINtechnologies.c3d": 2,
    "C3DRotationExample.c3d": "21 segment rotations",
    "Dance.c3d": 40,
    "Eb015si.c3d": 26,
    "Eb015sr.c3d": 26,
    "Empty.c3d": "empty",
    "Facial-Sing.c3d": 37,
    "MACsample.c3d": 25,
    "MotionMonitorC3D.c3d": 8,
    "Optotrak.c3d": 52,
    "Res16bits.c3d": 44,
    "Walking_Hybrid_2.c3d": 25,
    "badParameterOffset.c3d": 39,
    "bad_parameter_section.c3d": 27,
    "dec_int.c3d": 36,
    "dec_real.c3d": 36,
    "duplicate_labels.c3d": 22,
    "emgwl.c3d": "0 points",
    "golfswing.c3d": 29,
    "mocap36.c3d": 36,
    "parameterOverflow.c3d": "missing in all 101 frames",
    "phasespace_sample.c3d": 39,
    "sgi_int.c3d": 36,
    "sgi_real.c3d": 36,
    "short-copy.c3d": 36,
    "simple.c3d": "processor type",
    "type1.C3D": 28,
    "type2a.c3d": "0 points",
    "type3.c3d": 11,
}


@pytest.mark.parametrize("name", REAL)
def test_real_captures_give_their_physical_markers_in_metres(shared: Path, name: str) -> None:
    markers, unit, up, rate, recorded = REAL[name]
    capture = read_capture(shared / "mocap" / name)
    assert (len(capture.labels), capture.unit, capture.up_axis, capture.rate_hz) == (
        markers,
        unit,
        up,
        rate,
    )
    assert dict(capture.recorded) == recorded
    assert capture.markers.shape[1] == markers and capture.markers.dtype == np.float64
    assert len(set(capture.labels)) == markers and not any(":" in label for label in capture.labels)
    height = np.ptp(capture.markers[..., "xyz".index(up[1])][np.isfinite(capture.markers[..., 0])])
    assert 1.2 < height < 2.7


@pytest.mark.parametrize("name", REAL)
def test_points_are_those_of_ezc3d(shared: Path, name: str) -> None:
    path = shared / "mocap" / name
    peer = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_array_equal(parse_c3d(path.read_bytes(), name).points, peer)


@pytest.mark.parametrize("name", ODD)
def test_odd_files_give_a_capture_or_one_clear_line(shared: Path, name: str) -> None:
    expected = ODD[name]
    started = time.perf_counter()
    if isinstance(expected, int):
        assert len(read_capture(shared / "mocap-odd" / name).labels) == expected
    else:
        with pytest.raises(HabitusError, match=expected) as caught:
            read_capture(shared / "mocap-odd" / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    assert time.perf_counter() - started < 2.0


def test_one_walk_in_three_machines_numbers_is_one_walk(shared: Path) -> None:
    folder = shared / "mocap-odd"
    walks = [
        read_capture(folder / name)
        for name in ("dec_real.c3d", "sgi_real.c3d", "dec_int.c3d", "sgi_int.c3d")
    ]
    for walk in walks[1:]:
        assert walk.labels == walks[0].labels
        np.testing.assert_allclose(walk.markers, walks[0].markers, atol=3e-4)
    long = [read_capture(folder / name) for name in ("Eb015si.c3d", "Eb015sr.c3d")]
    np.testing.assert_allclose(long[0].markers, long[1].markers, atol=1e-4)


@pytest.mark.parametrize("name", ["type1.C3D", "type3.c3d"])
def test_trajectories_are_smooth_where_header_and_parameters_disagree(
    shared: Path, name: str
) -> None:
    markers = read_capture(shared / "mocap-odd" / name).markers
    steps = np.linalg.norm(np.diff(markers, axis=0), axis=2)
    assert np.nanpercentile(steps, 99) < 0.1


def test_a_long_capture_reads_in_well_under_a_second(shared: Path) -> None:
    started = time.perf_counter()
    capture = read_capture(shared / "mocap" / "85_12.c3d")
    assert capture.markers.shape == (4499, 41, 3)
    assert time.perf_counter() - started < 1.0


def _capture(frames: int = 40, up: str = "+z") -> Capture:
    markers = world_points(up, frames).astype(np.float32).astype(np.float64)
    markers[3:9, 5] = np.nan
    markers[0], markers[-1] = np.nan, np.nan
    return Capture("made", LABELS, markers, 120.0, up, "Ann", (), dict(RECORDED), (), "c3d", "mm")


@pytest.mark.parametrize("up", ["+z", "-z", "+y", "-y", "+x", "-x"])
def test_what_is_written_is_read_back(tmp_path: Path, up: str) -> None:
    capture = _capture(up=up)
    write_c3d(capture, tmp_path / "made.c3d")
    again = read_capture(tmp_path / "made.c3d")
    np.testing.assert_allclose(again.markers, capture.markers, atol=1e-6)
    assert replace(again, markers=capture.markers) == capture


def test_writing_is_whole_or_not_at_all(tmp_path: Path) -> None:
    write_c3d(_capture(), tmp_path / "made.C3D")
    assert [path.name for path in tmp_path.iterdir()] == ["made.C3D"]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"labels": (), "markers": np.empty((5, 0, 3))}, "0 markers"),
        ({"rate_hz": 0.0}, "0 Hz"),
        ({"rate_hz": float("nan")}, "nan Hz"),
        ({"labels": LABELS[:7]}, "7 labels"),
        ({"labels": tuple(label + "x" * 300 for label in LABELS)}, "letters"),
    ],
)
def test_what_c3d_cannot_hold_is_refused(tmp_path: Path, change: dict, word: str) -> None:
    with pytest.raises(HabitusError, match=word):
        write_c3d(replace(_capture(), **change), tmp_path / "none.c3d")
    assert not list(tmp_path.iterdir())


def test_more_labels_and_frames_than_sixteen_bits_hold(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    copies = [_capture().markers + generator.normal(scale=0.05, size=(1, 41, 3)) for _ in range(7)]
    wide = replace(_capture(), markers=np.concatenate(copies, axis=1))
    wide = replace(wide, labels=tuple(f"{label}x{i}" for i in range(7) for label in LABELS))
    write_c3d(wide, tmp_path / "wide.c3d")
    assert read_capture(tmp_path / "wide.c3d").labels == wide.labels
    long = replace(
        _capture(), labels=LABELS[:4], markers=np.tile(_capture().markers[1:-1, :4], (1850, 1, 1))
    )
    write_c3d(long, tmp_path / "long.c3d")
    assert len(read_capture(tmp_path / "long.c3d").markers) == len(long.markers) == 70300


def test_labels_and_points_need_not_be_as_many(tmp_path: Path) -> None:
    content = write_raw_c3d(tmp_path / "a.c3d", LABELS, world_points() * 1000.0).read_bytes()
    (tmp_path / "few.c3d").write_bytes(content.replace(b"\x02\x04\x29LFHD", b"\x02\x04\x28LFHD"))
    few = read_capture(tmp_path / "few.c3d")
    assert few.labels == LABELS[:-1] and ("*40", "unlabelled") in few.dropped
    assert any("41 points but 40 labels" in warning for warning in few.warnings)


def test_a_file_that_ends_early_gives_the_frames_it_has(tmp_path: Path) -> None:
    path = write_raw_c3d(tmp_path / "cut.c3d", LABELS, world_points() * 1000.0)
    whole = read_capture(path)
    path.write_bytes(path.read_bytes()[: -20 * 41 * 16])
    cut = read_capture(path)
    assert 35 <= len(cut.markers) < 60
    np.testing.assert_array_equal(cut.markers, whole.markers[: len(cut.markers)])
    assert any("ends early" in warning and "of 60 frames" in warning for warning in cut.warnings)


def test_numbers_that_are_no_trajectories_are_refused(tmp_path: Path) -> None:
    """What a header that tells the wrong layout makes of a file: points anywhere, in no order."""
    points = np.random.default_rng(0).normal(scale=500.0, size=(60, 41, 3))
    with pytest.raises(HabitusError, match="jump about"):
        read_capture(write_raw_c3d(tmp_path / "noise.c3d", LABELS, points))


def test_no_rate_is_asked_for_and_can_be_given(tmp_path: Path) -> None:
    path = write_raw_c3d(tmp_path / "slow.c3d", LABELS, world_points() * 1000.0, rate=123.5)
    path.write_bytes(path.read_bytes().replace(np.float32(123.5).tobytes(), bytes(4)))
    with pytest.raises(HabitusError, match="frame rate"):
        read_capture(path)
    assert read_capture(path, fps=50.0).rate_hz == 50.0


def test_paths_that_are_no_captures_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "text.c3d").write_text("LFHD 1 2 3\n" * 200)
    (tmp_path / "a.mp4").write_bytes(b"1234")
    (tmp_path / "folder.c3d").mkdir()
    for name, word in (
        ("text.c3d", "text"),
        ("a.mp4", "unknown"),
        ("folder.c3d", "folder"),
        ("none.c3d", "no such file"),
    ):
        with pytest.raises(HabitusError, match=word):
            read_captures(tmp_path / name)


def test_a_capture_cannot_be_changed(tmp_path: Path) -> None:
    capture = read_capture(write_raw_c3d(tmp_path / "a.c3d", LABELS, world_points() * 1000.0))
    with pytest.raises(ValueError, match="read-only"):
        capture.markers[0, 0, 0] = 1.0


def test_what_is_read_where_memory_is_short_is_the_same(tmp_path, monkeypatch):
    points = world_points()
    points[40:60, 3] = points[40, 3]
    write_raw_c3d(tmp_path / "a.c3d", LABELS, 1000 * points)
    plenty = read_capture(tmp_path / "a.c3d")
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)
    short = read_capture(tmp_path / "a.c3d")
    assert blocks.is_file_backed(short.markers) and not short.markers.flags.writeable
    np.testing.assert_array_equal(short.markers, plenty.markers)
    assert replace(short, markers=plenty.markers) == plenty
