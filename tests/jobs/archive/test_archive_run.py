"""Archives: one shape a subject, every capture once, whatever stops a run; what changed is fitted
again and no more.
"""

import json
import os
import shutil
import signal
import sqlite3
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from planted import person
from real_fit import real_capture
from small_archive import NAMES, RECIPE, arrays, made, write, write_all

from habitus.errors import HabitusError
from habitus.io.captures.c3d_write import write_c3d
from habitus.jobs.archive.manifest import open_manifest
from habitus.jobs.archive.tasks import digest_of, reason_of


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The captures, and their archive by a run after one that was killed in the middle of its third
    capture.
    """
    captures = write_all(tmp_path_factory.mktemp("whole"))
    out = tmp_path_factory.mktemp("out")
    child = os.fork()
    if child == 0:
        try:
            made(captures, out, progress=_die)
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    return captures, out, made(captures, out)


def _die(tally):
    """When two captures are done: the next one's results are written, and nobody hears of them."""
    if tally.stage == "fitting" and tally.done == 2:
        from habitus.jobs.archive import tasks

        save = tasks.save_fit

        def killed(*arguments, **options):
            save(*arguments, **options)
            os.kill(os.getpid(), signal.SIGKILL)

        tasks.save_fit = killed


@pytest.fixture
def copied(whole, tmp_path):
    """Captures and archive, to be spoilt."""
    shutil.copytree(whole[0], tmp_path / "captures", copy_function=shutil.copy2)
    shutil.copytree(whole[1], tmp_path / "out", copy_function=shutil.copy2)
    return tmp_path / "captures", tmp_path / "out"


def stamps(out: Path) -> dict[str, int]:
    return {
        path.parent.relative_to(out).as_posix(): path.stat().st_mtime_ns
        for path in out.rglob("body.npz")
    }


def sources(out: Path, subject: str) -> set[str]:
    """Names of the captures whose frames told a subject's shape."""
    with open_manifest(out) as manifest:
        return {key.partition(".")[0] for key in manifest.subject(subject)[2]}


def test_a_killed_run_goes_on_and_finds_what_habitus_mosh_finds(whole):
    captures, out, told = whole
    assert (told.fitted, told.kept, told.failed, told.subjects) == (3, 2, (), 2)
    found = arrays(out)
    for fit in RECIPE.fit([captures / f"{name}.c3d" for name in sorted(NAMES[:4])], person()):
        here = f"ann/{fit.capture_name}"
        np.testing.assert_array_equal(found[f"{here}: betas"], fit.betas)
        np.testing.assert_allclose(found[f"{here}: trans"], fit.trans, atol=1e-9)
        np.testing.assert_allclose(found[f"{here}: markers_latent"], fit.latent_markers, atol=1e-9)
    assert not np.allclose(found["bob/walk: betas"], fit.betas)


def test_nothing_else_is_left_in_the_folder(whole):
    _, out, _ = whole
    names = {"ann", "bob", "subjects", "archive.parquet", "archive.sqlite", "index.html"}
    assert {path.name for path in out.iterdir()} == names
    assert {path.name for path in (out / "ann").iterdir()} == {"one", "two", "three", "four"}
    assert {path.name for path in (out / "ann" / "one").iterdir()} == {"body.npz", "metrics.json"}


def test_only_what_is_new_or_changed_is_fitted_and_what_is_broken_is_told(copied):
    captures, out = copied
    unused = next(name for name in NAMES[:4] if name not in sources(out, "ann"))
    before = stamps(out)
    write(captures, unused, seed=9, frames=7)
    write(captures, "ann/new", seed=10)
    (captures / "bob" / "walk.c3d").write_text("no capture")
    (captures / "notes.csv").write_text("a,b\n")
    failures = []
    told = made(captures, out, on_failure=lambda *what: failures.append(what))
    assert (told.fitted, told.kept, told.left_out) == (2, 3, 1)
    assert failures == list(told.failed) and [path for path, _ in failures] == ["bob/walk.c3d"]
    assert "C3D" in failures[0][1]
    after = stamps(out)
    assert {name for name in before if after[name] != before[name]} == {unused}
    found = arrays(out)
    assert (found["ann/new: betas"] == found["ann/one: betas"]).all() and len(
        found[f"{unused}: trans"]
    ) == 7
    (captures / "bob" / "walk.c3d").unlink()
    again = made(captures, out)
    assert (again.fitted, again.kept, again.failed, again.subjects) == (0, 5, (), 1)


def test_a_file_that_cannot_be_opened_is_no_fault_of_the_program(tmp_path):
    path = tmp_path / "walk.c3d"
    path.symlink_to("gone.c3d")
    with pytest.raises(OSError) as caught:
        digest_of(path)
    assert reason_of(caught.value, path).startswith("No such file or directory; check")


class Planned(Exception):
    """What a run would do is known."""


def planned(tallies, tally):
    if tally.stage == "fitting":
        tallies.append(tally)
        raise Planned


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        (lambda captures, out: None, 5),
        (lambda captures, out: (captures / "bob" / "walk.c3d").touch(), 5),
        (lambda captures, out: write(captures, sorted(sources(out, "ann"))[0], seed=9), 1),
        (lambda captures, out: shutil.rmtree(out / "ann" / "two"), 4),
        (lambda captures, out: next((out / "subjects").glob("ann*")).unlink(), 1),
        (lambda captures, out: {"npz_style": "amass"}, 0),
    ],
    ids=["nothing", "touched", "frames of the shape", "results gone", "shape gone", "options"],
)
def test_what_a_result_depends_on_decides_what_stays(change, kept, copied):
    more = change(*copied)
    tallies = []
    with pytest.raises(Planned):
        made(
            *copied, progress=partial(planned, tallies), **(more if isinstance(more, dict) else {})
        )
    assert (tallies[0].kept, tallies[0].captures) == (kept, 5)


def test_a_table_says_whose_captures_are_whose(copied, tmp_path):
    captures, out = copied
    table = tmp_path / "subjects.csv"
    table.write_text("capture;subject\nann;Anna\nann/two.c3d;Bea\n")
    with pytest.raises(Planned):
        made(captures, out, subjects=table, progress=partial(planned, []))
    with sqlite3.connect(out / "archive.sqlite") as manifest:
        told = dict(manifest.execute("SELECT path, subject FROM captures"))
    assert told == {
        "ann/one.c3d": "Anna",
        "ann/two.c3d": "Bea",
        "ann/three.c3d": "Anna",
        "ann/four.c3d": "Anna",
        "bob/walk.c3d": "bob",
    }


def test_nothing_begins_with_what_cannot_be(whole, tmp_path):
    captures, *_ = whole
    for folder, words in (
        (tmp_path / "none", "no folder"),
        (tmp_path, "no capture in this folder"),
    ):
        with pytest.raises(HabitusError, match=words):
            made(folder, tmp_path / "out")
    (tmp_path / "spoilt").mkdir()
    (tmp_path / "spoilt" / "archive.sqlite").write_text("no manifest" * 99)
    with pytest.raises(HabitusError, match=r"archive\.sqlite"):
        made(captures, tmp_path / "spoilt")


def test_a_real_capture_is_fitted(shared, tmp_path):
    (tmp_path / "in").mkdir()
    write_c3d(real_capture(shared)[:10], tmp_path / "in" / "real.c3d")
    told = made(tmp_path / "in", tmp_path / "out")
    assert (told.fitted, told.failed) == (1, ())
    numbers = json.loads((tmp_path / "out" / "real" / "metrics.json").read_text())
    assert numbers["layout"] == "cmu-41" and numbers["marker_error_mm"]["pose"]["mean"] < 30
