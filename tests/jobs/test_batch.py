"""Many captures in one run: what fails is left behind with its reason, the others are as if it had
not been there.
"""

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from planted import person, plant
from synthetic_fit import synthetic_fit

from habitus.errors import HabitusError
from habitus.files import locked, tidy
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.jobs import batch
from habitus.jobs.batch import fit_all
from habitus.jobs.mosh import Mosh
from habitus.jobs.results import save_fit
from habitus.results.save import MARKER_FILES

FILES = {"body.npz", "body.glb", "metrics.json", "report.html"}
HASTY = MoshSettings(annealing=(10.0,), frames=3)
RECIPE = Mosh("cmu-41", soft_tissue="none", settings=HASTY)


@pytest.fixture(scope="module")
def planted():
    return plant(frames=6)


@pytest.fixture(scope="module")
def fitted(planted):
    """A fit that stands for all: these tests ask what is written and told, not how well the body
    fits.
    """
    capture = Capture("walk", planted.layout.labels, np.array(planted.observed), 30.0, "+y")
    return RECIPE.fit(capture, person())


@pytest.fixture(autouse=True)
def subjects(fitted, monkeypatch):
    """No fit is made; whose captures would be fitted together is written down, and a name in
    ``faults`` breaks off.
    """

    def stand_in(body, prior, layout, recordings, settings, progress):
        subjects.append([recording.name for recording in recordings])
        for recording in recordings:
            if recording.name in subjects.faults:
                raise subjects.faults[recording.name]
            yield replace(fitted, capture_name=recording.name)

    class Subjects(list):
        faults: ClassVar[dict[str, Exception]] = {}

    subjects = Subjects()
    monkeypatch.setattr("habitus.jobs.mosh.iterate_attempts", stand_in)
    monkeypatch.setattr("habitus.jobs.mosh.warm_up", lambda body: 0.0)
    return subjects


def written(planted, path: Path, labels=None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_c3d(
        Capture(path.stem, labels or planted.layout.labels, np.array(planted.observed), 30.0, "+y"),
        path,
    )
    return path


def fit(paths, out, **more):
    return fit_all(more.pop("recipe", RECIPE), paths, out, person(), **more)


def test_a_folder_is_fitted_past_what_is_bad_in_it(planted, subjects, tmp_path):
    data = tmp_path / "data"
    written(planted, data / "ann" / "one.c3d"), written(planted, data / "ann" / "two.c3d")
    written(planted, data / "bob" / "deep" / "walk.c3d")
    written(planted, data / "bob" / "strange.c3d", [f"Q{k}" for k in range(len(planted.layout))])
    (data / "bad.c3d").write_text("no capture"), (data / "notes.csv").write_text("a,b\n")
    synthetic_fit(5).export(data / "ann" / "one.trc")
    told = []
    outcomes = fit([data], tmp_path / "out", on_done=told.append)
    assert told == outcomes and len(outcomes) == 7
    failed = {one.source.name: one.reason for one in outcomes if one.failed}
    assert (
        set(failed) == {"bad.c3d", "strange.c3d"}
        and str(data / "bob" / "strange.c3d") in failed["strange.c3d"]
    )
    left_out = {one.source.name: one.reason for one in outcomes if one.left_out}
    assert set(left_out) == {"notes.csv", "one.trc"} and "export" in left_out["one.trc"]
    places = {one.folder.relative_to(tmp_path / "out").as_posix() for one in outcomes if one.folder}
    assert places == {"ann/one", "ann/two", "bob/deep/walk"}
    for place in places:
        assert {path.name for path in (tmp_path / "out" / place).iterdir()} == FILES
    assert sorted(subjects) == [["one", "two"], ["walk"]] and outcomes[-1].numbers["frames"] == 6


def test_files_that_are_given_are_one_subject_without_the_bad_ones(planted, subjects, tmp_path):
    good = [written(planted, tmp_path / f"{name}.c3d") for name in ("one", "two")]
    strange = written(
        planted, tmp_path / "strange.c3d", [f"Q{k}" for k in range(len(planted.layout))]
    )
    outcomes = fit([good[0], strange, tmp_path / "none.c3d", good[1]], tmp_path / "out")
    assert {one.name: one.failed for one in outcomes} == {
        "none": True,
        "strange": True,
        "one": False,
        "two": False,
    }
    assert subjects == [["one", "two"]]


@pytest.mark.parametrize(
    "fault", [ZeroDivisionError("oh"), HabitusError("two: no"), OSError(28, "No space left")]
)
def test_a_fit_that_breaks_off_costs_only_its_own_capture(
    fault, planted, subjects, tmp_path, monkeypatch
):
    monkeypatch.setattr(type(subjects), "faults", {"two": fault})
    paths = [written(planted, tmp_path / f"{name}.c3d") for name in ("one", "two", "three")]
    outcomes = fit(paths, tmp_path / "out")
    assert [one.name for one in outcomes] == ["one", "two", "three"]
    assert [one.error for one in outcomes] == [None, fault, None]
    assert ("fault of habitus" in outcomes[1].reason) == isinstance(fault, ZeroDivisionError)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"one", "three", "index.html"}
    assert subjects == [["one", "two", "three"], ["two"], ["three"]]


def test_a_full_disk_fails_what_it_meets_and_leaves_nothing_half_written(
    planted, tmp_path, monkeypatch
):
    paths = [written(planted, tmp_path / f"{name}.c3d") for name in ("one", "two")]
    before = fit(paths, tmp_path / "out")
    stamp = (before[0].folder / "metrics.json").read_text()
    save = batch.save_fit

    def full(fit, folder, *more):
        if fit.capture_name == "one":
            monkeypatch.setattr("habitus.results.save.write_glb", _no_room)
        try:
            return save(fit, folder, *more)
        finally:
            monkeypatch.undo()

    monkeypatch.setattr(batch, "save_fit", full)
    outcomes = fit(paths, tmp_path / "out")
    assert [one.failed for one in outcomes] == [True, False] and "No space left" in outcomes[
        0
    ].reason
    assert (tmp_path / "out" / "one" / "metrics.json").read_text() == stamp
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"one", "two", "index.html"}


def test_an_index_that_cannot_be_written_costs_no_result(planted, tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "write_index", lambda folder: _refuse())
    outcomes = fit([written(planted, tmp_path / "one.c3d")], tmp_path / "out")
    assert [one.failed for one in outcomes] == [False, True] and "no room" in outcomes[1].reason


def _refuse():
    raise HabitusError("no room")


def _no_room(*arguments, **named):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("name", ["...npz", "..npz"])
def test_a_name_that_leads_elsewhere_is_refused_and_nothing_is_written(name, planted, tmp_path):
    archive = tmp_path / "in" / name
    archive.parent.mkdir()
    with archive.open("wb") as file:
        np.savez(
            file, markers=planted.observed, labels=np.array(planted.layout.labels), rate_hz=30.0
        )
    (outcome,) = fit([archive], tmp_path / "a" / "out")
    assert outcome.failed and "rename the file" in outcome.reason and name in outcome.reason
    with pytest.raises(HabitusError, match="rename the file"):
        Mosh("cmu-41").fit(archive, person(), out=tmp_path / "a" / "out")
    there = [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))]
    assert [path for path in there if not path.startswith("a")] == ["in", f"in/{name}"]
    assert not [path for path in (tmp_path / "a").rglob("*") if path.is_file()]


def test_a_file_whose_name_is_no_text_is_fitted_under_an_escaped_one(planted, tmp_path):
    plain = written(planted, tmp_path / "plain.c3d")
    odd = os.fsencode(tmp_path) + b"/w\xff\x1b[31m.c3d"
    os.rename(os.fsencode(plain), odd)
    (outcome,) = fit([os.fsdecode(odd)], tmp_path / "out")
    assert outcome.error is None and outcome.name == "w_xff_x1b[31m"
    assert {path.name for path in outcome.folder.iterdir()} == FILES
    page = (outcome.folder / "report.html").read_text("utf-8")
    assert "w\\xff\\x1b[31m" in page and "\x1b" not in page
    assert (
        json.loads((outcome.folder / "metrics.json").read_text("utf-8"))["capture"]
        == "w\\xff\\x1b[31m"
    )


def test_what_nothing_can_begin_with_is_raised(planted, tmp_path):
    path = written(planted, tmp_path / "walk.c3d")
    with pytest.raises(HabitusError, match="no capture was given"):
        fit([], tmp_path / "out")
    with pytest.raises(HabitusError, match="nonsense"):
        fit([path], tmp_path / "out", recipe=Mosh("nonsense"))
    with locked(tmp_path / "out"), pytest.raises(HabitusError, match="another run is at work"):
        fit([path], tmp_path / "out")
    assert fit([path], tmp_path / "out", recipe=replace(RECIPE, obj=True))[0].error is None
    assert (tmp_path / "out" / "walk" / "obj").is_dir()


def test_a_run_cleans_up_after_a_killed_one(planted, tmp_path):
    path = written(planted, tmp_path / "walk.c3d")
    out = tmp_path / "out"
    for left in (".walk.partial-abcdefgh", ".gone.old-abcdefgh", ".other.partial-abcdefgh"):
        (out / left).mkdir(parents=True)
        (out / left / "body.npz").write_text("x")
    fit([path], out)
    assert {entry.name for entry in out.iterdir()} == {"walk", "gone", "index.html"}
    assert (out / "gone" / "body.npz").read_text() == "x"


def test_kills_while_results_are_replaced_leave_old_or_new_ones(fitted, tmp_path):
    """The short form of benchmarks/power_cuts.py: a child writes results again and again until it
    is killed.
    """
    out = tmp_path / "out"
    rng = np.random.default_rng(0)
    save_fit(replace(fitted, seed=0), out / "walk")
    (out / "walk" / "notes.txt").write_text("mine")
    for k in range(1, 7):
        child = os.fork()
        if child == 0:
            try:
                for again in range(100):
                    save_fit(replace(fitted, seed=1000 * k + again), out / "walk")
            finally:
                os._exit(1)
        time.sleep(rng.uniform(0.02, 0.5))
        os.kill(child, signal.SIGKILL), os.waitpid(child, 0)
        tidy(out, MARKER_FILES)
        assert {path.name for path in out.iterdir()} == {"walk"}
        assert {path.name for path in (out / "walk").iterdir()} == FILES | {"notes.txt"}
        assert json.loads((out / "walk" / "metrics.json").read_text())["frames"] == 6
        assert "</html>" in (out / "walk" / "report.html").read_text()[-20:]
        with np.load(out / "walk" / "body.npz") as arrays:
            assert all(arrays[name] is not None for name in arrays.files)
