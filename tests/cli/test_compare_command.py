"""`habitus compare`: what is written, said and refused; the same from Python."""

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

import habitus
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.jobs.comparing import distinct_names


def run(*arguments: object) -> int:
    try:
        main([str(word) for word in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder of each result: a fit, the same 20 mm aside, and in AMASS's style."""
    root = tmp_path_factory.mktemp("results")
    fit = synthetic_fit(4, body=load_body("default"), body_name="default", soft=False)
    for name, one in {
        "one": fit,
        "other": replace(fit, trans=fit.trans + np.array([0.02, 0, 0])),
    }.items():
        one.export(root / name / "walk" / "body.npz")
    (root / "one" / "walk" / "report.html").write_text("")
    return root


def test_two_results_are_compared(results, tmp_path, capsys):
    out = tmp_path / "compared"
    assert run("compare", results / "one" / "walk", results / "other" / "walk", "--out", out) == 0
    said = capsys.readouterr().out
    assert "A: one" in said and "B: other" in said and "compare.html" in said
    assert [line.split()[1:3] for line in said.splitlines() if line.startswith("skin")] == [
        ["20.0", "mm"]
    ]
    told = json.loads((out / "compare.json").read_text())
    assert (
        told["skin_mm"]["mean"] == pytest.approx(20, abs=1e-2)
        and told["shape_at_rest_mm"]["max"] == 0
    )
    assert told["measurements"]["height_m"]["difference"] == 0 and told["b"]["name"] == "other"
    page = (out / "compare.html").read_text("utf-8")
    assert "Report of A" in page and "Report of B" not in page and str(results) not in page


def test_nothing_is_written_unless_asked(results, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("compare", results / "one" / "walk", results / "one" / "walk" / "body.npz") == 0
    assert "0.0 mm" in capsys.readouterr().out and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere.npz",), "nowhere.npz"),
        (("{}",), "without body.npz"),
        (("{}/one/walk", "--offset", "9"), "no moment in common"),
        (("{}/one/walk/report.html",), "report.html"),
    ],
)
def test_bad_input_is_one_line(words, said, results, capsys):
    first = results / "other" / "walk"
    assert run("compare", first, *(word.format(results) for word in words)) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_from_python_with_fits_in_memory(tmp_path):
    fit = synthetic_fit(6)
    found = habitus.compare(fit, replace(fit, capture_name="again"))
    assert (
        found.names == ("walk", "again")
        and found.numbers["skin_mm"]["mean"] < 1e-6
        and not found.notes
    )
    assert found.save(tmp_path).name == "compare.html" and (tmp_path / "compare.json").exists()
    with pytest.raises(HabitusError, match="align is 'no'"):
        habitus.compare(fit, fit, align="no")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (("r/a/walk", "r/b/walk"), ("a", "b")),
        (("r/walk", "r/walk"), ("walk", "walk")),
        (("r/walk.npz", "r/run.npz"), ("walk.npz", "run.npz")),
        (("a/x/walk.npz", "b/y/walk.npz"), ("a/x", "b/y")),
    ],
)
def test_names_tell_paths_apart(paths, names, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert distinct_names(*paths) == names
