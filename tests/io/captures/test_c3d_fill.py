"""Samples put into C3D files: nothing else changes, and other readers see them."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.captures.c3d import find_points, parse_c3d
from habitus.io.captures.c3d_fill import filled_c3d

KINDS = ("dec_real.c3d", "sgi_real.c3d", "dec_int.c3d", "sgi_int.c3d", "Eb015si.c3d", "Eb015sr.c3d")


def _with_analog(path: Path, frames: int = 6, points: int = 3) -> None:
    file = ezc3d.c3d()
    rng = np.random.default_rng(0)
    file["parameters"]["POINT"]["RATE"]["value"], file["parameters"]["ANALOG"]["RATE"]["value"] = (
        [100.0],
        [200.0],
    )
    file["parameters"]["POINT"]["LABELS"]["value"] = [f"P{k}" for k in range(points)]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["EMG", "Fz"]
    file["data"]["points"] = np.concatenate(
        [rng.normal(size=(3, points, frames)), np.ones((1, points, frames))]
    )
    residuals = np.full((1, points, frames), 0.5)
    residuals[0, 1, 2:4] = -1.0
    file["data"]["points"][:, 1, 2:4] = 0.0
    file["data"]["meta_points"]["residuals"] = residuals
    file["data"]["meta_points"]["camera_masks"] = np.ones((7, points, frames), bool)
    file["data"]["analogs"] = rng.normal(size=(1, 2, 2 * frames))
    file.add_parameter("MINE", "KEPT", ["as it was"])
    file.write(str(path))


def test_analog_parameters_and_other_points_stay_and_residuals_tell(tmp_path):
    _with_analog(tmp_path / "a.c3d")
    before = (tmp_path / "a.c3d").read_bytes()
    points = np.full((6, 1, 3), 7.5)
    filled = np.zeros((6, 1), bool)
    filled[2:4] = True
    after = filled_c3d(before, "a.c3d", np.array([1]), points, filled)
    (tmp_path / "b.c3d").write_bytes(after)
    assert (
        len(after) == len(before)
        and sum(a != b for a, b in zip(before, after, strict=True)) <= 2 * 16
    )
    old, new = (ezc3d.c3d(str(tmp_path / name)) for name in ("a.c3d", "b.c3d"))
    changed = np.zeros((3, 6), bool)
    changed[1, 2:4] = True
    np.testing.assert_array_equal(new["data"]["points"][:3, changed], 7.5)
    np.testing.assert_array_equal(
        new["data"]["points"][:3, ~changed], old["data"]["points"][:3, ~changed]
    )
    np.testing.assert_array_equal(new["data"]["meta_points"]["residuals"][0, changed], 0.0)
    same = old["data"]["meta_points"]["residuals"][0, ~changed]
    np.testing.assert_array_equal(new["data"]["meta_points"]["residuals"][0, ~changed], same)
    assert (old["data"]["meta_points"]["residuals"][0, changed] == -1.0).all()
    assert not new["data"]["meta_points"]["camera_masks"][:, changed].any()
    np.testing.assert_array_equal(new["data"]["analogs"], old["data"]["analogs"])
    assert new["parameters"]["MINE"]["KEPT"]["value"] == ["as it was"]


@pytest.mark.parametrize("name", KINDS)
def test_every_machines_numbers_are_written(shared, name):
    content = (shared / "mocap-odd" / name).read_bytes()
    raw = parse_c3d(content, name).points
    rng = np.random.default_rng(1)
    filled = rng.random(raw.shape[:2]) < 0.05
    points = np.where(filled[..., None], rng.uniform(-900, 900, raw.shape), np.nan)
    after = parse_c3d(
        filled_c3d(content, name, np.arange(raw.shape[1]), points, filled), name
    ).points
    step = max(
        find_points(content, name)[0].scale, 1e-3
    )  # of whole numbers; real ones keep 32 bits
    np.testing.assert_allclose(after[filled], points[filled], atol=0.51 * step, rtol=1e-6)
    np.testing.assert_array_equal(after[~filled], raw[~filled])


def test_what_cannot_be_filled_is_refused(shared, tmp_path):
    content = (shared / "mocap-odd" / "sgi_int.c3d").read_bytes()
    raw = parse_c3d(content, "x").points
    filled = np.ones((len(raw), 1), bool)
    with pytest.raises(HabitusError, match="whole numbers"):
        filled_c3d(content, "x", np.array([0]), np.full((len(raw), 1, 3), 1e7), filled)
    with pytest.raises(HabitusError, match="frames"):
        filled_c3d(content, "x", np.array([0]), np.zeros((3, 1, 3)), filled[:3])
