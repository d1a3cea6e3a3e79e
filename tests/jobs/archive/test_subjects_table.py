"""Tables of subjects: the nearest row counts, and what does not fit is one clear line."""

from pathlib import Path

import pytest

from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.jobs.archive.grouping import read_subjects

FILES = [Path(name) for name in ("a/walk.c3d", "a/run.c3d", "b/deep/walk.trc", "c.c3d")]


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "subjects.csv"
    path.write_bytes(text.encode("utf-8-sig"))
    return path


def test_the_nearest_row_counts(tmp_path):
    text = "Subject, Capture, note\nAnn, a, x\nBea, a/run, y\n\nCid, b\\deep, z\n"
    found = read_subjects(table(tmp_path, text), FILES)
    assert [found.subject(path) for path in FILES] == ["Ann", "Bea", "Cid", None]
    tabs = read_subjects(table(tmp_path, "capture\tsubject\n.\tEva\nc.c3d\tDan\n"), FILES)
    assert [tabs.subject(path) for path in FILES] == ["Eva", "Eva", "Eva", "Dan"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("capture,subject\na/wolk.c3d,Ann\n", "line 2 names a/wolk.c3d, .*did you mean a/walk.c3d"),
        ("capture,subject\nzzz,Ann\n", "line 2 names zzz, .*relative to"),
        ("capture,subject\na,Ann\na/run,\n", "line 3 has no subject"),
        ("capture,subject\n,Ann\n", "line 2 has no capture"),
        ("capture,subject\na,Ann\na,Bea\n", "line 3 gives a to a second subject"),
        ("file,who\na,Ann\n", "expected the columns capture and subject"),
        ("", "expected the columns"),
        (None, "cannot be read"),
    ],
)
def test_a_bad_table_is_one_clear_line(text, words, tmp_path):
    path = tmp_path / "none.csv" if text is None else table(tmp_path, text)
    with pytest.raises(HabitusError, match=words):
        read_subjects(path, FILES)


def test_the_command_ends_with_2_and_one_line(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "walk.c3d").write_text("never read")
    options = ["archive", str(tmp_path / "in"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        main([*options, "--subjects", str(table(tmp_path, "capture,subject\nwolk.c3d,Ann\n"))])
    said = capsys.readouterr().err.strip().splitlines()
    assert ended.value.code == 2 and len(said) == 1 and "did you mean walk.c3d" in said[0]
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit) as ended:
        main([*options, "--workers", "2", "--cluster", "tcp://host:8786"])
    assert ended.value.code == 2 and "expected one" in capsys.readouterr().err
