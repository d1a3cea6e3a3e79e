"""How results are printed: one line in a pipe, an uncut table on a terminal, names that no terminal
obeys.
"""

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from habitus.cli.screen import closing, exit_code, print_outcome, print_table, result_line, say
from habitus.errors import HabitusError
from habitus.jobs.batch import Outcome

LONG = "a_capture_with_a_name_that_is_longer_than_any_column_of_a_table_would_like_it_to_be"


def numbers(**more):
    stage = {"mean": 5.61, "median": 4.0, "p95": 11.24, "max": 30.0, "per_marker": {}}
    return {
        "frames": 810,
        "markers": 41,
        "marker_error_mm": {"pose": stage | {"mean": 7.0}, "soft_tissue": stage},
        "held_out_error_mm": None,
        "suspect_markers": [{"label": "LWRA", "reason": "swapped", "frames": 3}],
        "stage_seconds": {"total": 12.34},
        "body_measurements": {"height_m": 1.784, "mass_kg": 75.1},
        "warnings": [],
    } | more


def outcome(name="walk", **more):
    return Outcome(Path(f"{name}.c3d"), name, Path("results") / name, numbers(**more))


def printed(action, width=None):
    """What is printed on a terminal of a width, or without one in a pipe; without colours."""
    console = Console(file=io.StringIO(), force_terminal=width is not None, width=width or 1 << 16)
    action(console)
    return re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue())


def test_a_pipe_gets_one_line_a_capture():
    said = printed(
        lambda console: print_outcome(
            outcome(verdict={"level": "good", "reasons": ["It follows."]}), console
        )
    )
    assert (
        said == "walk: 810 frames, 41 markers, error 5.6 mm, height 1.78 m, good, "
        "results/walk/report.html\n"
    )


def test_a_fit_that_is_not_good_says_why_and_counts_where_it_is_to():
    failed = outcome(
        verdict={
            "level": "failed",
            "reasons": ["It is 18.6 m tall.", "No limb is where it should be."],
        }
    )
    good = outcome(verdict={"level": "good", "reasons": ["It follows the markers."]})
    assert "failed walk: It is 18.6 m tall. No limb is where it should be.\n" in printed(
        lambda c: print_outcome(failed, c)
    )
    assert "It follows" not in printed(lambda console: print_outcome(good, console))
    assert (
        exit_code([good, failed], strict=True) == 3
        and exit_code([failed]) == exit_code([good], strict=True) == 0
    )


def test_without_a_verdict_or_numbers_the_line_says_less():
    bare = numbers(
        marker_error_mm={"pose": {"mean": None}, "soft_tissue": None}, body_measurements={}
    )
    line = result_line(Outcome(Path("a.c3d"), "a", Path("out/a"), bare))
    assert line == "a: 810 frames, 41 markers, error – mm, height – m, out/a/report.html"


@pytest.mark.parametrize("width", [30, 60, 80, 120, 400])
def test_nothing_is_ever_cut_on_a_terminal(width):
    outcomes = [outcome(), outcome(LONG, verdict={"level": "failed", "reasons": []})]
    said = printed(lambda console: print_table(outcomes, console), width)
    together = re.sub(r"\s+", "", said)
    for words in (
        LONG,
        "report.html",
        "5.6",
        "11.2",
        "1.78",
        "75.1",
        "12.3",
        "failed",
        "810",
        "41",
    ):
        assert words in together, words
    assert "…" not in said
    for heading in ("error", "p95", "height", "mass", "suspects"):
        assert heading in said
    assert said.count("\n") == 3 if width == 400 else said.count("\n") > 3


def test_columns_without_content_are_left_out():
    assert "verdict" not in printed(lambda console: print_table([outcome()], console), 400)
    held = outcome(held_out_error_mm={"pose": {"mean": 9.87}, "soft_tissue": None})
    assert "9.9" in printed(lambda console: print_table([held], console), 400)


def test_names_from_files_do_not_rule_the_terminal():
    evil = "\x1b[31mred\x07 [bold]x[/] \u202eabc\udcff\nnext"
    for width in (None, 60, 400):
        nasty = outcome(evil, warnings=[evil])
        said = printed(
            lambda console, nasty=nasty: (
                print_outcome(nasty, console),
                print_table([nasty], console),
            ),
            width,
        )
        assert said.isprintable() or set(filter(lambda c: not c.isprintable(), said)) == {"\n"}
        assert "[bold]x[/]" in said and "\\x1b[31mred" in said.replace("\n", "")
    assert printed(lambda console: say(console, evil)).count("\n") == 1


def test_failures_are_told_on_stderr_with_their_paths(capsys):
    bad = Outcome(Path("deep/bad.c3d"), "bad", error=HabitusError("bad.c3d: not a C3D file"))
    crash = Outcome(Path("deep/odd.c3d"), "odd", error=ZeroDivisionError("division\nby zero"))
    other = Outcome(
        Path("deep/notes.csv"), "notes", error=HabitusError("notes.csv: no capture"), left_out=True
    )
    said = printed(lambda console: [print_outcome(one, console) for one in (bad, crash, other)])
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "habitus: deep/bad.c3d: not a C3D file"
    assert lines[1].startswith(
        "habitus: deep/odd.c3d: ZeroDivisionError: division\\x0aby zero; this is a fault of habitus"
    )
    assert len(lines) == 2 and said == "note left out: deep/notes.csv: no capture\n"
    assert closing([outcome(), bad, crash, other], Path("out")) == (
        "1 capture fitted, 2 failed, 1 that are no captures skipped; results are in out"
    )
    assert exit_code([outcome(), other]) == 0 and exit_code([outcome(), bad]) == 1
