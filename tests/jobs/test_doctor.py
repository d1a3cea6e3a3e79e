"""`habitus doctor`: what it says of this machine, and of one where something is missing."""

import json
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from habitus.cli.main import main
from habitus.jobs import doctor

ROOT = Path(__file__).parents[2]
DEVELOPERS = {"docs", "bench", "test"}


def by_name(section):
    return {check.name: check for check in section}


def test_all_that_is_needed_is_here():
    found = doctor.diagnose()
    assert found.sound
    packages = by_name(found.sections["packages"])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert len(packages) == len(project["dependencies"])
    assert packages["numpy"].text == metadata.version("numpy")
    assert by_name(found.sections["machine"])["kernels"].level != "broken"


def test_every_extra_for_users_has_its_purpose():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(doctor.PURPOSES) == set(project["optional-dependencies"]) - DEVELOPERS


def test_a_missing_package_is_broken_and_a_missing_extra_is_not(monkeypatch, capsys):
    real = metadata.version

    def without(*absent):
        def version(name):
            if name in absent:
                raise metadata.PackageNotFoundError(name)
            return real(name)

        monkeypatch.setattr(doctor.importlib.metadata, "version", version)

    without("usd-core")
    found = doctor.diagnose()
    usd = by_name(found.sections["extras"])["usd"]
    assert (usd.level, found.sound) == ("missing", True)
    assert "pip install 'habitus[usd]'" in usd.text
    without("scipy")
    assert by_name(doctor.diagnose().sections["packages"])["scipy"].level == "broken"
    with pytest.raises(SystemExit) as end:
        main(["doctor"])
    assert end.value.code == 2
    assert "pip install scipy" in capsys.readouterr().out


def test_json_is_json(capsys):
    main(["doctor", "--json"])
    printed = json.loads(capsys.readouterr().out)
    assert printed["sound"] is True
    assert {"habitus", "packages", "extras", "programs", "machine"} <= set(printed)
