"""TRC files whose header and numbers disagree: columns come from where the numbers stand, and what
is off is said.
"""

from pathlib import Path

import numpy as np
import pytest
from capture_texts import trc_text
from mannequin import LABELS, world_points

from habitus.errors import HabitusError
from habitus.io.captures.read import Capture, read_capture

POINTS = world_points("+y")
ROWS = trc_text(LABELS, POINTS * 1e3).split("\r\n")
NAMES = 3
AXES = 4
DATA = 6


def _read(tmp_path: Path, rows: list[str]) -> Capture:
    (tmp_path / "a.trc").write_text("\n".join(rows))
    return read_capture(tmp_path / "a.trc")


def _edited(row: int, text: str) -> list[str]:
    return [*ROWS[:row], text, *ROWS[row + 1 :]]


def _all_data(change) -> list[str]:
    return [*ROWS[:DATA], *(change(row) if row else row for row in ROWS[DATA:])]


@pytest.mark.parametrize(
    ("row", "text"),
    [
        (NAMES, ROWS[NAMES].replace("Time\t", "Time\t\t\t")),  # as MATLAB scripts write it
        (NAMES, ROWS[NAMES].replace("Time\t", "Time\t\t")),
        (NAMES, "Frame#\t" + "\t\t\t".join(LABELS)),
        (NAMES, "Frame#\tTime\t" + "\t".join(LABELS)),
        (AXES, ROWS[AXES].lstrip("\t")),
        (AXES, "\t\t\t\t" + ROWS[AXES].lstrip("\t")),
        (AXES, ""),
        (AXES, "\t\t" + "\t".join("XYZ" * len(LABELS))),
        (AXES, "\t\t" + "\t".join("X1 Y1 Z1 X2 Y2 Z2".split())),
        (AXES, ROWS[AXES].lower()),
    ],
)
def test_each_marker_has_its_own_coordinates_wherever_the_header_puts_its_name(tmp_path, row, text):
    capture = _read(tmp_path, _edited(row, text))
    assert capture.labels == LABELS
    np.testing.assert_allclose(capture.markers, POINTS, atol=2e-6)


def test_names_that_stand_elsewhere_are_told(tmp_path):
    shifted = _read(tmp_path, _edited(NAMES, ROWS[NAMES].replace("Time\t", "Time\t\t\t")))
    assert any(
        "names begin in column 5, their coordinates in column 3" in text
        for text in shifted.warnings
    )


def test_real_file_with_shifted_names(shared: Path, tmp_path: Path):
    text = (shared / "mocap" / "DJ2.trc").read_text()
    (tmp_path / "DJ2.trc").write_text(text.replace("Time\t", "Time\t\t\t", 1))
    sound = read_capture(shared / "mocap" / "DJ2.trc")
    shifted = read_capture(tmp_path / "DJ2.trc")
    assert sound.labels == shifted.labels and len(shifted.warnings) == len(sound.warnings) + 1
    np.testing.assert_array_equal(shifted.markers, sound.markers)


def test_a_name_without_coordinates_and_coordinates_without_a_name_are_told(tmp_path):
    capture = _read(tmp_path, _edited(NAMES, ROWS[NAMES].rstrip("\t") + "\t\t\tLOST\t\t"))
    assert capture.labels == LABELS and any("LOST" in text for text in capture.warnings)
    capture = _read(tmp_path, _edited(NAMES, ROWS[NAMES].replace("LBHD", "")))
    assert capture.labels == tuple(label for label in LABELS if label != "LBHD")
    assert any("1 of 41 points have no name" in text for text in capture.warnings)
    kept = [i for i, label in enumerate(LABELS) if label != "LBHD"]
    np.testing.assert_allclose(capture.markers, POINTS[:, kept], atol=2e-6)


def test_axes_in_another_order_are_read_by_their_letters(tmp_path):
    axes = "\t\t" + "\t".join(f"{axis}{i + 1}" for i in range(len(LABELS)) for axis in "ZXY")
    rows = trc_text(LABELS, POINTS[..., [2, 0, 1]] * 1e3).split("\r\n")
    capture = _read(tmp_path, [*rows[:AXES], axes, *rows[AXES + 1 :]])
    np.testing.assert_allclose(capture.markers, POINTS, atol=2e-6)


@pytest.mark.parametrize(
    "rows",
    [
        _all_data(lambda row: row.rpartition("\t")[0]),  # the last triple is not complete
        _all_data(lambda row: row.replace("\t", "\t9\t", 1)),  # one more number in each row
        _all_data(lambda row: "\t".join(row.split("\t")[:1] + row.split("\t")[2:])),  # no time
        _edited(AXES, ROWS[AXES].rpartition("\t")[0]),
        _edited(NAMES, "Frame#\tTime\t" + "\t".join(LABELS[:-1])),
    ],
)
def test_what_cannot_be_told_apart_is_refused(tmp_path, rows):
    with pytest.raises(HabitusError, match=r"a\.trc.*export it again"):
        _read(tmp_path, rows)


def test_blanks_between_blanks_are_not_guessed(tmp_path):
    """Where spaces part the cells, a blank cell leaves no trace: that row would be other markers'
    coordinates.
    """
    points = POINTS.copy()
    points[5, 7] = np.nan
    text = trc_text(LABELS, points * 1e3).replace("\t", "  ")
    capture = _read(tmp_path, text.split("\r\n"))
    assert capture.labels == LABELS and any("1 rows" in text for text in capture.warnings)
    points[5] = np.nan
    np.testing.assert_allclose(capture.markers, points, atol=2e-6)


def test_one_row_that_is_too_long_is_missing_and_told(tmp_path):
    rows = list(ROWS)
    rows[DATA + 4] = rows[DATA + 4].replace("\t", "\t1\t", 3)
    capture = _read(tmp_path, rows)
    assert np.isnan(capture.markers[4]).all() and any("1 rows" in text for text in capture.warnings)
    np.testing.assert_allclose(capture.markers[5:], POINTS[5:], atol=2e-6)
