"""Behaviour of Windows and macOS, emulated on this system: files in use that cannot be replaced,
case-insensitive disks, consoles with small character sets, workers that are not forked.
"""

import ast
import os
import pickle
import subprocess
import sys
from pathlib import Path, PureWindowsPath

import numpy as np
import pytest
from planted import plant
from synthetic_fit import synthetic_fit, tube_body
from windows_files import SUPPORTED, as_on_windows

import habitus as hb
from habitus.cli.main import COMMANDS
from habitus.errors import HabitusError
from habitus.files import files_together, locked, whole_folder
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.io.names import file_name, inside, one_file
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.jobs.comparing import _way
from habitus.jobs.finding import find_captures
from habitus.jobs.results import capture_folders
from habitus.mesh.registrations import Registrations
from habitus.parallel import blocks
from habitus.report.index import _row

SOURCES = sorted((Path(hb.__file__).parent).rglob("*.py"))


@pytest.fixture
def windows():
    if not SUPPORTED:
        pytest.skip("this system does not say which files are open")
    with as_on_windows():
        yield


def test_an_open_file_is_guarded(windows, tmp_path):
    path = tmp_path / "a"
    with path.open("w"), pytest.raises(PermissionError):
        path.unlink()
    (tmp_path / "b").touch()
    with pytest.raises(FileExistsError):
        os.rename(path, tmp_path / "b")
    os.replace(path, tmp_path / "b")


def test_a_lock_leaves_neither_file_nor_new_folder(windows, tmp_path):
    with locked(tmp_path / "out"):
        assert (tmp_path / "out").is_dir()
    assert not (tmp_path / "out").exists()
    with locked(tmp_path / "out"):
        (tmp_path / "out" / "result").touch()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["result"]


def test_folders_and_files_replace_older_ones(windows, tmp_path):
    for text in ("older", "newer"):
        with whole_folder(tmp_path / "out") as partial:
            (partial / "one").write_text(text)
        with files_together(tmp_path / "out", ("three",)) as partial:
            (partial / "two").write_text(text)
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == {
        "one": "newer",
        "two": "newer",
    }


def test_results_are_written_over_what_was_read(windows, tmp_path):
    """As `habitus export results/walk/body.npz --out results/walk/body.npz` does."""
    fit = synthetic_fit(frames=4)
    fit.save(tmp_path / "walk")
    again = hb.load_fit(tmp_path / "walk" / "body.npz", fit.body)
    again.save(tmp_path / "walk")
    again.export(tmp_path / "walk" / "body.npz")
    assert np.array_equal(hb.load_fit(tmp_path / "walk" / "body.npz", fit.body).pose, fit.pose)


@pytest.mark.parametrize("name", ["walk.c3d", "WALK.C3D"])
def test_a_capture_is_written_over_itself(windows, tmp_path, name):
    planted = plant(frames=3)
    path = tmp_path / name
    labels = planted.layout.labels
    for _ in range(2):
        write_c3d(Capture("walk", labels, planted.observed, 60.0, "+y"), path)
        hb.read_capture(path)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["people.npz", "people"])
def test_registrations_are_written_into_an_empty_folder(windows, tmp_path, name):
    body = tube_body()
    surface = np.asarray(body().vertices)[None]
    data = Registrations(surface, np.asarray(body.faces), ("ann",), ("",), ("pose",), ("one",))
    if name == "people":
        (tmp_path / name).mkdir()
    write_registrations(data, tmp_path / name)
    assert open_registrations(tmp_path / name).subject == ("ann",)


def test_a_long_array_needs_no_call_of_posix(monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    monkeypatch.setattr(blocks, "IN_MEMORY", 10)
    array = blocks.empty_array((5, 4))
    array[:] = np.arange(20).reshape(5, 4)
    assert blocks.is_file_backed(array) and array.sum() == 190


def test_names_that_differ_in_case_are_one_file_where_the_disk_says_so(tmp_path, monkeypatch):
    names = ["Walk", "walk", "run", "re\u0301sume\u0301", "r\u00e9sum\u00e9"]
    assert one_file(names, tmp_path / "out") == []
    exists = os.path.exists
    monkeypatch.setattr(os.path, "exists", lambda path: exists(path) or _by_case(Path(path)))
    assert set(one_file(names, tmp_path / "out")) == set(names) - {"run"}
    for path in (tmp_path / "in" / "Walk.c3d", tmp_path / "in" / "walk.trc"):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    found = find_captures([tmp_path / "in"], tmp_path / "out")
    assert {capture.name for capture in found} == {"Walk_c3d", "walk_trc"}
    captures = [Capture(name, ("a",), np.zeros((1, 1, 3)), 1.0, "+y") for name in ("Walk", "walk")]
    with pytest.raises(HabitusError, match="Walk, walk"):
        capture_folders(tmp_path / "out", captures, False)


def test_a_drive_that_is_missing_has_no_rule_of_names(tmp_path, monkeypatch):
    monkeypatch.setattr(os.path, "exists", lambda path: False)
    assert one_file(["Walk", "walk"], tmp_path / "out") == []


def _by_case(path: Path) -> bool:
    """Whether a name of other case is in the same folder."""
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    return path.name.casefold() in {name.casefold() for name in names}


@pytest.mark.parametrize("name", ["con", "NUL.c3d", "com1.npz", "aux .txt", "LPT².txt", "CONIN$"])
def test_devices_are_no_names_of_files(name):
    assert file_name(name).startswith("_")


@pytest.mark.parametrize(
    "path", ["C:x", "C:/x", "/x", "\\\\host\\share\\x", "..\\x", "a\\..\\..\\x"]
)
def test_drives_and_shares_lead_out_of_a_folder(path, monkeypatch):
    monkeypatch.setattr("habitus.io.names.PurePath", PureWindowsPath)
    with pytest.raises(HabitusError, match="leads out"):
        inside(path)


def test_pages_on_two_drives_are_linked(tmp_path, monkeypatch):
    assert _way(tmp_path / "a", tmp_path / "b" / "x.html") == "../b/x.html"

    def relpath(path, start):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", relpath)
    assert _way(tmp_path, tmp_path / "x.html") == (tmp_path / "x.html").as_uri()


def test_a_path_with_slashes_is_a_layouts_file(monkeypatch):
    monkeypatch.setattr("habitus.io.layouts.files.os.sep", "\\")
    with pytest.raises(HabitusError, match="no layout file"):
        load_layout("mine/cmu-41")


def test_every_help_and_answer_fits_a_console_with_a_small_character_set(tmp_path):
    """Code page 1252 without UTF-8 mode, as a pipe of Windows has it, and ASCII."""
    commands = [[name, "--help"] for name in COMMANDS]
    commands += [["layout", "show"], ["layout", "show", "cmu-41"], ["measure", "female"]]
    commands += [["doctor"], ["measure", "Ω→.obj"], ["mosh", "Ж.c3d", "--out", str(tmp_path / "Ж")]]
    code = f"""
import sys
from habitus.cli.main import main
for words in {commands!a}:
    try:
        main(words)
    except SystemExit as end:
        assert end.code in (0, 2, None), (words, end.code)
"""
    for encoding in ("cp1252", "ascii"):
        plain = {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0", "LC_ALL": "C.UTF-8"}
        run = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, **plain}, capture_output=True
        )
        assert run.returncode == 0, run.stderr.decode(encoding)
        assert "height_m" in run.stdout.decode(encoding)


def test_text_is_opened_with_an_encoding_and_processes_are_spawned():
    """macOS and Windows fork no worker, so that what is handed to one has to be pickled anywhere."""
    wrong = [
        f"{path}:{node.lineno}: {ast.unparse(node)[:80]}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and _of_this_system(node)
    ]
    assert not wrong, "\n".join(wrong)


def _of_this_system(call: ast.Call) -> bool:
    called = ast.unparse(call.func)
    given = {keyword.arg for keyword in call.keywords}
    if called in ("multiprocessing.Process", "multiprocessing.Pool", "os.fork"):
        return True
    if called.endswith("ProcessPoolExecutor"):
        return "mp_context" not in given
    modes = [part.value for part in call.args if isinstance(part, ast.Constant)]
    is_text = any(mode in ("r", "w", "a", "rt", "wt", "x") for mode in modes)
    packed = "archive" in called or "zip" in called  # members are bytes
    return (
        (called == "open" or called.endswith(".open"))
        and is_text
        and not (packed or "encoding" in given)
    )


@pytest.mark.parametrize(
    ("text", "is_wrong"),
    [
        ("open('a', 'w')", True),
        ("path.open('w', encoding='utf-8')", False),
        ("multiprocessing.Process(target=f)", True),
        ("context.Process(target=f)", False),
        ("ProcessPoolExecutor(2)", True),
    ],
)
def test_calls_of_this_system_are_found(text, is_wrong):
    call = ast.parse(text, mode="eval").body
    assert isinstance(call, ast.Call) and _of_this_system(call) == is_wrong


def test_what_workers_are_handed_is_pickled():
    """Layouts, recipes, settings and errors; bodies are sent in tests/jobs/archive."""
    for thing in (load_layout("cmu-41"), hb.Mosh(), hb.FitSettings(), hb.MoshWeights()):
        assert pickle.loads(pickle.dumps(thing)) == thing
    error = pickle.loads(pickle.dumps(HabitusError("text")))
    assert isinstance(error, HabitusError) and str(error) == "text"


def test_pages_link_results_by_slashes():
    assert "href='ann/walk/report.html'" in _row(PureWindowsPath("ann\\walk"), None)
