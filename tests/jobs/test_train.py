"""Training from files to files: what is written, and that a killed run goes on to the same
model.
"""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import smplx
import torch
from smplx.vertex_ids import vertex_ids
from toy_people import OPTIONS, toy

import habitus
from habitus.errors import HabitusError
from habitus.files import locked
from habitus.io.models.bodies import load_body, save_body
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.io.registrations.templates import save_template
from habitus.jobs.checkpoints import Checkpoint, CheckpointingCallback
from habitus.jobs.train import Trainer, train
from habitus.learn.options import TrainOptions
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.registrations import Planted

QUICK = replace(OPTIONS, rounds=1, pose_shapes="none")
FILES = {"model.npz", "model.pkl", "poses.npz", "training.json", "checkpoint"}
ARRAYS = ("v_template", "shapedirs", "posedirs", "joint_regressor", "skinning_weights")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    """The toy data set and its template on disk."""
    folder = tmp_path_factory.mktemp("data")
    template, planted = toy()
    write_registrations(planted.registrations, folder / "people.npz")
    save_template(template, folder / "template.npz")
    return folder / "people.npz", folder / "template.npz"


def everything(told: list) -> dict:
    """Callbacks that append whatever they are called with."""
    return {
        "progress": lambda *words: told.append(words),
        "on_step": lambda *words: told.append(words),
        "on_warning": told.append,
    }


@pytest.fixture(scope="module")
def whole(files, tmp_path_factory):
    """A training that nobody disturbed, what it told, and where it lies."""
    told: list = []
    out = tmp_path_factory.mktemp("whole")
    (done,) = train(
        files[0], out, template=files[1], options=OPTIONS, workers=1, **everything(told)
    )
    return done, told


def test_everything_is_written_and_says_the_same(whole):
    done, _ = whole
    assert {path.name for path in done.folder.iterdir()} == FILES
    record = json.loads((done.folder / "training.json").read_text())
    assert (
        record["sizes"]["pose_registrations"] == 28 and record["sizes"]["shape_registrations"] == 11
    )
    assert record["options"]["weights"]["joints"] == OPTIONS.weights.joints
    assert [e["total"] for e in record["energies"]] == [
        r.energy.total for r in done.trained.history
    ]
    assert (np.diff([e["seconds"] for e in record["energies"]]) > 0).all()
    assert len(record["shape_variances"]) == 10 and record["version"] == habitus.__version__
    with np.load(done.folder / "poses.npz") as arrays:
        planted = toy()[1].registrations.where(set="pose")
        assert (
            tuple(arrays["name"]) == planted.name and tuple(arrays["subjects"]) == planted.subjects
        )
        assert arrays["poses"].shape == (28, 24, 3) and arrays["templates"].shape == (4, 320, 3)


def test_energies_never_rise(whole):
    totals = np.array([record.energy.total for record in whole[0].trained.history])
    assert (
        len(totals) == 11
        and (np.diff(totals) <= 1e-9 * totals[0]).all()
        and totals[-1] < 0.05 * totals[0]
    )


def test_the_share_done_never_falls_within_a_stage(whole):
    stages: dict[str, list[float]] = {}
    for told in whole[1]:
        if isinstance(told, tuple) and isinstance(told[1], float):
            stages.setdefault(told[0], []).append(told[1])
    assert list(stages) == [
        "check registrations",
        "model: poses by edges",
        "model: rounds",
        "model: shapes",
    ]
    for shares in stages.values():
        assert (np.diff(shares) >= 0).all() and shares[0] > 0 and shares[-1] == 1.0


@pytest.mark.parametrize("ending", ["npz", "pkl"])
def test_files_hold_the_model_for_us_and_for_smplx(whole, ending):
    done = whole[0]
    path = whole[0].folder / f"model.{ending}"
    body = done.trained.body
    told = load_body(path)
    assert all(np.array_equal(getattr(body, name), getattr(told, name)) for name in ARRAYS)
    torch.manual_seed(0)
    betas = torch.randn(3, 4).double()
    pose = 0.5 * torch.randn(3, 24, 3).double()
    trans = torch.randn(3, 3).double()
    struct = {}
    if ending == "npz":
        with np.load(path) as arrays:
            struct = {"data_struct": smplx.utils.Struct(**arrays)}
    few = dict.fromkeys(vertex_ids["smplh"], 0)  # landmarks that smplx takes by number
    theirs = smplx.SMPL(str(path), dtype=torch.float64, num_betas=4, vertex_ids=few, **struct)
    with torch.no_grad():
        found = theirs(
            betas=betas, global_orient=pose[:, 0], body_pose=pose[:, 1:].flatten(1), transl=trans
        )
    ours = body(betas, pose, trans)
    assert (found.vertices - ours.vertices).abs().max() < 1e-6
    assert (found.joints[:, :24] - ours.joints).abs().max() < 1e-6


# -- stopped runs ----------------------------------------------------------------------------------

KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from toy_people import OPTIONS
from habitus.jobs.train import train
from habitus.jobs.checkpoints import CheckpointingCallback

def dying(method):
    def call(callback, found):
        method(callback, found)
        if (getattr(found, "round", None), getattr(found, "step", None)) == (2, "weights") or found == 8:
            os.kill(os.getpid(), signal.SIGKILL)
    return call

if {shapes}:
    CheckpointingCallback.on_surfaces_stored = dying(CheckpointingCallback.on_surfaces_stored)
else:
    CheckpointingCallback.on_step_end = dying(CheckpointingCallback.on_step_end)
train({data!r}, {out!r}, template={template!r}, options=OPTIONS, workers=1)
"""


def killed(files: tuple[Path, Path], out: Path, *, shapes: bool) -> None:
    """Train in another process that is killed in the middle of round 2, or of the shape stage."""
    tests = str(Path(__file__).parents[1] / "helpers")
    code = KILLED.format(
        tests=tests, shapes=shapes, data=str(files[0]), out=str(out), template=str(files[1])
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr


def test_a_run_killed_twice_ends_at_the_same_model(files, whole, tmp_path, monkeypatch):
    killed(files, tmp_path, shapes=False)
    assert not (tmp_path / "model.npz").exists()
    kept, _ = Checkpoint(tmp_path / "checkpoint" / "model").load()
    assert kept.rounds == 1 and kept.steps_done == ("subjects",) and kept.before is not None
    killed(files, tmp_path, shapes=True)
    seen = []
    method = CheckpointingCallback.on_surfaces_stored
    monkeypatch.setattr(
        CheckpointingCallback,
        "on_surfaces_stored",
        lambda callback, count: (seen.append(count), method(callback, count)),
    )
    monkeypatch.setattr(
        CheckpointingCallback, "on_step_end", lambda *_: pytest.fail("a step was done again")
    )
    (done,) = train(files[0], tmp_path, template=files[1], options=OPTIONS, workers=1)
    assert seen == [11]
    undisturbed = whole[0].trained
    for name in ARRAYS:
        ours = getattr(done.trained.body, name)
        theirs = getattr(undisturbed.body, name)
        assert np.abs(ours - theirs).max() < 1e-6, name
    for a, b in zip(done.trained.history, undisturbed.history, strict=True):
        assert (a.round, a.step) == (b.round, b.step) and a.energy.total == pytest.approx(
            b.energy.total, rel=1e-6
        )


def test_a_run_that_is_lengthened_ends_where_one_of_that_length_does(files, whole, tmp_path):
    train(files[0], tmp_path, template=files[1], options=replace(OPTIONS, rounds=1), workers=1)
    steps = []
    stages = []
    listen = {"on_step": lambda _, record: steps.append((record.round, record.step)),
              "progress": lambda stage, _: stages.append(stage)}  # fmt: skip
    (done,) = train(files[0], tmp_path, template=files[1], options=OPTIONS, workers=1, **listen)
    assert steps == [
        (2, step) for step in ("subjects", "weights", "pose shapes", "poses", "further")
    ]
    assert list(dict.fromkeys(stages)) == ["check registrations", "model: rounds", "model: shapes"]
    for name in ARRAYS:
        ours = getattr(done.trained.body, name)
        theirs = getattr(whole[0].trained.body, name)
        assert np.abs(ours - theirs).max() < 1e-6, name


@pytest.fixture(scope="module")
def quick(files, tmp_path_factory) -> Path:
    """A quick training, for those that come after it."""
    out = tmp_path_factory.mktemp("quick")
    train(files[0], out, template=files[1], options=QUICK, workers=1)
    return out


def test_a_finished_run_is_not_done_again(files, quick):
    steps = []
    listen = {"on_step": lambda model, record: steps.append(record)}
    train(files[0], quick, template=files[1], options=QUICK, workers=1, **listen)
    assert steps == []
    train(files[0], quick, template=files[1], options=QUICK, workers=1, restart=True, **listen)
    assert [record.step for record in steps] == [
        "poses by edges",
        "subjects",
        "weights",
        "poses",
        "further",
    ]


def test_a_trainer_writes_nothing_before_it_is_saved(files, quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told: list = []
    trainer = Trainer(**vars(QUICK))
    model = trainer.fit(open_registrations(files[0]), files[1], workers=1, **everything(told))
    assert model.folder is None and list(tmp_path.iterdir()) == []
    assert ("model: shapes", 1.0) in told and isinstance(model.options, TrainOptions)
    saved = model.save("out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES - {"checkpoint"}
    there = load_body(quick / "model.npz")
    for name in ("v_template", "shapedirs", "joint_regressor", "skinning_weights"):
        assert (
            abs(
                getattr(load_body(tmp_path / "out" / "model.npz"), name) - getattr(there, name)
            ).max()
            < 1e-9
        )
        assert abs(getattr(saved.body, name) - getattr(there, name)).max() < 1e-9
    ours, theirs = (
        json.loads((folder / "training.json").read_text()) for folder in (saved.folder, quick)
    )
    assert ours["sizes"] == theirs["sizes"] and ours["options"] == theirs["options"]
    assert len(ours["energies"]) == len(theirs["energies"])


def test_files_of_a_model_are_replaced_together(files, quick, tmp_path, monkeypatch):
    older = ("model.npz", "model.pkl", "poses.npz", "training.json")
    for name in older:
        (tmp_path / name).write_text("of an earlier run")
    (done,) = train(files[0], quick, template=files[1], options=QUICK, workers=1)

    def fails(*_):
        raise HabitusError("no room")

    monkeypatch.setattr("habitus.jobs.train.write_record", fails)
    with pytest.raises(HabitusError, match="no room"):
        done.save(tmp_path)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        older, "of an earlier run"
    )


def test_a_trainer_with_a_folder_is_the_command(files, quick):
    done = Trainer(**vars(QUICK)).fit(files[0], files[1], out=quick, workers=1)
    assert done.folder == quick  # and continues from there: options are the same


def test_a_trainer_fits_one_model_and_knows_its_options(files):
    with pytest.raises(HabitusError, match="sex 'each' means two models"):
        Trainer(**vars(QUICK), sex="each").fit(files[0], files[1])
    with pytest.raises(HabitusError, match="rounds is 0"):
        Trainer(rounds=0)


def test_without_torch_one_line_says_what_to_install():
    code = """
import sys
sys.modules["torch"] = None
import habitus
try:
    habitus.train
except habitus.HabitusError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (
        "need torch, which is not installed" in done.stdout
        and "pip install 'habitus[train]'" in done.stdout
    )


def test_two_runs_do_not_share_a_folder(files, quick):
    with locked(quick), pytest.raises(HabitusError, match="another run is at work in it"):
        train(files[0], quick, template=files[1], options=QUICK, workers=1)
    train(files[0], quick, template=files[1], options=QUICK, workers=1)


def test_one_person_is_too_few_to_learn_shapes_from(files, tmp_path):
    registrations = open_registrations(files[0]).where(set="pose")
    alone = registrations.take(
        np.flatnonzero(np.array(registrations.subject) == registrations.subject[0])
    )
    with pytest.raises(
        HabitusError, match=r"too few people to learn shapes from: 1, .*expected 2 or more"
    ):
        train(alone, tmp_path / "out", template=files[1], options=QUICK, workers=1)
    assert not (tmp_path / "out").exists()


def test_another_training_is_not_mixed_with_the_first(files, quick):
    template, planted = toy()
    weights = replace(QUICK.weights, joints=7.0)
    with pytest.raises(
        HabitusError,
        match=r"other influences \(4, now 3\), weights.joints \(5.0, now 7.0\); .*--restart",
    ):
        train(
            files[0],
            quick,
            template=template,
            options=replace(QUICK, influences=3, weights=weights),
            workers=1,
        )
    fewer = planted.registrations.take(np.arange(35))
    with pytest.raises(HabitusError, match="other registrations; "):
        train(fewer, quick, template=template, options=QUICK, workers=1)
    moved = replace(template, vertices=template.vertices + 1e-3)
    with pytest.raises(HabitusError, match="other template; "):
        train(files[0], quick, template=moved, options=QUICK, workers=1)


@pytest.mark.parametrize("name", ["progress.npz", "run.json", "surfaces.json", "surfaces.npy"])
def test_a_damaged_checkpoint_is_said_to_be_one(files, quick, name):
    path = quick / "checkpoint" / "model" / name
    content = path.read_bytes()
    try:
        path.write_bytes(content[: len(content) // 2 - 20])
        with pytest.raises(HabitusError, match=rf"{name}: damaged .*--restart"):
            train(files[0], quick, template=files[1], options=QUICK, workers=1)
    finally:
        path.write_bytes(content)


def few(planted: Planted) -> Registrations:
    """Two people in seven poses, three in one."""
    return planted.registrations.where(subject=planted.registrations.subjects[2:7])


# -- what else can be asked for --------------------------------------------------------------------


def test_baselines_come_along(tmp_path):
    template, planted = toy()
    more = replace(QUICK, num_betas=10)
    (done,) = train(
        few(planted), tmp_path, template=template, options=more, workers=1, baselines=True
    )
    assert "shape directions: 2, not 10; the people vary along no more" in done.warnings
    for name, skinning in (("plain-lbs", "lbs"), ("plain-dqbs", "dqbs")):
        body = load_body(tmp_path / f"{name}.npz")
        assert body.posedirs is None and body.skinning == skinning
        assert np.array_equal(body.v_template, done.baselines[name].body.v_template)
    record = json.loads((tmp_path / "training.json").read_text())
    assert set(record["baselines"]) == {"plain-lbs", "plain-dqbs"}


def test_baselines_of_registrations_with_holes_come_along(tmp_path):
    template, planted = toy()
    whole = few(planted)
    weights = np.ones(whole.num_vertices)
    weights[:5] = 0.0
    (done,) = train(
        replace(whole, weights=weights),
        tmp_path,
        template=template,
        options=replace(QUICK, rounds=1),
        workers=1,
        baselines=True,
    )
    assert all(np.isfinite(one.body.v_template).all() for one in done.baselines.values())


def test_a_body_is_a_template_that_gives_what_it_knows(tmp_path):
    template, planted = toy()
    body = replace(
        coarse_body(load_body("default"), 320), female_direction=(np.array([2.0] + [0.0] * 23), 0.1)
    )
    save_body(body, tmp_path / "body.npz")
    options = replace(QUICK, start="body", fixed=("skinning_weights", "joint_regressor"))
    train(
        few(planted), tmp_path / "out", template=tmp_path / "body.npz", options=options, workers=1
    )
    told = load_body(tmp_path / "out" / "model.npz")
    assert dict(told.landmarks) == dict(body.landmarks) != {}
    assert told.female_direction is not None and told.female_direction[0].shape == (told.num_betas,)
    assert np.array_equal(told.joint_regressor, body.joint_regressor)
    np.testing.assert_allclose(told.skinning_weights, body.skinning_weights, atol=1e-12)
    with pytest.raises(HabitusError, match="other body; "):
        other = replace(body, joint_regressor=np.roll(body.joint_regressor, 1, axis=1))
        train(few(planted), tmp_path / "out", template=other, options=options, workers=1)
    with pytest.raises(HabitusError, match="start 'body' with a template that is of no body model"):
        train(few(planted), tmp_path / "else", template=template, options=options, workers=1)


def test_a_template_without_symmetry_is_trained_on_with_a_warning(tmp_path):
    template, planted = toy()
    lean = template.vertices + 0.3 * template.vertices[:, 1:2] * [1.0, 0.0, 0.0]
    crooked = Template(lean, template.faces, template.part, template.parents, template.joint_names)
    notes: list[str] = []
    (done,) = train(
        few(planted), tmp_path, template=crooked, options=QUICK, workers=1, on_warning=notes.append
    )
    assert "not symmetric" in notes[0] and "not symmetric" in done.warnings[0]
    assert done.trained.body.mirror is None and "symmetry" in done.trained.history[-1].energy.terms


@pytest.mark.parametrize(
    "asked", [{"pose_features": "quaternions"}, {"shape_features": 2, "num_betas": 2}]
)
def test_features_that_smpl_does_not_have_leave_no_pickle(asked, tmp_path):
    template, planted = toy()
    options = replace(OPTIONS, rounds=1, **asked)
    shares = []
    listen = {"progress": lambda stage, share: shares.append((stage, share))}
    (tmp_path / "model.pkl").write_text("of an earlier run")
    (done,) = train(few(planted), tmp_path, template=template, options=options, workers=1, **listen)
    assert not (tmp_path / "model.pkl").exists() and any(
        "no model.pkl" in warning for warning in done.warnings
    )
    told = load_body(tmp_path / "model.npz")
    assert all(getattr(told, key) == value for key, value in asked.items())
    assert len(json.loads((tmp_path / "training.json").read_text())["energies"]) == len(
        done.trained.history
    )
    assert shares[-1] == (
        "model: rounds by shape" if "shape_features" in asked else "model: shapes",
        1.0,
    )


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"sex": "both"}, "sex is 'both'"),
        ({"workers": 0}, "0 threads"),
        ({"unit": "ells"}, "unit is 'ells'"),
        ({"template": "nothing.npz"}, "nothing.npz"),
        ({"workers": "tcp://127.0.0.1:1"}, "no Dask scheduler at 'tcp://127.0.0.1:1'"),
        ({"workers": "http://localhost:1"}, "no Dask scheduler at 'http://localhost:1'"),
        ({"workers": "nonsense"}, "no Dask scheduler at 'nonsense'"),
    ],
)
def test_what_makes_no_sense_is_refused(files, tmp_path, asked, words, monkeypatch):
    monkeypatch.setattr("habitus.parallel.workers.TIMEOUT", "1s")
    with pytest.raises(HabitusError, match=words):
        train(files[0], tmp_path / "out", **{"template": files[1], **asked})
    assert not (tmp_path / "out").exists()
