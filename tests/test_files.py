"""Files and folders whole or not at all: what a full disk, a kill, a second run and a stranger's
files leave behind.
"""

import errno
import os
import resource
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from habitus import files
from habitus.errors import HabitusError
from habitus.files import atomic_write, files_together, locked, tidy, whole_folder, write_text

OURS = ("numbers.txt", "page.html")


def write(folder: Path, text: str, names: tuple[str, ...] = OURS) -> None:
    with whole_folder(folder, OURS) as partial:
        for name in names:
            write_text(partial / name, text)


def content(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_folder_appears_when_all_of_it_is_there(tmp_path):
    with whole_folder(tmp_path / "deep" / "walk") as partial:
        write_text(partial / "page.html", "one")
        assert not (tmp_path / "deep" / "walk").exists() and partial.name.startswith(
            ".walk.partial-"
        )
    assert content(tmp_path) == {"deep/walk/page.html": "one"}
    assert (tmp_path / "deep" / "walk").stat().st_mode & 0o777 == 0o777 & ~files._umask()


def test_an_older_folder_is_replaced_whole_and_what_is_not_the_programs_stays(tmp_path):
    write(tmp_path / "walk", "old")
    (tmp_path / "walk" / "notes.txt").write_text("mine")
    (tmp_path / "walk" / "pictures").mkdir()
    (tmp_path / "walk" / "pictures" / "a.png").write_text("picture")
    write(tmp_path / "walk", "new", ("page.html",))
    expected = {"page.html": "new", "notes.txt": "mine", "pictures/a.png": "picture"}
    assert content(tmp_path / "walk") == expected and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    "fault", [KeyboardInterrupt, RuntimeError, OSError(errno.ENOSPC, "No space left on device")]
)
def test_what_breaks_off_leaves_the_older_folder_as_it_was(fault, tmp_path):
    write(tmp_path / "walk", "old")
    expected = HabitusError if isinstance(fault, OSError) else fault
    with pytest.raises(expected) as told, whole_folder(tmp_path / "walk", OURS) as partial:
        write_text(partial / "page.html", "new")
        raise fault
    assert content(tmp_path) == {"walk/page.html": "old", "walk/numbers.txt": "old"}
    assert expected is not HabitusError or "No space left on device" in str(told.value)


@pytest.mark.parametrize("step", [1, 2])
def test_a_rename_that_fails_leaves_the_older_folder_in_its_place(step, tmp_path, monkeypatch):
    write(tmp_path / "walk", "old")
    rename = os.rename
    calls = []

    def failing(a, b):
        calls.append(a)
        if len(calls) == step:
            raise OSError(errno.EIO, "Input/output error")
        rename(a, b)

    monkeypatch.setattr(os, "rename", failing)
    with pytest.raises(HabitusError, match="Input/output error"):
        write(tmp_path / "walk", "new")
    assert content(tmp_path) == {"walk/page.html": "old", "walk/numbers.txt": "old"}


def test_a_kill_at_any_step_of_the_replacement_leaves_one_of_both_whole(tmp_path):
    """A process that ends before its n-th change of names, for every n; then the next run tidies
    up.
    """
    code = """
        import os, sys
        from pathlib import Path
        from habitus import files
        calls = 0
        def dying(change):
            def call(*arguments, **named):
                global calls
                calls += 1
                if calls == int(sys.argv[2]):
                    os._exit(9)
                return change(*arguments, **named)
            return call
        for name in ("rename", "replace", "fsync", "unlink", "rmdir"):
            setattr(os, name, dying(getattr(os, name)))
        with files.whole_folder(Path(sys.argv[1]), ("page.html",)) as partial:
            files.write_text(partial / "page.html", "new")
        os._exit(0)
    """
    codes = []
    seen = set()
    for n in range(1, 40):
        folder = tmp_path / str(n)
        write(folder / "walk", "old", ("page.html",))
        (folder / "walk" / "notes.txt").write_text("mine")
        arguments = [sys.executable, "-c", textwrap.dedent(code), folder / "walk", str(n)]
        codes.append(subprocess.run(arguments).returncode)
        if (folder / "walk" / "page.html").exists():  # what can be seen is whole
            assert (folder / "walk" / "page.html").read_text() in ("old", "new")
        tidy(folder, ("page.html",))
        found = content(folder)
        assert found in [
            {"walk/page.html": text, "walk/notes.txt": "mine"} for text in ("old", "new")
        ], n
        seen.add(found["walk/page.html"])
        if codes[-1] == 0:
            break
    assert codes[-1] == 0 and set(codes[:-1]) == {9} and len(codes) > 6 and seen == {"old", "new"}


def test_tidying_touches_nothing_else(tmp_path):
    kept = [
        "walk/page.html",
        ".hidden/a",
        ".walk.partial",
        ".walk.old-2024/a",
        "walk.partial-abcdefgh/a",
        ".env",
    ]
    for name in [
        *kept,
        ".walk.partial-abcdefgh/page.html",
        ".walk.old-abcdefgh/page.html",
        ".m.partial-a1b2c3d4.npz",
    ]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    tidy(tmp_path, OURS)
    assert sorted(content(tmp_path)) == sorted(kept)
    tidy(tmp_path / "nowhere")


def test_a_kill_at_any_step_leaves_files_of_one_run(tmp_path):
    """A child that ends before its n-th change of names, for every n; then the next run tidies."""
    seen = []
    for n in range(1, 40):
        folder = tmp_path / str(n)
        folder.mkdir()
        for name in ("numbers.txt", "page.html", "extra.txt"):
            (folder / name).write_text("old")
        child = os.fork()
        if child == 0:
            try:
                _end_before_change(n)
                with files_together(folder, ours=("extra.txt",)) as partial:
                    for name in OURS:
                        write_text(partial / name, "new")
            finally:
                os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        tidy(folder)
        seen.append(content(folder))
        if code == 0:
            break
    old = dict.fromkeys(("numbers.txt", "page.html", "extra.txt"), "old")
    new = dict.fromkeys(OURS, "new")
    committed = seen.index(new)
    assert seen == [old] * committed + [new] * (len(seen) - committed)
    assert committed >= 3 and len(seen) - committed >= 4


def _end_before_change(n: int) -> None:
    """In a child process: end it before the n-th change of names."""
    counter = iter(range(1, n + 1))

    def dying(change):
        def call(*arguments, **named):
            if next(counter) == n:
                os._exit(9)
            return change(*arguments, **named)

        return call

    for name in ("rename", "replace", "unlink", "rmdir"):
        setattr(os, name, dying(getattr(os, name)))


@pytest.mark.parametrize("killed_after_renames", [1, 2])
def test_the_next_run_tidies_what_is_beside_its_folder(killed_after_renames, tmp_path):
    aside = tmp_path / ".out.old-abcdefgh"
    write(aside, "old")
    (aside / "notes.txt").write_text("mine")
    write(tmp_path / ".out.partial-abcdefgh", "torn")
    if killed_after_renames == 2:
        write(tmp_path / "out", "new")
    others = (".out.partial-abcdefgh.json", ".walk.partial-abcdefgh")
    for name in others:
        (tmp_path / name).write_text("of others")
    with locked(tmp_path / "out", OURS):
        pass
    results = {f"out/{name}": "new" if killed_after_renames == 2 else "old" for name in OURS}
    others_there = dict.fromkeys(others, "of others")
    assert content(tmp_path) == {**results, **others_there, "out/notes.txt": "mine"}


def test_a_link_to_itself_is_replaced(tmp_path):
    (tmp_path / "walk").symlink_to("walk")
    write(tmp_path / "walk", "new")
    assert content(tmp_path) == {f"walk/{name}": "new" for name in OURS}


def test_a_link_is_replaced_and_what_it_led_to_is_not_touched(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "page.html").write_text("theirs")
    (tmp_path / "walk").symlink_to(tmp_path / "elsewhere")
    write(tmp_path / "walk", "new")
    assert not (tmp_path / "walk").is_symlink() and content(tmp_path / "walk") == dict.fromkeys(
        OURS, "new"
    )
    assert content(tmp_path / "elsewhere") == {"page.html": "theirs"}


def test_a_file_and_the_working_folder_are_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "walk").write_text("a file")
    with pytest.raises(HabitusError, match="a file of this name"):
        write(tmp_path / "walk", "new")
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    for target in (".", "..", tmp_path / "here"):
        with pytest.raises(HabitusError, match="working folder"):
            write(Path(target), "new")


def test_a_full_disk_while_an_archive_is_written_is_one_clear_line(tmp_path):
    """The limit on the size of files stands for the disk's: numpy and zipfile meet it in the midst
    of an array.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        with (
            pytest.raises(HabitusError, match=r"cannot write .*File too large"),
            atomic_write(tmp_path / "a.npz") as temporary,
            temporary.open("wb") as file,
        ):
            np.savez(file, a=np.zeros(1_000_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_what_utf8_cannot_hold_is_written_as_an_escape(tmp_path):
    write_text(tmp_path / "a.txt", "walk\udcff é\n")
    assert (tmp_path / "a.txt").read_bytes() == "walk\\udcff é\n".encode()


def test_a_second_run_in_a_folder_is_refused_and_a_later_one_is_not(tmp_path):
    code = """
        import sys
        from pathlib import Path
        from habitus.files import locked
        with locked(Path(sys.argv[1])):
            print(1)
    """
    other = [sys.executable, "-c", textwrap.dedent(code), tmp_path / "out"]
    with locked(tmp_path / "out"):
        refused = subprocess.run(other, capture_output=True, text=True)
        assert "another run is at work in it" in refused.stderr and refused.stdout == ""
        with (
            pytest.raises(HabitusError, match="another run is at work in it"),
            locked(tmp_path / "out"),
        ):
            pass
    assert not (tmp_path / "out").exists()  # an empty folder goes with its lock
    assert subprocess.run(other, capture_output=True, text=True).stdout == "1\n"


def test_a_folder_that_cannot_be_locked_is_said_to_be_one(tmp_path):
    (tmp_path / ".lock").mkdir()
    with pytest.raises(HabitusError, match="lock: cannot be locked"), locked(tmp_path):
        pass
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(HabitusError, match=r"cannot write to .*--out"),
        locked(tmp_path / "file" / "out"),
    ):
        pass


def test_a_folder_that_may_not_be_written_to_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(HabitusError, match=r"permission denied.*--out"), locked(tmp_path):
        pass
