"""TRC, Motive CSV, QTM TSV and npz: what is written is read back, units, gaps and all."""

import time
from pathlib import Path

import numpy as np
import pytest
from capture_texts import motive_text, qtm_text, trc_text
from mannequin import LABELS, RECORDED, world_points, write_raw_c3d

from habitus.errors import HabitusError
from habitus.io.captures.read import Capture, read_capture


def _points(up: str) -> np.ndarray:
    points = world_points(up)
    points[3:9, 5] = np.nan
    points[0], points[-1] = np.nan, np.nan
    return points


def _same(capture: Capture, points: np.ndarray, up: str, tolerance: float = 2e-6) -> None:
    assert capture.labels == LABELS
    assert capture.up_axis == up
    np.testing.assert_allclose(capture.markers, points, atol=tolerance)


@pytest.mark.parametrize(
    ("unit", "factor"), [("mm", 1e3), ("m", 1.0), ("cm", 100.0), ("Millimeters", 1e3)]
)
def test_trc_round_trip(tmp_path: Path, unit: str, factor: float) -> None:
    points = _points("+y")
    (tmp_path / "a.trc").write_text(trc_text(LABELS, points * factor, unit=unit))
    capture = read_capture(tmp_path / "a.trc")
    _same(capture, points, "+y")
    assert capture.rate_hz == 100.0 and capture.warnings == () and capture.format == "trc"


@pytest.mark.parametrize("hand", ["spaces", "newlines", "decimal commas", "no blank line"])
def test_trc_in_other_hands(tmp_path: Path, hand: str) -> None:
    points = world_points("+y")
    text = trc_text(LABELS, points * 1e3)
    head, _, body = text.partition("\r\n\r\n")
    if hand == "spaces":
        text = text.replace("\t\t\t", "\t").replace("\t", "  ")
    elif hand == "newlines":
        text = text.replace("\r\n", "\n")
    elif hand == "decimal commas":
        text = head + "\r\n\r\n" + body.replace(".", ",")
    else:
        text = head + "\r\n" + body
    (tmp_path / "a.trc").write_text(text)
    _same(read_capture(tmp_path / "a.trc"), points, "+y")


def test_real_trc(shared: Path) -> None:
    capture = read_capture(shared / "mocap" / "DJ2.trc")
    assert (
        capture.markers.shape == (371, 47, 3)
        and capture.up_axis == "+y"
        and capture.rate_hz == 100.0
    )
    assert {label for label, _ in capture.dropped} == {"R_HJC", "L_HJC", "R_HJC_reg", "L_HJC_reg"}
    assert capture.warnings == ()


def test_frames_left_out_are_missing_and_time_stays_honest(tmp_path: Path) -> None:
    points = world_points("+y")
    kept = np.r_[0:20, 31:60]
    (tmp_path / "a.trc").write_text(trc_text(LABELS, points[kept] * 1e3, numbers=kept + 1))
    capture = read_capture(tmp_path / "a.trc")
    assert len(capture.markers) == 60 and capture.rate_hz == 100.0
    assert np.isnan(capture.markers[20:31]).all() and np.isfinite(capture.markers[31:]).all()
    assert any("11 frames" in warning for warning in capture.warnings)


def test_times_outvote_a_wrong_rate(tmp_path: Path) -> None:
    text = trc_text(LABELS, world_points("+y") * 1e3, rate=120.0).replace(
        "\r\n120\t120\t", "\r\n60\t60\t"
    )
    (tmp_path / "a.trc").write_text(text)
    capture = read_capture(tmp_path / "a.trc")
    assert capture.rate_hz == pytest.approx(120.0, rel=1e-3)
    assert any("60 Hz" in warning for warning in capture.warnings)


@pytest.mark.parametrize(
    ("unit", "factor"), [("Meters", 1.0), ("Centimeters", 100.0), ("Millimeters", 1e3)]
)
@pytest.mark.parametrize("version", ["1.20", "1.23", "1.24"])
def test_motive_round_trip_takes_only_tracked_markers(
    tmp_path: Path, unit: str, factor: float, version: str
) -> None:
    points = _points("+y")
    (tmp_path / "a.csv").write_text(
        motive_text(LABELS, points * factor, unit=unit, version=version)
    )
    capture = read_capture(tmp_path / "a.csv")
    _same(capture, points, "+y")
    assert capture.subject == "Ann" and capture.rate_hz == 120.0 and capture.warnings == ()


def test_motive_without_markers_says_what_it_holds(tmp_path: Path) -> None:
    text = motive_text(LABELS[:1], world_points("+y")[:, :1])
    (tmp_path / "a.csv").write_text(
        text.replace(",Bone Marker", ",Bone")
        .replace(",Rigid Body Marker", ",Bone")
        .replace(",Marker", ",Bone")
    )
    with pytest.raises(HabitusError, match="only Bone, Rigid Body"):
        read_capture(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("times", "more"), [(False, False), (True, True), (True, False), (False, True)]
)
def test_qtm_round_trip(tmp_path: Path, times: bool, more: bool) -> None:
    points = _points("+z")
    (tmp_path / "a.tsv").write_text(qtm_text(LABELS, points * 1e3, times=times, more=more))
    capture = read_capture(tmp_path / "a.tsv")
    _same(capture, points, "+z")
    assert capture.rate_hz == 100.0 and capture.warnings == ()


def test_qtm_rigid_bodies_are_no_markers(tmp_path: Path) -> None:
    (tmp_path / "a.tsv").write_text(
        qtm_text(LABELS, world_points()).replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D")
    )
    with pytest.raises(HabitusError, match="6D"):
        read_capture(tmp_path / "a.tsv")


@pytest.mark.parametrize(
    "keys", [("markers", "labels", "frame_rate"), ("markers_obs", "labels", "mocap_framerate")]
)
@pytest.mark.parametrize("kind", ["U", "S"])
def test_npz_round_trip(tmp_path: Path, keys: tuple[str, str, str], kind: str) -> None:
    points = _points("+z")
    labels = np.array([f"Ann:{label}" for label in LABELS]).astype(kind)
    np.savez(
        tmp_path / "a.npz",
        **dict(zip(keys, (points, labels, 119.88), strict=True)),
        unit="m",
        gender="female",
        height_m=1.78,
    )
    capture = read_capture(tmp_path / "a.npz")
    _same(capture, points, "+z", 0.0)
    assert capture.rate_hz == 119.88 and capture.subject == "Ann"
    assert dict(capture.recorded) == {"height_m": RECORDED["height_m"], "sex": "female"}


def test_npz_labels_may_change_from_frame_to_frame(tmp_path: Path) -> None:
    points = world_points()
    labels = np.tile(np.array(LABELS), (60, 1))
    generator = np.random.default_rng(2)
    for i in range(60):
        order = generator.permutation(41)
        points[i], labels[i] = points[i][order], labels[i][order]
    np.savez(tmp_path / "a.npz", markers=points, labels=labels, frame_rate=100, unit="m")
    capture = read_capture(tmp_path / "a.npz")
    assert capture.labels == tuple(sorted(LABELS))
    np.testing.assert_array_equal(capture.markers, world_points()[:, np.argsort(LABELS)])


@pytest.mark.parametrize(
    ("arrays", "word"),
    [
        (
            {"markers": world_points(), "labels": np.array(LABELS, object), "frame_rate": 100},
            "pickled",
        ),
        (
            {"markers": world_points(), "labels": np.array(LABELS[:3]), "frame_rate": 100},
            "3 labels",
        ),
        (
            {"markers": world_points()[0], "labels": np.array(LABELS), "frame_rate": 100},
            r"\(T, M, 3\)",
        ),
        ({"markers": world_points(), "labels": np.array(LABELS)}, "frame rate"),
        ({"poses": np.zeros((4, 66))}, "poses"),
        ({"markers": np.array(None, object)}, "pickled"),
    ],
)
def test_npz_that_will_not_do_is_refused_in_a_line(tmp_path: Path, arrays: dict, word: str) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(HabitusError, match=word):
        read_capture(tmp_path / "a.npz")


@pytest.mark.parametrize("ending", [".trc", ".csv", ".tsv", ".npz"])
@pytest.mark.parametrize(
    "content",
    [b"", b"\n\n", b"hello\nworld\n", bytes(range(256)) * 8, b"a,b\n1,2\n", b"Frame#\tTime\n"],
)
def test_files_of_something_else_give_one_line(tmp_path: Path, ending: str, content: bytes) -> None:
    (tmp_path / f"a{ending}").write_bytes(content)
    with pytest.raises(HabitusError) as caught:
        read_capture(tmp_path / f"a{ending}")
    assert "\n" not in str(caught.value) and f"a{ending}" in str(caught.value)


@pytest.mark.parametrize("times", [False, True])
def test_qtm_rows_that_do_not_hold_its_markers_are_refused_or_missing(
    tmp_path: Path, times: bool
) -> None:
    text = qtm_text(LABELS, world_points("+z") * 1e3, times=times)
    rows = text.split("\r\n")
    first = next(i for i, row in enumerate(rows) if row[:1].isdigit() or row[:1] == "-")
    (tmp_path / "a.tsv").write_text(
        "\r\n".join([*rows[:first], *(row + "\t1\t2\t3" for row in rows[first:] if row)])
    )
    with pytest.raises(HabitusError, match=r"a\.tsv.*41 markers"):
        read_capture(tmp_path / "a.tsv")
    rows[first + 3] = rows[first + 3].replace("\t", "\t0\t", 1)
    (tmp_path / "a.tsv").write_text("\r\n".join(rows))
    capture = read_capture(tmp_path / "a.tsv")
    assert np.isnan(capture.markers[3]).all() and any("1 rows" in text for text in capture.warnings)


@pytest.mark.parametrize("kind", ["trc", "tsv", "npz"])
def test_rates_that_no_capture_has_are_refused_and_odd_ones_told(tmp_path: Path, kind: str) -> None:
    points = world_points("+y")
    path = tmp_path / f"a.{kind}"

    def write(rate: float) -> None:
        if kind == "npz":
            np.savez(path, markers=points, labels=np.array(LABELS), rate_hz=rate, unit="m")
        else:
            path.write_text(
                (trc_text if kind == "trc" else qtm_text)(LABELS, points * 1e3, rate=rate)
            )

    write(1e5)
    with pytest.raises(HabitusError, match=r"100000 Hz.*fps"):
        read_capture(path)
    assert read_capture(path, fps=100).rate_hz == 100
    write(2.5)
    assert any("2.5 Hz is an unusual" in text for text in read_capture(path).warnings)
    write(250)
    assert read_capture(path).warnings == ()


@pytest.mark.parametrize("far", [1e6, 1.1e3, -3e4])
def test_points_kilometres_away_are_missing_and_told(tmp_path: Path, far: float) -> None:
    points = world_points("+y")
    spoilt = points.copy()
    spoilt[7, 3, 1] = far
    np.savez(tmp_path / "a.npz", markers=spoilt, labels=np.array(LABELS), rate_hz=100, unit="m")
    capture = read_capture(tmp_path / "a.npz")
    points[7, 3] = np.nan
    np.testing.assert_allclose(capture.markers, points, atol=1e-6)
    assert any(
        f"{LABELS[3]} (1 frames)" in text and "kilometre" in text for text in capture.warnings
    )


@pytest.mark.parametrize("kind", ["c3d", "trc", "npz"])
def test_labels_are_safe_to_show_in_whatever_they_are_written(tmp_path: Path, kind: str) -> None:
    points = world_points("+y")
    path = tmp_path / f"a.{kind}"
    labels = (*LABELS[:-2], "\x1b[31mRED", "X" * 5000)
    if kind == "c3d":
        write_raw_c3d(path, (*LABELS[:-2], "\x1b[31mRED", "X" * 120), points * 1e3)
    elif kind == "trc":
        path.write_text(trc_text(labels, points * 1e3))
    else:
        np.savez(
            path, markers=points, labels=np.array(labels), rate_hz=100, subject="\x9b\u202eAnn"
        )
    capture = read_capture(path)
    assert r"\x1b[31mRED" in capture.labels and len(capture.labels) == len(LABELS)
    assert all(
        label.isprintable() and len(label) <= 200
        for label in (*capture.labels, capture.subject or "")
    )


def test_many_points_of_one_name_do_not_take_forever(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    others = rng.normal(size=(1, 8000, 3)) + rng.normal(scale=1e-3, size=(5, 1, 3))
    points = np.concatenate([world_points("+y", frames=5), others], axis=1)
    np.savez(
        tmp_path / "a.npz",
        markers=points,
        labels=np.array([*LABELS, *["X"] * 8000]),
        rate_hz=100,
        unit="m",
    )
    started = time.process_time()
    assert len(read_capture(tmp_path / "a.npz").labels) > 1000
    assert time.process_time() - started < 10
