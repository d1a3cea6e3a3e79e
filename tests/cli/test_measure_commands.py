"""`habitus measure` and `habitus body`: what is printed, written and refused."""

import json

import pytest

from habitus.cli.main import main


def run(*arguments: str) -> int:
    try:
        main([str(word) for word in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def test_a_body_is_made_from_measurements_and_measured(tmp_path, capsys):
    out = tmp_path / "him.npz"
    assert (
        run("body", "--height", "1.78", "--weight", "80", "--also", "neck=0.38", "--out", out) == 0
    )
    said = capsys.readouterr().out
    assert (
        "height_m" in said
        and "178.0 cm" in said
        and said.count("38.0 cm") >= 2
        and "him.npz" in said
    )
    files = ["--out", tmp_path / "him.json", "--picture", tmp_path / "him.svg"]
    assert run("measure", out, *files) == 0
    said = capsys.readouterr().out
    assert "178.0 cm" in said and "hip girth" in said and "him.svg" in said
    values = json.loads((tmp_path / "him.json").read_text())["measurements"]
    assert values["mass_kg"] == pytest.approx(80, rel=0.01)
    assert values["neck_circumference_m"] == pytest.approx(0.38, rel=0.01)


def test_rare_people_get_a_remark_and_impossible_ones_a_refusal(capsys):
    assert run("body", "--height", "1.55", "--weight", "110") == 0
    assert "rare" in capsys.readouterr().out
    assert run("body", "--height", "1.78", "--weight", "20") == 2
    assert "standard deviations" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("body", "--also", "neck"), "--also neck: expected NAME=VALUE"),
        (("body", "--also", "settings=3"), "'settings' is no measurement"),
        (("body", "--height", "178"), "give metres"),
        (("measure", "nowhere.npz"), "nowhere.npz"),
        (("measure", "default", "--out", "a.txt"), "expected a name in .json, .csv, .smis"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    assert run(*arguments) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("more", "notes"), [((), 1), (("--also", "waist_girth=0.75"), 0), (("--hip", "1.0"), 1)]
)
def test_a_waist_is_said_to_be_at_the_navel(more, notes, capsys):
    """A tailor's waist, where none is given, is another: 5 cm less on women."""
    main(["body", "--height", "1.7", "--sex", "female", "--waist", "0.8", *more])
    assert capsys.readouterr().out.count("a tailor's waist is --also waist_girth=") == notes
