"""Force plates: planted forces are read back from files of types 2, 3 and 4, on plates anywhere."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest
from plate_files import EACH, SAMPLES, placed, planted, write

from habitus.errors import HabitusError
from habitus.gait.contacts import ForcePlate
from habitus.io.captures.analog import read_analog
from habitus.io.captures.force_plates import read_force_plates


def read(path: Path) -> ForcePlate:
    (plate,) = read_force_plates(path.read_bytes(), path.name)
    return plate


@pytest.mark.parametrize("kind", [2, 3, 4])
@pytest.mark.parametrize("how", ["plain", "opposite forces", "origin above", "drifted"])
def test_planted_forces_are_read_back(kind, how, tmp_path):
    path = tmp_path / "plate.c3d"
    asked = {"opposite forces": {"sign": -1.0}, "origin above": {"flipped": True},
             "drifted": {"baseline": 25.0 if kind != 4 else 8.0}}  # fmt: skip
    write(path, kind, seed=kind, **asked.get(how, {}))
    plate = read(path)
    axes, middle = placed(kind)
    force, place, free = planted(kind)
    loaded = force[:, 2] < -100.0
    assert plate.rate_hz == 100.0 * EACH and len(plate.force) == SAMPLES
    np.testing.assert_allclose(plate.force, force @ axes.T, atol=0.02)
    np.testing.assert_allclose(plate.pressure[loaded], (middle + place @ axes.T)[loaded], atol=2e-4)
    np.testing.assert_allclose(
        (plate.free_moment @ -axes[:, 2])[loaded], -free[loaded], atol=0.02
    )  # about the upward normal
    assert np.isnan(plate.pressure[force[:, 2] > -10.0]).all()
    assert plate.force[:, 2].max() > 700.0


@pytest.mark.parametrize("name", ["HC030A05", "HC042A40", "right_knee"])
def test_ezc3d_reads_the_same_forces(name, shared):
    """Types 2 and 4, to its zero: it subtracts none."""
    path = shared / "mocap" / f"{name}.c3d"
    theirs = ezc3d.c3d(str(path), extract_forceplat_data=True)["data"]["platform"]
    plates = read_force_plates(path.read_bytes(), path.name)
    for plate, their in zip(plates, theirs, strict=True):
        loaded = plate.force[:, 2] > 100.0
        np.testing.assert_allclose(plate.force[loaded], their["force"].T[loaded], atol=0.5)
        off = 1e3 * plate.pressure - their["center_of_pressure"].T
        assert not loaded.any() or np.abs(off[loaded]).max() < 2.0


def test_a_plate_that_is_always_loaded_keeps_its_zero(shared):
    content = (shared / "mocap" / "right_knee.c3d").read_bytes()
    plates = read_force_plates(content, "right_knee.c3d")
    assert "never unloaded" in plates[0].notes[0] and not plates[1].loaded.any()
    low, high = plates[0].corners.min(0), plates[0].corners.max(0)
    assert (plates[0].pressure > low - 1e-3).all() and (plates[0].pressure < high + 1e-3).all()
    content = (shared / "mocap" / "testsample.c3d").read_bytes()
    (plate,) = read_force_plates(content, "testsample.c3d")
    assert "not connected" in plate.notes[0]


def test_what_is_not_whole_is_refused(tmp_path):
    path = tmp_path / "plate.c3d"
    write(path, 2)
    file = ezc3d.c3d(str(path))
    for group, value, message in (
        ("TYPE", [6], "of type 6; types 2, 3 and 4 are read"),
        ("CHANNEL", np.arange(20.0, 26.0)[:, None], "names channels"),
        ("CORNERS", np.zeros((3, 2, 1)), "expected one of each"),
    ):
        file = ezc3d.c3d(str(path))
        file["parameters"]["FORCE_PLATFORM"][group]["value"] = np.asarray(value)
        file.write(str(tmp_path / "bad.c3d"))
        with pytest.raises(HabitusError, match=message):
            read_force_plates((tmp_path / "bad.c3d").read_bytes(), "bad.c3d")


def test_files_without_plates_have_none(shared):
    content = (shared / "mocap" / "85_02.c3d").read_bytes()
    assert read_force_plates(content, "85_02.c3d") == ()


@pytest.mark.parametrize("name", ["dec_real.c3d", "dec_int.c3d", "HC030A05.c3d"])
def test_samples_are_those_of_ezc3d(name, shared):
    folders = (shared / "mocap", shared / "mocap-odd")
    path = next(folder / name for folder in folders if (folder / name).exists())
    analog, _, _ = read_analog(path.read_bytes(), name)
    theirs = ezc3d.c3d(str(path))["data"]["analogs"][0].T
    scale = np.abs(theirs).max()
    np.testing.assert_allclose(analog.samples[: len(theirs)], theirs, atol=1e-5 * scale)


@pytest.mark.parametrize("kind", ["real", "int"])
def test_samples_of_other_machines_are_the_same(kind, shared):
    """Which ezc3d does not read."""
    sgi, dec = (
        read_analog((shared / "mocap-odd" / f"{name}_{kind}.c3d").read_bytes(), name)[0]
        for name in ("sgi", "dec")
    )
    np.testing.assert_allclose(sgi.samples, dec.samples, rtol=1e-6)
