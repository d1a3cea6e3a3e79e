"""Captures grouped by person: unions of markers, held-out markers, labels that a file exchanges."""

from dataclasses import replace

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.export.trc import write_trc
from habitus.io.captures.read import Capture, read_capture
from habitus.jobs.subjects import gather, leave_out, person_of


@pytest.fixture(scope="module")
def capture(shared) -> Capture:
    return read_capture(shared / "mocap" / "testsample.c3d")


def column(capture: Capture, label: str) -> np.ndarray:
    return capture.markers[:, capture.labels.index(label)]


def test_captures_of_one_person_share_the_union_of_their_markers(capture):
    fewer = replace(
        capture, name="fewer", labels=capture.labels[:-1], markers=capture.markers[:, :-1]
    )
    both = person_of([capture, fewer], "auto")
    assert set(both.layout.labels) == set(capture.labels)
    missing = both.layout.labels.index(capture.labels[-1])
    assert np.isnan(both.recordings[1].observed[:, missing]).all()
    assert np.isfinite(both.recordings[0].observed[:, missing]).any()


def test_held_out_markers_are_in_nothing_that_is_fitted(capture):
    whole = person_of([capture], "auto")
    kept, held = leave_out(whole, ["RANK", "LFHD"])
    assert set(kept.layout.labels) == set(whole.layout.labels) - {"RANK", "LFHD"}
    assert set(held.layout.labels) == {"RANK", "LFHD"}
    for label, observed in zip(
        held.layout.labels, np.moveaxis(held.observed[0], 1, 0), strict=True
    ):
        np.testing.assert_array_equal(observed, column(capture, label))


def test_labels_that_the_file_exchanges_are_put_right_before_they_are_held_out(capture):
    _, held = leave_out(
        person_of([capture], "auto"), ["LWRA"]
    )  # this file has its left wrist's pair the wrong way round
    assert held.layout.markers[0].landmark == "left_wrist_radial"
    np.testing.assert_array_equal(held.observed[0][:, 0], column(capture, "LWRB"))


def test_what_cannot_be_held_out_or_found_is_named(capture):
    whole = person_of([capture], "auto")
    with pytest.raises(HabitusError, match="NOSUCH"):
        leave_out(whole, ["NOSUCH"])
    with pytest.raises(HabitusError, match="leave some"):
        leave_out(whole, whole.layout.labels)
    with pytest.raises(HabitusError, match="nobody"):
        gather([[capture]], "auto", "nobody")


def other_sides(capture: Capture) -> Capture:
    """With left and right labels exchanged."""
    swapped = {"L": "R", "R": "L"}
    labels = tuple(swapped.get(label[0], label[0]) + label[1:] for label in capture.labels)
    return replace(capture, labels=labels)


@pytest.mark.parametrize("read", [True, False])
def test_exchanged_sides_are_doubtful_and_both_readings_named(capture, tmp_path, read):
    """In what is read from a file, and in a capture made in memory."""
    assert not person_of([capture], "auto").recordings[0].doubts
    wrong = other_sides(capture)
    if read:
        write_trc(wrong, tmp_path / "wrong.trc")
        wrong = read_capture(tmp_path / "wrong.trc")
    (doubt,) = person_of([wrong], "auto").recordings[0].doubts
    assert "exchanged" in doubt and "left-handed" in doubt
