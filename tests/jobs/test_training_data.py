"""Which registrations a training takes: those that failed are left out by name, unless asked for."""

from dataclasses import replace

import pytest
from toy_people import toy

from habitus.errors import HabitusError
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.jobs.train import open_training_data


def judged(*failed: int):
    """The toy data with some registrations that were judged failed."""
    data = toy()[1].registrations.where(set=("pose", "shape"))
    words = tuple("failed" if k in failed else "doubtful" for k in range(len(data)))
    return replace(data, verdict=words)


def test_failed_registrations_are_left_out_and_named(tmp_path):
    data = judged(1, 3)
    write_registrations(data, tmp_path / "registrations.npz")
    found, warnings = open_training_data(tmp_path / "registrations.npz", "m", 1, "all")
    assert len(found) == len(data) - 2 and not {data.name[1], data.name[3]} & set(found.name)
    (warning,) = warnings
    assert data.name[1] in warning and data.name[3] in warning and "2 of" in warning


def test_failed_registrations_are_taken_where_that_was_asked_for(tmp_path):
    data = judged(1, 3)
    write_registrations(data, tmp_path / "folder")
    found, warnings = open_training_data(tmp_path / "folder", "m", 1, "all", include_failed=True)
    assert found.name == data.name and found.verdict == data.verdict and not warnings


def test_a_training_on_failed_registrations_alone_is_refused():
    with pytest.raises(HabitusError, match=r"all \d+ registrations"):
        open_training_data(judged(*range(1000)), "m", 1, "all")


def test_a_word_that_is_no_verdict_is_refused(tmp_path):
    data = toy()[1].registrations
    with pytest.raises(HabitusError, match="verdict is 'fine'"):
        replace(data, verdict=("fine",) * len(data))
    write_registrations(data, tmp_path / "folder")
    table = tmp_path / "folder" / "registrations.csv"
    lines = table.read_text("utf-8").splitlines()
    table.write_text("\n".join([f"{lines[0]},verdict", *(f"{line},fine" for line in lines[1:])]))
    with pytest.raises(HabitusError, match="fine"):
        open_registrations(tmp_path / "folder")
