"""The command line: bad input is one clear line and exit code 2; good input is four whole files."""

import importlib
import importlib.util
import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numba
import numpy as np
import pytest
from synthetic import synthetic_body

from habitus.cli.main import COMMANDS, main
from habitus.cli.screen import NOTICE, compilation_notice
from habitus.errors import HabitusError
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_capture
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body, save_body

ROOT = Path(__file__).resolve().parents[2]
FILES = {"body.npz", "body.glb", "metrics.json", "report.html"}
ODD = (
    "1123x01EMG BKINtechnologies C3DRotationExample Dance Eb015si Eb015sr Empty Facial-Sing "
    "MACsample MotionMonitorC3D "
    "Optotrak Res16bits Walking_Hybrid_2 badParameterOffset bad_parameter_section dec_int "
    "dec_real duplicate_labels "
    "emgwl golfswing mocap36 parameterOverflow phasespace_sample sgi_int sgi_real short-copy "
    "simple type1 type2a type3"
).split()
FRAMES = 40


@pytest.fixture(scope="session")
def body():
    try:
        return load_body("default")
    except HabitusError as error:
        pytest.skip(f"the default body is not there: {error}")


@pytest.fixture(scope="session")
def demo():
    spec = importlib.util.spec_from_file_location("demo", ROOT / "examples" / "demo.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def capture(body, demo) -> Capture:
    """A synthetic capture with the MoSh 67 set."""
    truth, labels = demo.make_capture(body, FRAMES, 1)
    kept = [k for k, marker in enumerate(load_layout("mosh-67").markers) if not marker.optional]
    return Capture("walk", tuple(labels[k] for k in kept), truth.observed[:, kept], 120.0, "+y")


@pytest.fixture
def quick(monkeypatch):
    """A hasty shape stage: these tests ask what is written and said, not how well the body fits."""
    monkeypatch.setattr(
        "habitus.jobs.mosh.MoshSettings", partial(MoshSettings, annealing=(10.0,), frames=3)
    )


@pytest.fixture(scope="session")
def walk(capture, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("captures") / "walk.c3d"
    write_c3d(capture, path)
    return path


@pytest.fixture
def run(capsys, tmp_path):
    """Runs the command in this process: its exit code (0 where it just returns) and what it said on
    stderr.
    """

    def call(*arguments, out=tmp_path / "out"):
        capsys.readouterr()
        try:
            main([str(a) for a in (*arguments, *(() if out is None else ("--out", out)))])
            code = 0
        except SystemExit as end:
            code = end.code
        return code, capsys.readouterr().err.removeprefix(
            f"{NOTICE}\n"
        )  # where kernels were compiled just now

    return call


def refused(answer, *words: str) -> None:
    """The answer is exit code 2 and one line that starts with the program's name and holds these
    words.
    """
    code, said = answer
    assert code == 2, said
    assert said.startswith("habitus: ") and said.count("\n") == 1 and "Traceback" not in said, said
    for word in words:
        assert word in said


def written(markers: np.ndarray, labels: tuple[str, ...], folder: Path, name: str = "odd") -> Path:
    path = folder / f"{name}.c3d"
    write_c3d(Capture(name, labels, np.array(markers, dtype=float), 120.0, "+y"), path)
    return path


def with_markers(capture: Capture, markers: np.ndarray, folder: Path) -> Path:
    return written(markers, capture.labels, folder)


# -- good input ------------------------------------------------------------------------------------


def test_a_capture_becomes_four_whole_files(walk, run, tmp_path):
    code, said = run("mosh", walk)
    assert (code, said) == (0, "")
    folder = tmp_path / "out" / "walk"
    assert {path.name for path in folder.iterdir()} == FILES
    numbers = json.loads((folder / "metrics.json").read_text())
    assert numbers["frames"] == FRAMES and numbers["markers"] == 67
    assert (
        numbers["verdict"]["level"] == "good" and "on average" in numbers["verdict"]["reasons"][0]
    )
    assert (
        numbers["marker_error_mm"]["soft_tissue"]["mean"]
        < numbers["marker_error_mm"]["pose"]["mean"]
        < 15
    )
    with np.load(folder / "body.npz") as arrays:
        assert arrays["poses"].shape == (FRAMES, 72) and np.isfinite(arrays["poses"]).all()


def test_python_gives_what_the_command_gives(quick, walk, run, tmp_path):
    import habitus

    assert run("mosh", walk, "--soft-tissue", "none", "--quiet")[0] == 0
    (fit,) = habitus.mosh(walk, soft_tissue=False)
    with np.load(tmp_path / "out" / "walk" / "body.npz") as arrays:
        np.testing.assert_allclose(arrays["trans"], fit.trans, atol=1e-5)
        np.testing.assert_allclose(arrays["betas"], fit.betas, atol=1e-4)


def test_quiet_says_nothing(quick, walk, run, capsys):
    assert run("mosh", walk, "--soft-tissue", "none", "--quiet") == (0, "")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("strict", "code"), [((), 0), (("--strict",), 3)])
def test_a_fit_that_failed_counts_where_it_is_to(quick, walk, run, tmp_path, strict, code):
    assert run("mosh", walk, "--soft-tissue", "none", "--fps", "15000", *strict)[0] == code
    verdict = json.loads((tmp_path / "out" / "walk" / "metrics.json").read_text())["verdict"]
    assert verdict["level"] == "failed" and any(
        "15000 frames a second" in reason for reason in verdict["reasons"]
    )


def test_ctrl_c_leaves_finished_captures_whole(quick, capture, run, tmp_path, monkeypatch):
    from habitus.fit.markers import recipe as mosh

    whole = mosh.fit_recording
    calls = []

    def stopped_in_the_second(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(mosh, "fit_recording", stopped_in_the_second)
    first, second = (
        written(capture.markers[:20], capture.labels, tmp_path, name)
        for name in ("first", "second")
    )
    code, said = run("mosh", first, second, "--soft-tissue", "none")
    assert code == 130 and said.count("\n") == 1 and "Traceback" not in said
    assert {path.name for path in (tmp_path / "out" / "first").iterdir()} == FILES
    assert not (tmp_path / "out" / "second").exists()


# -- bad captures ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ODD)
def test_odd_files_are_a_result_or_one_clear_line(quick, name, shared, body, run, tmp_path):
    path = next(path for path in (shared / "mocap-odd").iterdir() if path.stem == name)
    code, said = run("mosh", path, "--soft-tissue", "none", "--quiet")
    if code:
        refused((code, said), name)
    else:
        assert {file.name for file in (tmp_path / "out" / path.stem).iterdir()} == FILES
        with np.load(tmp_path / "out" / path.stem / "body.npz") as arrays:
            assert np.isfinite(arrays["poses"]).all() and np.isfinite(arrays["trans"]).all()


def test_every_odd_file_is_named_above(shared):
    assert sorted(ODD) == sorted(path.stem for path in (shared / "mocap-odd").iterdir())


def test_nothing_but_gaps(capture, run, tmp_path):
    refused(
        run("mosh", with_markers(capture, np.full_like(capture.markers, np.nan), tmp_path)),
        "odd",
        "missing",
    )


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_few_frames_are_enough(quick, frames, capture, run, tmp_path):
    path = with_markers(capture, capture.markers[:frames], tmp_path)
    code, said = run("mosh", path, "--quiet")
    if code:
        refused((code, said), "odd")
    else:
        assert {file.name for file in (tmp_path / "out" / "odd").iterdir()} == FILES


def test_one_marker(capture, run, tmp_path):
    path = written(capture.markers[:, :1], capture.labels[:1], tmp_path)
    refused(run("mosh", path), "odd", "expected at least")
    refused(run("mosh", path, "--layout", "mosh-67"), "odd", "expected at least")


def test_labels_that_nobody_knows(capture, run, tmp_path):
    path = written(capture.markers, tuple(f"Q{k}" for k in range(67)), tmp_path)
    refused(run("mosh", path), "odd", "Q0", "--layout")


def test_never_enough_markers_at_once(capture, run, tmp_path):
    markers = np.full((3 * 67, 67, 3), np.nan)
    for k in range(67):
        markers[3 * k : 3 * k + 3, k] = capture.markers[:3, k]
    refused(run("mosh", with_markers(capture, markers, tmp_path)), "odd", "expected at least")


@pytest.mark.parametrize("content", [b"hello, this is no capture\n" * 40, b"\x02\x50", bytes(600)])
def test_files_that_only_look_like_captures(content, run, tmp_path):
    path = tmp_path / "text.c3d"
    path.write_bytes(content)
    refused(run("mosh", path), "text.c3d")


@pytest.mark.parametrize(
    ("name", "words"),
    [("none.c3d", "no such file"), ("notes.docx", "expected one of"), ("", "folder")],
)
def test_paths_that_are_no_captures(name, words, run, tmp_path):
    if name.endswith("docx"):
        (tmp_path / name).write_text("notes")
    refused(run("mosh", tmp_path / name), words)


def test_one_bad_capture_among_good_ones_is_named_and_left_behind(quick, walk, run, tmp_path):
    (tmp_path / "bad.c3d").write_text("text")
    code, said = run(
        "mosh", walk, tmp_path / "bad.c3d", tmp_path / "none.c3d", "--soft-tissue", "none"
    )
    assert code == 1 and said.count("\n") == 2 and "bad.c3d" in said and "none.c3d" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"walk", "index.html"}
    assert {path.name for path in (tmp_path / "out" / "walk").iterdir()} == FILES


def test_captures_of_one_name_do_not_overwrite_each_other(walk, run, tmp_path):
    (tmp_path / "again").mkdir()
    other = tmp_path / "again" / "walk.c3d"
    other.write_bytes(walk.read_bytes())
    refused(run("mosh", walk, other), "walk", "expected")


# -- bad options -----------------------------------------------------------------------------------


def test_no_capture(run):
    refused(run("mosh"), "no capture", "expected")


def test_a_file_where_the_folder_should_be(walk, run, tmp_path):
    (tmp_path / "taken").write_text("a file")
    refused(run("mosh", walk, out=tmp_path / "taken"), "taken", "--out")
    refused(run("mosh", walk, out=tmp_path / "taken" / "below"), "taken", "--out")


def test_a_file_where_the_captures_folder_should_be(quick, walk, run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "walk").write_text("a file")
    refused(run("mosh", walk, "--soft-tissue", "none"), "walk")


def test_a_name_that_the_system_refuses_is_one_line(run, tmp_path):
    refused(run("measure", tmp_path / f"{'x' * 300}.npz"), "File name too long", "check the path")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--layout", "nonsense"], ["nonsense", "cmu-41"]),
        (["--layout", "nonsense.toml"], ["nonsense.toml"]),
        (["--layout", "BROKEN.toml"], ["BROKEN.toml"]),
        (["--body", "nobody.npz"], ["nobody.npz"]),
        (["--body", "nobody"], ["nobody"]),
        (["--body", "BROKEN.npz"], ["BROKEN.npz"]),
        (["--body", "BROKEN.pkl"], ["BROKEN.pkl"]),
        (["--sex", "female", "--body", "foreign.npz"], ["foreign", "no female model"]),
        (["--hold-out", "NOSE"], ["NOSE", "matched labels"]),
        (["--hold-out-every", "1"], ["1", "expected 2 to 67"]),
        (["--hold-out-every", "1000"], ["1000", "expected 2 to 67"]),
        (["--subject", "Nobody"], ["Nobody", "found"]),
        (["--fps", "0"], ["rate"]),
        (["--fps", "-5"], ["rate"]),
    ],
)
def test_options_that_nothing_can_be_done_with(options, words, walk, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_body(synthetic_body("smpl", 200), tmp_path / "foreign.npz")
    for ending in ("toml", "npz", "pkl"):
        (tmp_path / f"BROKEN.{ending}").write_text("neither = nor [")
    refused(run("mosh", walk, *options), *words)


def test_holding_out_every_marker(capture, walk, run):
    refused(run("mosh", walk, "--hold-out", *capture.labels), "all 67 markers")


@pytest.mark.parametrize(
    "options", [["--sex", "other"], ["--seed", "one"], ["--frobnicate"], ["--fps", "fast"]]
)
def test_options_that_do_not_exist(options, walk, run):
    code, said = run("mosh", walk, *options)
    assert code == 2 and options[0] in said and "Traceback" not in said


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (["body", "--gender", "female"], "--sex"),
        (["mosh", "walk.c3d", "--gender=female"], "--sex"),
        (["export", "walk.npz", "--to", "walk.fbx"], "--out"),
        (["mosh", "walk.c3d", "--rate", "120"], "--fps"),
        (["body", "--heigth", "1.7"], "--height"),
        (["archive", "data", "--worker", "4"], "--workers"),
    ],
)
def test_an_option_of_another_name_is_named(words, near, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    said = capsys.readouterr().err
    assert end.value.code == 2 and near in said and said.count("\n") == 1


# -- help, and the command as users start it -------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "mosh layout body.npz body.glb metrics.json report.html"),
        (
            ["mosh"],
            "CAPTURE --out --layout --body --sex --soft-tissue --causal --hold-out "
            "--hold-out-every --seed",
        ),
        (["layout"], "show check new"),
    ],
)
def test_help_reads_well(arguments, words, capsys):
    with pytest.raises(SystemExit) as end:
        main([*arguments, "--help"])
    said = capsys.readouterr()
    assert end.value.code == 0 and said.err == ""
    assert all(word in said.out for word in words.split()) and "tyro" not in said.out


@pytest.mark.parametrize("argument", ["--help", "--version", "mosh"])
def test_help_comes_at_once(argument):
    """The true figures are benchmarks/startup.py's; this one leaves room for busy machines."""
    began = time.perf_counter()
    arguments = [argument] if argument.startswith("-") else [argument, "--help"]
    done = subprocess.run(
        [sys.executable, "-m", "habitus", *arguments], capture_output=True, text=True
    )
    assert time.perf_counter() - began < 2.0
    assert (
        done.returncode == 0
        and done.stderr == ""
        and ("usage" in done.stdout or done.stdout[0].isdigit())
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["mohs"], "no command 'mohs' did you mean habitus mosh?"),
        (["evalute", "x"], "'evalute' did you mean habitus evaluate?"),
        (["qqq"], "mosh, layout, train, evaluate --help"),
        ([], "no command was given"),
    ],
)
def test_commands_that_do_not_exist(arguments, words, run):
    refused(run(*arguments, out=None), *words.split())


def test_every_command_of_the_help_is_there():
    for name in COMMANDS:
        module = importlib.import_module(f"habitus.cli.{name.replace('-', '_')}")
        assert callable(module.run) and module.OPTIONS and module.ABOUT


@pytest.mark.parametrize("place", [0, 1, 2])
def test_verbose_shows_where_an_error_was_raised(place, run, tmp_path):
    arguments = ["mosh", tmp_path / "none.c3d"]
    arguments.insert(place, "-v" if place else "--verbose")
    code, said = run(*arguments)
    assert (
        code == 2 and said.startswith("Traceback") and said.splitlines()[-1].startswith("habitus: ")
    )


def test_compilation_is_told_once_and_only_where_there_is_some(capsys):
    @numba.njit
    def first(x):
        return x + 1

    @numba.njit
    def second(x):
        return x - 1

    with compilation_notice():
        first(1), second(2), first(3)
    assert capsys.readouterr().err == f"{NOTICE}\n"
    with compilation_notice():
        first(4)
    with compilation_notice(quiet=True):
        second(4.5)
    assert capsys.readouterr().err == ""


def test_python_m_habitus_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "habitus", "--help"], capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stderr == "" and done.stdout.startswith("usage: habitus ")


def test_a_bad_file_ends_the_process_with_two(tmp_path):
    (tmp_path / "text.c3d").write_text("no capture")
    command = [
        sys.executable,
        "-m",
        "habitus",
        "mosh",
        str(tmp_path / "text.c3d"),
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    refused((done.returncode, done.stderr), "text.c3d")


def test_what_is_written_can_be_read_again(walk, capture):
    again = read_capture(walk)
    assert again.labels == capture.labels
    np.testing.assert_allclose(again.markers, capture.markers, atol=1e-6)
