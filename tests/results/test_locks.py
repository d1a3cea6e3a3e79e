"""Two runs never write one result folder at the same time, whatever they fit."""

import pytest

from habitus.errors import HabitusError
from habitus.files import locked
from habitus.jobs.mosh import mosh
from habitus.jobs.register import register_scans
from habitus.jobs.rgbd import rgbd

RUNS = {
    "mosh": lambda source, out: mosh([source], out),
    "register": lambda source, out: register_scans([source], out=out),
    "rgbd": rgbd,
}


@pytest.mark.parametrize("name", RUNS)
def test_a_folder_in_use_is_refused(name, tmp_path):
    with locked(tmp_path / "out"), pytest.raises(HabitusError, match="another run is at work"):
        RUNS[name](tmp_path / "missing", tmp_path / "out")


@pytest.mark.parametrize("name", RUNS)
def test_a_run_that_fails_leaves_no_folder(name, tmp_path):
    with pytest.raises(HabitusError, match="missing"):
        RUNS[name](tmp_path / "missing", tmp_path / "out")
    assert not (tmp_path / "out").exists()
