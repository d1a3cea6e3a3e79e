"""Points whose labels are not read, and files that get new ones: nothing else changes."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.captures.c3d_relabel import write_relabelled
from habitus.io.captures.read import read_capture
from habitus.io.captures.unlabelled import read_unlabelled


@pytest.fixture
def unnamed(tmp_path: Path) -> Path:
    """Ten points without names and an angle, with an analog channel, in millimetres at 50 Hz."""
    rng = np.random.default_rng(0)
    file = ezc3d.c3d()
    points = np.ones((4, 11, 30))
    points[:3] = rng.uniform(100, 1700, size=(3, 11, 1)) + rng.normal(scale=5, size=(3, 11, 30))
    points[:3, 2, 10:20] = np.nan
    file["parameters"]["POINT"]["RATE"]["value"] = [50.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = [*(f"*{k}" for k in range(10)), "LKneeAngles"]
    file["parameters"]["ANALOG"]["RATE"]["value"] = [100.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["force"]
    file["data"]["points"], file["data"]["analogs"] = points, rng.normal(size=(1, 1, 60))
    file.add_parameter("TRIAL", "NOTE", ["kept"])
    file.write(str(tmp_path / "raw.c3d"))
    return tmp_path / "raw.c3d"


def test_points_are_metres_and_angles_are_none(unnamed: Path) -> None:
    capture = read_unlabelled(unnamed)
    assert (
        capture.points.shape == (30, 10, 3)
        and capture.columns == tuple(range(10))
        and capture.rate_hz == 50.0
    )
    assert np.nanmax(capture.points) < 2.0 and np.isnan(capture.points[10:20, 2]).all()


def test_other_names_leave_all_else_as_it_was(unnamed: Path, tmp_path: Path) -> None:
    capture = read_unlabelled(unnamed)
    names = tuple(f"N{k}" for k in range(10))
    write_relabelled(unnamed, capture, names, capture.points[:, ::-1], tmp_path / "out.c3d")
    before = ezc3d.c3d(str(unnamed))
    after = ezc3d.c3d(str(tmp_path / "out.c3d"))
    assert after["parameters"]["POINT"]["LABELS"]["value"] == [*names, "LKneeAngles"]
    assert np.array_equal(before["data"]["analogs"], after["data"]["analogs"])
    assert after["parameters"]["TRIAL"]["NOTE"]["value"] == ["kept"]
    assert np.allclose(after["data"]["points"][:3, 0], before["data"]["points"][:3, 9], atol=1e-3)
    assert np.allclose(after["data"]["points"][:3, 10], before["data"]["points"][:3, 10], atol=1e-3)
    again = read_capture(tmp_path / "out.c3d")
    assert (
        again.rate_hz == 50.0
        and np.isnan(again.markers[10:20, list(again.labels).index("N7")]).all()
    )


def test_a_file_without_points_is_refused(tmp_path: Path) -> None:
    with pytest.raises(HabitusError, match="no such file"):
        read_unlabelled(tmp_path / "none.c3d")
