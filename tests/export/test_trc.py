"""TRC files: what was written comes back, and OpenSim's way of reading it, written down here, finds
every cell.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import habitus
from habitus.errors import HabitusError
from habitus.io.captures.read import Capture
from habitus.io.captures.trc import parse_trc
from habitus.rotations import UP_AXES, up_rotation


def capture(
    labels=("LFHD", "RFHD", "C7", "LKNE"), frames=40, up="+y", rate=100.0, gaps=0.2, seed=0
):
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.15, 0.15, (1, len(labels), 3))
    place[0, :, 1] = np.linspace(1.7, 0.5, len(labels))
    points = place + 0.002 * rng.normal(size=(frames, len(labels), 3)).cumsum(axis=0)
    points[rng.uniform(size=points.shape[:2]) < gaps] = np.nan
    points[0] = place[0]
    return Capture("walk", tuple(labels), points @ up_rotation(up), rate, up)


def opensim_rows(text: str) -> list[list[str]]:
    """The cells of each line that is not blank, as OpenSim counts them: a cell is what a tab or the
    line's end ends.
    """
    lines = (line.split("\t") for line in text.split("\n") if line)
    return [cells[:-1] if cells[-1] == "" else cells for cells in lines]


@pytest.mark.parametrize("unit", ["mm", "m"])
@pytest.mark.parametrize("up", UP_AXES)
def test_what_is_written_is_read(tmp_path, unit, up):
    given = capture(up=up, rate=59.94)
    habitus.write_trc(given, tmp_path / "a.trc", unit=unit)
    found = habitus.read_capture(tmp_path / "a.trc")
    assert found.labels == given.labels and found.up_axis == "+y" and found.unit == unit
    assert found.rate_hz == pytest.approx(given.rate_hz, rel=1e-9) and not found.warnings
    assert np.array_equal(np.isnan(found.markers), np.isnan(given.markers))
    assert np.nanmax(np.abs(found.markers - given.markers @ up_rotation(up).T)) < 1e-8


def test_the_captures_own_frame_stays_where_asked(tmp_path):
    given = capture(up="+z")
    habitus.write_trc(given, tmp_path / "a.trc", y_up=False)
    points = parse_trc((tmp_path / "a.trc").read_bytes(), "a").points
    assert np.nanmax(np.abs(points / 1e3 - given.markers)) < 1e-8


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.text(min_size=1, max_size=12).filter(lambda s: s.strip()),
        min_size=1,
        max_size=5,
        unique=True,
    )
)
def test_labels_of_any_kind_come_back_or_are_refused(tmp_path_factory, labels):
    path = tmp_path_factory.mktemp("labels") / "a.trc"
    given = capture(labels, frames=3, gaps=0)
    try:
        habitus.write_trc(given, path)
    except HabitusError:
        assert len({label.strip() for label in labels}) < len(labels)
        return
    raw = parse_trc(path.read_bytes(), "a")
    assert raw.points.shape == given.markers.shape and not raw.warnings
    for label, found in zip(labels, raw.labels, strict=True):
        assert found == label.strip() or (not label.isprintable() and found.isprintable())
    assert np.abs(raw.points / 1e3 - given.markers).max() < 1e-8


def test_opensim_finds_its_header_and_its_cells(tmp_path):
    given = capture()
    given = Capture(
        "walk",
        given.labels,
        np.where(np.arange(4)[:, None] == 3, np.nan, given.markers),
        100.0,
        "+y",
    )
    habitus.write_trc(given, tmp_path / "a.trc")
    first, keys, values, labels, axes, *rows = opensim_rows((tmp_path / "a.trc").read_text())
    assert first == ["PathFileType", "4", "(X/Y/Z)", "a.trc"]
    assert " ".join(keys) == (
        "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame "
        "OrigNumFrames"
    )
    assert values == ["100", "100", "40", "4", "mm", "100", "1", "40"]
    assert [cell for cell in labels if cell] == ["Frame#", "Time", *given.labels]
    assert axes[2:] == [f"{axis}{k}" for k in range(1, 5) for axis in "XYZ"]
    assert {len(row) for row in rows} == {2 + 3 * 4}, "also where the last marker is missing"
    assert (tmp_path / "a.trc").read_text().split("\n")[5] == "" and rows[7][:2] == [
        "8",
        "0.07000000",
    ]


def test_a_point_at_zero_is_seen(tmp_path):
    points = np.zeros((6, 2, 3))
    points[:, 1] = 1.0
    habitus.write_trc(Capture("a", ("A", "B"), points, 50.0, "+y"), tmp_path / "a.trc")
    raw = parse_trc((tmp_path / "a.trc").read_bytes(), "a")
    assert (raw.points[:, 0] != 0).any(axis=1).all() and np.abs(raw.points[:, 0]).max() < 1e-4


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"labels": ("A", "A")}, "several markers A"),
        ({"labels": ("A", " ")}, "no label for marker 2"),
        ({"labels": ("A", "B"), "frames": 0}, "0 frames"),
        ({"labels": ("A", "B"), "rate": float("nan")}, "rate of nan"),
    ],
)
def test_what_trc_cannot_hold_is_one_clear_error(tmp_path, changes, told):
    spoilt = {**changes, "frames": 2} if changes.get("frames") != 0 else changes
    given = capture(**{**spoilt, "frames": 2})
    if changes.get("frames") == 0:
        given = given[:0]
    with pytest.raises(HabitusError, match=told):
        habitus.write_trc(given, tmp_path / "a.trc")
    with pytest.raises(HabitusError, match="mm or m"):
        habitus.write_trc(capture(), tmp_path / "a.trc", unit="inch")
    assert not list(tmp_path.iterdir())


def test_a_real_capture_comes_back(shared, tmp_path):
    given = habitus.read_capture(shared / "mocap" / "DJ2.trc")
    habitus.write_trc(given, tmp_path / "DJ2.trc")
    found = habitus.read_capture(tmp_path / "DJ2.trc")
    assert found.labels == given.labels and found.rate_hz == given.rate_hz
    assert np.nanmax(np.abs(found.markers - given.markers)) < 1e-8
