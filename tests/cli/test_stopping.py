"""Ctrl-C, a pipe that is closed and terminals of few characters: one line or none, never a
traceback.
"""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import tomllib
from pathlib import Path

import pytest

from habitus.cli.main import Stop, main, on_ctrl_c


def command(*arguments, code="", **options):
    """The command in a process of its own, with something done before."""
    begin = textwrap.dedent(code) + "\nfrom habitus.cli.main import main\nmain()"
    return subprocess.Popen(
        [sys.executable, "-c", begin, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


STOPS_AT = """
    import os, signal, sys
    class Finder:
        def find_spec(self, name, path=None, target=None):
            if name == sys.argv[-1]:
                os.kill(os.getpid(), signal.SIGINT)
    sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize(
    "module", ["tyro", "habitus.cli.mosh", "numpy", "numba", "scipy", "habitus.jobs.batch"]
)
def test_ctrl_c_while_modules_are_imported_is_one_line(module, tmp_path):
    code = STOPS_AT.replace("sys.argv[-1]", repr(module))
    process = command("mosh", tmp_path / "none.c3d", "--out", tmp_path / "out", code=code)
    out, said = process.communicate(timeout=60)
    assert (process.returncode, out, said) == (130, "", "habitus: stopped; nothing was written\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("module", ["habitus.cli", "habitus.cli.main"])
def test_ctrl_c_in_the_first_moment_is_one_line(module):
    code = STOPS_AT.replace("sys.argv[-1]", repr(module))
    begin = textwrap.dedent(code) + "\nfrom habitus.__main__ import start\nstart()"
    process = subprocess.Popen(
        [sys.executable, "-c", begin, "--version"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    out, said = process.communicate(timeout=60)
    assert (process.returncode, out, said) == (130, "", "habitus: stopped; nothing was written\n")


def test_the_command_is_that_which_handles_ctrl_c_first():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert project["project"]["scripts"]["habitus"] == "habitus.__main__:start"


def test_ctrl_c_at_work_is_an_exception_and_a_second_one_the_end():
    stop = Stop(begun=True)
    with pytest.raises(KeyboardInterrupt):
        stop(signal.SIGINT, None)
    code = """
        import os, signal
        from habitus.cli.main import Stop, on_ctrl_c
        stop = Stop(left=lambda: "much is left", begun=True, asked=True)
        with on_ctrl_c(stop, stays=False):
            os.kill(os.getpid(), signal.SIGINT)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (130, "habitus: stopped; much is left\n")


def test_ctrl_c_that_somebody_swallows_is_still_a_stop(monkeypatch, capsys):
    """A module that is imported late may make another exception of it."""
    from habitus.cli import mosh

    def swallowing(options):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt as error:
            raise ImportError("no such thing") from error

    monkeypatch.setattr(mosh, "run", swallowing)
    with pytest.raises(SystemExit) as end:
        main(["mosh", "none.c3d", "--out", "nowhere"])
    said = capsys.readouterr().err
    assert end.value.code == 130 and said == "habitus: stopped; finished captures are complete\n"


def test_the_handler_is_given_back_and_others_are_left_alone():
    before = signal.getsignal(signal.SIGINT)
    with on_ctrl_c(Stop(), stays=False):
        assert isinstance(signal.getsignal(signal.SIGINT), Stop)
    assert signal.getsignal(signal.SIGINT) is before
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as nohup does
    try:
        with on_ctrl_c(Stop(), stays=True):
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    reached = []

    def elsewhere():
        with on_ctrl_c(Stop(), stays=True):
            reached.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=elsewhere)
    thread.start(), thread.join()
    assert reached == [before]


@pytest.mark.parametrize("arguments", [["--help"], ["mosh", "--help"], ["layout", "show"]])
def test_nobody_reads_on_and_nothing_is_said(arguments):
    """The reading end is closed before anything is written."""
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.Popen(
        [sys.executable, "-m", "habitus", *arguments],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(writing)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (141, "")


def test_what_a_terminal_cannot_encode_is_an_escape(tmp_path):
    odd = os.fsencode(tmp_path) + "/Läufer_走.c3d".encode() + b"\xff.c3d"
    with open(odd, "w") as file:
        file.write("text")
    process = command(
        "mosh",
        os.fsdecode(odd),
        "--out",
        tmp_path / "out",
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    out, said = process.communicate(timeout=60)
    assert process.returncode == 2 and out == "" and said.isascii() and said.count("\n") == 1
    assert "L\\xe4ufer_\\u8d70" in said and "Traceback" not in said


def test_ctrl_c_is_the_usual_end_of_a_page():
    pytest.importorskip("viser")
    process = command("view", "default", "--port", "8741")
    assert process.stdout is not None
    line = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (0, "") and line.startswith("http://127.0.0.1:")
