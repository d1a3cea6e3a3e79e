"""`habitus train` on the command line: models on disk, or one clear line and exit code 2."""

import re

import numpy as np
import pytest
import tyro
from toy_people import COMMAND, OPTIONS, toy

from habitus.cli.main import main
from habitus.cli.train import Train
from habitus.io.models.bodies import load_body
from habitus.io.registrations.open import write_registrations
from habitus.io.registrations.templates import save_template
from habitus.jobs.checkpoints import CheckpointingCallback
from habitus.learn.options import TrainOptions
from habitus_lab.population.faults import spoil

QUICK = ("--rounds", "1", "--pose-shapes", "none")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The toy data set and its template on disk."""
    folder = tmp_path_factory.mktemp("data")
    template, planted = toy()
    write_registrations(planted.registrations, folder / "people.npz")
    save_template(template, folder / "template.npz")
    return folder / "people.npz", folder / "template.npz"


@pytest.fixture
def run(capsys, tmp_path, files):
    """Runs the command in this process: its exit code (0 where it just returns), stdout and
    stderr.
    """

    def call(*arguments, data=files[0], out=tmp_path / "out"):
        capsys.readouterr()
        fixed = ("train", data, "--out", out, "--template", files[1], *COMMAND)
        try:
            main([str(a) for a in (*fixed, *arguments)])
            code = 0
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return call


def refused(answer, *words: str) -> None:
    """The answer is exit code 2 and one line that starts with the program's name and holds these
    words.
    """
    code, _, said = answer
    assert code == 2, said
    assert said.startswith("habitus: ") and said.count("\n") == 1 and "Traceback" not in said, said
    for word in words:
        assert word in said


def test_each_sex_has_a_model(run, tmp_path):
    code, said, wrong = run("--sex", "each", *QUICK)
    assert (code, wrong) == (0, "")
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == {"female", "male"}
    for sex in ("female", "male"):
        assert load_body(out / sex / "model.npz").num_vertices == 320
        with np.load(out / sex / "poses.npz") as arrays:
            people = toy()[1].registrations.where(set="pose", sex=sex)
            assert tuple(arrays["name"]) == people.name
        energies = [
            float(e)
            for e in re.findall(rf"\b{sex} model, round \d, [\w ]+:\s+energy\s+(\S+)", said)
        ]
        assert len(energies) == 5 and energies == sorted(energies, reverse=True)
    assert "more than 15 degrees" in said and "trained models" in said


def test_in_a_pipe_lines_are_not_broken_and_holes_are_a_note(run, tmp_path):
    planted = toy()[1]
    write_registrations(spoil(planted, "hole", 9).registrations, tmp_path / "holes.npz")
    code, said, _ = run(*QUICK, "--unit", "m", data=tmp_path / "holes.npz")
    assert (
        code == 0 and "1 registration has holes" in said and planted.registrations.name[9] in said
    )
    steps = [line for line in said.splitlines() if re.match("model, round", line)]
    assert len(steps) == 5 and all(line.endswith(")") for line in steps)
    assert max(map(len, steps)) > 80 and re.search(r"│ *model +│ +1 +│", said)
    assert f"results are in {tmp_path / 'out'}\n" in said


def test_one_sex_alone_is_the_same_model_and_goes_on_from_there(run, tmp_path):
    assert run("--sex", "female", "--quiet", *QUICK) == (0, "", "")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"female"}
    code, said, _ = run("--sex", "each", *QUICK)
    assert code == 0 and "male model, round 1" in said and "female model, round" not in said


def test_ctrl_c_leaves_a_checkpoint_to_go_on_from(run, tmp_path, monkeypatch):
    whole = CheckpointingCallback.on_step_end

    def stopped(callback, record):
        whole(callback, record)
        if record.step == "weights":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(CheckpointingCallback, "on_step_end", stopped)
        code, _, said = run("--quiet", *QUICK)
    assert (
        code == 130
        and said.count("\n") == 1
        and "resumes" in said
        and str(tmp_path / "out") in said
    )
    code, said, _ = run(*QUICK)
    assert code == 0 and "round 0" not in said and "round 1, poses" in said


@pytest.mark.parametrize("kind", ["torn", "millimetres", "mislabelled"])
def test_spoilt_registrations_are_named_and_nothing_is_trained(kind, run, tmp_path):
    planted = toy()[1]
    write_registrations(spoil(planted, kind, 9).registrations, tmp_path / "spoilt.npz")
    words = {"millimetres": "in millimetres", "mislabelled": "its build is that of"}.get(
        kind, "edges"
    )
    refused(run(data=tmp_path / "spoilt.npz"), planted.registrations.name[9], words)
    assert not (tmp_path / "out").exists()


def test_a_joint_that_never_bends_is_a_warning(run, tmp_path):
    template, planted = toy()
    knee = template.joint_names.index("left_knee")
    write_registrations(spoil(planted, "unposed", knee).registrations, tmp_path / "stiff.npz")
    code, said, _ = run(*QUICK, data=tmp_path / "stiff.npz")
    assert code == 0 and re.search(r"^note .*left_knee.*: fewer than 5 poses bend", said, re.M)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--template", "nothing.npz"], ["nothing.npz"]),
        (["--template", "default"], ["320 vertices, the template has"]),
        (["--unit", "ells"], ["ells", "expected one of"]),
        (["--unit", "mm"], ["a thousand times too small"]),
        (["--rounds", "0"], ["rounds is 0", "expected 1"]),
        (["--workers", "0"], ["0 threads"]),
        (["--every", "0"], ["every 0"]),
        (["--influences", "9"], ["influences is 9", "8 or fewer"]),
        (
            ["--shape-features", "20", "--num-betas", "20"],
            ["too few people to learn shapes from", "expected 21 or more"],
        ),
        (["--weights.joints", "-100"], ["joints is -100", "0 or more"]),
        (["--weights.skinning", "nan"], ["skinning is nan"]),
        (["--tolerance", "-1"], ["tolerance is -1"]),
    ],
)
def test_options_that_nothing_can_be_done_with(options, words, run):
    refused(run(*options), *words)


def test_data_that_are_not_there_or_nothing(run, tmp_path):
    refused(run(data=tmp_path / "none.npz"), "none.npz", "o such file")
    (tmp_path / "text.npz").write_text("no archive")
    refused(run(data=tmp_path / "text.npz"), "text.npz")


def test_nothing_to_learn_poses_from_is_said_before_anything_is_trained(run, tmp_path):
    people = toy()[1].registrations
    write_registrations(people.where(set="shape"), tmp_path / "shape.npz")
    refused(run(data=tmp_path / "shape.npz"), "set 'pose'")
    men = people.take(
        np.array(
            [k for k in range(len(people)) if people.sex[k] == "male" or people.set[k] == "shape"]
        )
    )
    write_registrations(men, tmp_path / "men.npz")
    refused(run("--sex", "each", data=tmp_path / "men.npz"), "no female registration", "set 'pose'")
    assert not (tmp_path / "out").exists()


def test_another_run_in_the_same_folder_is_refused_and_restart_allows_it(run):
    assert run(*QUICK, "--quiet")[0] == 0
    refused(run(*QUICK, "--skinning", "dqbs"), "skinning (lbs, now dqbs)", "--restart")
    assert run(*QUICK, "--skinning", "dqbs", "--restart", "--quiet") == (0, "", "")


def test_a_file_where_the_folder_should_be(run, tmp_path):
    (tmp_path / "taken").write_text("a file")
    refused(run(*QUICK, out=tmp_path / "taken"), "taken")
    refused(run(*QUICK, out=tmp_path / "taken" / "below"), "taken")


def test_options_are_those_of_the_training():
    words = ["people.npz", "--out", "out"]
    assert tyro.cli(Train, args=words).training == TrainOptions()
    assert tyro.cli(Train, args=[*words, *COMMAND]).training == OPTIONS


def test_help_reads_well(capsys):
    with pytest.raises(SystemExit) as end:
        main(["train", "--help"])
    said = capsys.readouterr()
    assert end.value.code == 0 and said.err == "" and "tyro" not in said.out
    words = (
        "DATASET --out --template --sex --skinning --pose-shapes --num-betas --rounds "
        "--cluster --workers --restart"
    )
    assert all(word in said.out for word in words.split())
