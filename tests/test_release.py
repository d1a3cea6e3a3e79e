"""What is released agrees with itself: versions, changelog, workflow, conda-forge's recipe."""

import re
import sys
import tomllib

import pytest
import yaml
from snippets import ROOT

import habitus

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
CHANGES = """# Changes

## 0.2.0, 2027-03-01

- New.

## 0.1.0, unreleased

- Old.
"""


@pytest.fixture
def release(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    import release

    return release


def test_there_is_one_version():
    recipe = (ROOT / "recipe" / "recipe.yaml").read_text("utf-8")
    versions = {
        habitus.__version__,
        PROJECT["version"],
        re.search(r"^## (\S+),", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)[1],
        re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)[1],
        re.search(r'^  version: "(\S+)"$', recipe, re.MULTILINE)[1],
    }
    assert len(versions) == 1, versions


def test_a_tag_needs_its_version_and_a_dated_section(release):
    assert release.release_notes("v0.2.0", "0.2.0", CHANGES) == "- New.\n"
    for tag, version, said in (
        ("v0.2.1", "0.2.0", "expected v0.2.0"),
        ("0.2.0", "0.2.0", "expected v0.2.0"),
        ("v0.1.0", "0.1.0", "date it"),
        ("v0.3.0", "0.3.0", "date it"),
    ):
        with pytest.raises(SystemExit, match=said):
            release.release_notes(tag, version, CHANGES)
    with pytest.raises(SystemExit, match="is empty"):
        release.release_notes("v0.2.0", "0.2.0", CHANGES.replace("- New.\n", ""))


def test_only_the_last_job_of_a_release_may_sign_and_nothing_holds_a_password():
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text("utf-8")
    workflow = yaml.safe_load(text)
    jobs = workflow["jobs"]
    assert workflow[True] == {"push": {"tags": ["v*"]}}  # YAML 1.1 reads the key "on" so
    assert workflow["permissions"] == {"contents": "read"}
    writing = [name for name, job in jobs.items() if "write" in str(job.get("permissions"))]
    assert writing == ["publish"] and jobs["publish"]["environment"] == "pypi"
    assert set(jobs["publish"]["needs"]) == set(jobs) - {"publish"}
    used = [step.get("uses", "") for step in jobs["publish"]["steps"]]
    assert {"pypa/gh-action-pypi-publish@release/v1", "actions/attest-build-provenance@v2"} <= {
        *used
    }
    assert "actions/checkout@v4" not in used  # what is published is what was tried
    assert not re.search(r"secrets\.|password", text.replace("instead of a password", ""))


def test_the_recipe_is_pyprojects():
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text("utf-8"))
    run = recipe["requirements"]["run"]
    assert [line.replace(" ", "") for line in run[1:]] == PROJECT["dependencies"]
    assert run[0] == "python >=${{ python_min }}"
    assert f">={recipe['context']['python_min']}" == PROJECT["requires-python"]
    build = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["build-system"]["requires"]
    assert [line.replace(" ", "") for line in recipe["requirements"]["host"][2:]] == build
    scripts = [f"{name} = {place}" for name, place in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["about"]["license_file"] == PROJECT["license-files"]
    assert recipe["source"]["url"].startswith("https://pypi.org/packages/source/h/habitus/")


def test_every_system_asks_for_wheels_of_the_pins(monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "tools")
    import wheels

    asked = []

    class Run:
        returncode = 1

    monkeypatch.setattr(wheels.subprocess, "run", lambda words, **more: asked.append(words) or Run)
    monkeypatch.setattr(sys, "argv", ["wheels.py", "--python", "3.12", "--extra", "usd"])
    with pytest.raises(SystemExit) as end:
        wheels.main()
    out = capsys.readouterr().out.splitlines()
    assert end.value.code == 1 and len(out) == len(wheels.SYSTEMS)
    assert all("no wheels of ezc3d>=1.7, " in line for line in out)
    whole = [
        words for words in asked if set(words) >= {*PROJECT["dependencies"], "usd-core>=24.11"}
    ]
    assert len(whole) == 2 * len(wheels.SYSTEMS) and all(
        "--only-binary" in words for words in asked
    )
    assert sum("--constraint" in words for words in whole) == len(wheels.SYSTEMS)
