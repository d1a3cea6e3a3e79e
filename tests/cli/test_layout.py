"""`habitus layout`: tables say what the layouts say, and a new layout file works."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from habitus.cli.layout import Check, New, Show, run
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.captures.read import read_capture
from habitus.io.layouts.draft import draft_layout, nearest_markers
from habitus.io.layouts.files import list_layouts, load_layout, match_layout, shipped_layouts
from habitus.io.layouts.toml import parse_layout
from habitus.markers.layouts import Marker


def printed(options):
    console = Console(width=200, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    run(options, console)
    return console.export_text()


def needs_body():
    from habitus.io.models.bodies import load_body

    try:
        load_body("default")
    except HabitusError as error:
        pytest.skip(f"the default body is not there: {error}")


def test_show_lists_every_layout():
    text = printed(Show())
    assert all(name in text for name in list_layouts())


@pytest.mark.parametrize("name", list_layouts())
def test_show_tells_every_marker(name):
    lines = printed(Show(name)).splitlines()
    for marker in load_layout(name).markers:
        assert any(line.startswith(f"{marker.label} ") and marker.place in line for line in lines)


def test_show_lists_landmarks():
    needs_body()
    assert "asis" in printed(Show(landmarks=True))


def test_check_tells_matches_and_corrections(shared):
    needs_body()
    text = printed(Check("auto", shared / "mocap" / "HDM_mm_01-02_03_120.c3d"))
    assert "cmu-41" in text and "41 of 41" in text and "RBAC sits 77 mm on the left side" in text
    text = printed(Check("vicon-53", shared / "mocap" / "HDM_mm_01-02_03_120.c3d"))
    assert (
        "vicon-53" in text
        and "not used: RFIN (unknown label)" in text
        and "not in the capture: ARIEL" in text
    )


def test_new_fills_in_what_is_known(shared, tmp_path):
    capture = read_capture(shared / "mocap" / "nick_freeform_001.c3d")
    text = printed(New(shared / "mocap" / "nick_freeform_001.c3d", out=tmp_path / "nick.toml"))
    assert "52 labels, 0 to do" in text
    layout = load_layout(tmp_path / "nick.toml")
    match = match_layout(capture.labels)
    assert {m.label: m.place for m in layout.markers} == {
        m.label: m.place for m in match.layout.markers
    }


def test_new_does_not_write_over_a_file(shared, tmp_path):
    capture = shared / "mocap" / "Running_0002.c3d"
    out = tmp_path / "run.toml"
    run(New(capture, out=out), Console(quiet=True))
    with pytest.raises(HabitusError, match="--overwrite"):
        run(New(capture, out=out), Console(quiet=True))
    run(New(capture, out=out, overwrite=True), Console(quiet=True))
    with pytest.raises(HabitusError, match=r"\.toml"):
        run(New(capture, out=tmp_path / "run.txt"), Console(quiet=True))


@pytest.mark.parametrize(
    "options",
    [Show("nothing"), Check("nothing", Path("gone.c3d")), New(Path("gone.c3d"), Path("x.toml"))],
)
def test_bad_input_is_one_line(options):
    with pytest.raises(HabitusError) as error:
        run(options, Console(quiet=True))
    assert "\n" not in str(error.value)


def test_a_draft_with_its_todo_lines_filled_in_is_a_layout():
    labels = ["LASI", "RASI", "odd one", 'quo"ted', "LKNE", "RKNE"]
    markers = np.random.default_rng(0).normal(size=(5, len(labels), 3))
    text = draft_layout("mine", "walk", labels, markers, shipped_layouts())
    first = parse_layout(text, "mine.toml", load_layout)
    assert first.labels == ("LASI", "RASI", "LKNE", "RKNE")
    assert text.count("# TODO") == 2
    filled = text.replace('# "odd one" = ""', '"odd one" = "c7"').replace(
        '# "quo\\"ted" = ""', '"quo\\"ted" = "t10"'
    )
    whole = parse_layout(filled, "mine.toml", load_layout)
    assert (
        whole["odd one"] == Marker("odd one", landmark="c7") and whole['quo"ted'].landmark == "t10"
    )


def test_nearest_markers_are_sorted_and_never_the_marker_itself():
    markers = np.zeros((3, 4, 3))
    markers[:, :, 0] = [0.0, 0.3, 0.1, np.nan]
    assert [column for column, _ in nearest_markers(markers, 0, range(4))] == [2, 1]


def test_names_in_a_layout_are_shown_and_not_obeyed(tmp_path, capsys):
    """A closing tag of rich's markup, escapes of a terminal: from a file that somebody sent."""
    text = (
        'name = "[/x]"\ntitle = "[bold]t\\u001b[31m"\ndescription = '
        '"[/]\\u0007"\n[markers]\n"[/L]" = "left_asis"\n'
    )
    (tmp_path / "odd.toml").write_text(text)
    main(["layout", "show", str(tmp_path / "odd.toml")])
    said = capsys.readouterr().out
    assert "[/x]" in said and "[bold]t" in said and "[/L]" in said
    assert set(filter(lambda one: not one.isprintable(), said)) == {"\n"}
