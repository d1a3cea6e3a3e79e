"""`habitus evaluate`: what models measure on files that they were made from, what is written, what
is refused.
"""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tube_body import tube_body
from tube_people import tube_people, tube_scape, written_tubes

from habitus.cli.evaluate import Evaluate, summary
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body, save_body
from habitus.io.registrations.open import open_registrations, write_registrations
from habitus.jobs import evaluate as evaluation
from habitus.jobs.evaluate import evaluate, load_models, shape_variances
from habitus.parallel.workers import Threads

QUICK = ("--counts", "2", "4", "--repeats", "1", "--workers", "1")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return written_tubes(tmp_path_factory.mktemp("tubes"))


@pytest.fixture
def run(capsys, tmp_path):
    """Runs the command in this process: its exit code (0 where it just returns) and what it said on
    stderr.
    """

    def call(*arguments, out=tmp_path / "out"):
        capsys.readouterr()
        try:
            main(["evaluate", *map(str, arguments), "--out", str(out)])
            code = 0
        except SystemExit as end:
            code = end.code
        return code, capsys.readouterr().err

    return call


@pytest.fixture
def unfitted(monkeypatch):
    """Whatever comes to fitting fails: what is wrong must be found before."""

    def never(*arguments, **options):
        raise AssertionError("fits were begun")

    monkeypatch.setattr(evaluation, "model_generalisation", never)


def refused(answer, *words: str) -> None:
    code, said = answer
    assert code == 2, said
    assert said.startswith("habitus: ") and said.count("\n") == 1 and "Traceback" not in said, said
    for word in words:
        assert word in said


def test_a_model_on_its_own_meshes_is_off_by_nothing_and_plain_skinning_is(files, run, tmp_path):
    assert run(files["tubes"], files["clean"], "--plain", "--quiet", *QUICK) == (0, "")
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == {
        "report.html",
        "evaluation.json",
        "per_vertex.npz",
        "figures",
    }
    numbers = json.loads((out / "evaluation.json").read_text("utf-8"))
    own, plain = numbers["models"]
    assert (own["name"], plain["without_pose_shapes_of"]) == ("tubes", "tubes") and not numbers[
        "dataset"
    ]["noise_free"]
    for measure in ("model_generalisation", "pose_generalisation"):
        assert own[measure]["counts"] == [2, 4] and own[measure]["mean_mm"][1] < 0.02
        assert plain[measure]["mean_mm"][1] > 1.0 and own[measure]["mean_mm"][0] > 1.0
    assert own["model_generalisation"]["registrations"] == [
        "ann-0",
        "bob-1",
        "ann-2",
        "bob-3",
        "eve-4",
    ]
    assert own["removed_by_pose_shapes"]["percent"][1] > 98
    assert own["pose_generalisation"]["registrations"] == ["ann-2", "bob-3"]


def test_python_measures_noise_and_truth_for_every_kind_of_model(files):
    stages = []
    found = evaluate(
        [files["tubes"], files["dual"], tube_scape(tube_people().body)],
        files["noisy"],
        clean=files["clean"],
        counts=(2, 4),
        repeats=1,
        workers=Threads(2),
        progress=lambda stage, share: stages.append((stage, share)),
    )
    tubes, dual, scape = found.models
    assert (found.shown, dual.shape.counts, scape.shape.counts) == (2, (2, 3), (2,))
    assert tubes.shape.clean_means[-1] < 0.75 * tubes.shape.means[-1] < 0.002
    assert dual.pose.means[-1] > tubes.pose.means[-1] and scape.pose.means[-1] > tubes.pose.means[0]
    shares = [share for _, share in stages]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1
    assert [stage for stage, _ in stages][1:] != [] and any("dual" in stage for stage, _ in stages)
    table = summary(found)
    assert table.row_count == 3 and len(table.columns) == 5


def test_sets_and_sexes_are_chosen(files):
    def of(**chosen):
        made = evaluate(
            [files["tubes"]], files["clean"], counts=(4,), repeats=1, workers=Threads(1), **chosen
        )
        return made.registrations.name, made.models[0].pose is not None

    assert of(split="pose") == (("zoe-5", "zoe-6"), True)
    assert of(sex="male") == (("bob-1", "bob-3"), True)


def test_bodies_and_open_registrations_are_measured_as_files_are(files):
    asked = {"counts": (4,), "repeats": 1, "plain": True}
    body = replace(load_body(files["tubes"]), name="tubes")
    (ours, plain), (theirs, _) = (
        evaluate([model], data, workers=1, **asked).models
        for model, data in (
            (body, open_registrations(files["clean"])),
            (files["tubes"], files["clean"]),
        )
    )
    np.testing.assert_array_equal(ours.shape.errors, theirs.shape.errors)
    assert (ours.name, ours.file, theirs.name) == ("tubes", None, "tubes")
    assert plain.without_pose_shapes_of == "tubes" and plain.pose.means[-1] > ours.pose.means[-1]
    with pytest.raises(HabitusError, match="two models are called tubes"):
        evaluate([body, body], files["clean"])
    folder = files["tubes"].parent.name  # a file can be told apart by its folder
    assert [one.model.name for one in load_models([body, files["tubes"]], False)] == [
        "tubes",
        f"{folder}/tubes",
    ]
    with pytest.raises(HabitusError, match="0 threads"):
        evaluate([body], files["clean"], workers=0)


def test_people_seen_once_have_no_pose_generalisation(files, tmp_path, run):
    once = tube_people().clean.take(np.array([0, 1, 4]))
    write_registrations(once, tmp_path / "once.npz")
    assert run(files["tubes"], tmp_path / "once.npz", "--quiet", *QUICK) == (0, "")
    (model,) = json.loads((tmp_path / "out" / "evaluation.json").read_text("utf-8"))["models"]
    assert (
        model["pose_generalisation"] is None and model["model_generalisation"]["mean_mm"][1] < 0.02
    )
    assert "Pose generalisation" not in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_clean_meshes_are_found_by_name(files, tmp_path):
    shuffled = tube_people().clean.take(np.array([6, 4, 2, 0, 1, 3, 5]))
    write_registrations(shuffled, tmp_path / "shuffled.npz", dtype=np.float64)
    options = {"counts": (4,), "repeats": 1, "workers": Threads(1)}
    one, other = (evaluate([files["tubes"]], files["noisy"], clean=c, **options).models[0]
                  for c in (files["clean"], tmp_path / "shuffled.npz"))  # fmt: skip
    np.testing.assert_array_equal(one.shape.clean_errors, other.shape.clean_errors)


def test_models_of_one_name_are_told_apart_by_their_folders(files, tmp_path):
    for folder in ("women", "men"):
        (tmp_path / folder).mkdir()
        for name in ("model", "dual"):
            shutil.copy(files["dual"], tmp_path / folder / f"{name}.npz")
    models = [
        tmp_path / folder / f"{name}.npz"
        for folder in ("women", "men")
        for name in ("model", "dual")
    ]
    found = load_models(models, plain=False)
    assert [one.model.name for one in found] == ["women", "women/dual", "men", "men/dual"]


def test_variances_are_those_of_the_training_where_it_told_them(files, tmp_path):
    record = {
        "shape_variances": [4.0, 2.0, 1.0],
        "baselines": {"plain-lbs": {"shape_variances": [3.0, 1.0]}},
    }
    (tmp_path / "training.json").write_text(json.dumps(record))
    for name in ("model", "plain-lbs", "other"):
        shutil.copy(files["tubes"], tmp_path / f"{name}.npz")
    loaded = load_models(
        [tmp_path / f"{name}.npz" for name in ("model", "plain-lbs", "other")], plain=False
    )
    (model, all_of_it), (plain, _), (other, told) = (
        shape_variances(one.model, one.file) for one in loaded
    )
    assert model.tolist() == [4, 2, 1] and plain.tolist() == [3, 1] and all_of_it and not told
    np.testing.assert_allclose(other, (tube_people().body.shapedirs ** 2).sum((0, 1)))


def test_numbers_of_coefficients_default_to_those_of_the_papers_figures():
    assert Evaluate(paths=("m.npz", "d.npz"), out=None).counts == (1, 2, 5, 10, 20, 50, 100)


# -- bad input -------------------------------------------------------------------------------------


def test_what_nothing_can_be_done_with_is_told_before_the_fits(files, run, tmp_path, unfitted):
    tubes = files["tubes"]
    data = files["noisy"]
    (tmp_path / "text.npz").write_text("no model")
    (tmp_path / "taken").write_text("a file")
    save_body(tube_body(betas=2, around=4, along=3, pose_shapes=0.0), tmp_path / "other.npz")
    refused(run(data), "expected one or more models")
    refused(run("nobody.npz", data), "nobody.npz")
    refused(run(tmp_path / "text.npz", data), "text.npz")
    refused(run(tubes, tmp_path / "nothing.npz"), "nothing.npz")
    refused(run(tubes, tubes, data), "two models are called", "rename")
    refused(run(tmp_path / "other.npz", data), "another topology", "160 vertices")
    refused(run("default", data), "another topology", "default")
    refused(run(tubes, data, "--split", "shape"), "no registrations of the set 'shape'", "--split")
    refused(run(tubes, data, "--workers", "0"), "threads", "expected 1 or more")
    refused(run(tubes, data, "--unit", "furlong"), "unit")
    refused(run(tubes, data, out=tmp_path / "taken"), "taken", "--out")
    refused(run(tubes, data, "--cluster", "nowhere"), "nowhere")
    refused(run(tubes, data, "--repeats", "0"), "0 repeats")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda v: 1000 * v, "in millimetres"),
        (lambda v: v[:, ::-1], "edges"),
        (lambda v: np.where(np.arange(v.shape[1])[:, None] == 7, np.inf, v), "not finite"),
    ],
)
def test_spoilt_meshes_are_named_before_the_fits(files, run, tmp_path, unfitted, spoil, words):
    noisy = tube_people().noisy
    rows = np.array([4])
    vertices = np.array(noisy.vertices)
    vertices[rows] = spoil(vertices[rows])
    write_registrations(replace(noisy, vertices=vertices), tmp_path / "spoilt.npz")
    refused(run(files["tubes"], tmp_path / "spoilt.npz"), f"{noisy.name[4]}: ", words)


def test_of_meshes_of_one_name_each_fit_knows_its_own(files, tmp_path):
    people = tube_people().noisy
    write_registrations(
        replace(people, name=("same",) * len(people)), tmp_path / "same.npz", dtype=np.float64
    )
    found = evaluate(
        [files["tubes"]], tmp_path / "same.npz", counts=(4,), repeats=1, workers=Threads(1)
    ).models[0]
    for curve in (found.shape, found.pose):
        assert [people.subject[row] for row in curve.rows] == list(curve.subjects)
        for n, row in enumerate(curve.rows):
            fitted = found.model.surface(curve.shape(-1, n), curve.pose[-1, n]) + curve.trans[-1, n]
            assert np.linalg.norm(fitted - people.read(row), axis=1).mean() == pytest.approx(
                curve.errors[-1, n]
            )


def test_clean_meshes_that_are_not_the_same_are_refused(files, run, tmp_path, unfitted):
    clean = tube_people().clean
    renamed = replace(clean, name=("someone", *clean.name[1:]))
    write_registrations(renamed, tmp_path / "renamed.npz")
    write_registrations(replace(clean, name=("ann-0",) * 7), tmp_path / "same.npz")
    refused(
        run(files["tubes"], files["noisy"], "--clean", tmp_path / "renamed.npz"),
        "renamed.npz",
        "ann-0",
    )
    refused(
        run(files["tubes"], files["noisy"], "--clean", tmp_path / "same.npz"), "same.npz", "bob-1"
    )


def test_without_matplotlib_the_extra_is_named(files, run, monkeypatch, unfitted):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    refused(run(files["tubes"], files["noisy"]), "matplotlib", "habitus[train]")


def test_help_reads_well(capsys):
    with pytest.raises(SystemExit) as end:
        main(["evaluate", "--help"])
    said = capsys.readouterr()
    assert end.value.code == 0 and said.err == "" and "tyro" not in said.out
    for word in "MODEL DATASET --out --counts --split --clean --plain --cluster --workers report.html".split():
        assert word in said.out


def test_registrations_with_unobserved_vertices_are_measured_where_they_were_observed(
    files, run, tmp_path
):
    """As `habitus register` writes them: weights of 0 in holes."""
    data = open_registrations(files["clean"])
    weights = np.ones((len(data), data.num_vertices))
    weights[:, ::7] = 0.0
    vertices = np.array(data.vertices[:])
    vertices[:, ::7] += 1.0
    count = len(data)
    holey = replace(data, vertices=vertices, weights=weights, verdict=("good",) * count)
    write_registrations(holey, tmp_path / "registrations.npz")
    assert run(files["tubes"], tmp_path / "registrations.npz", "--quiet", *QUICK) == (0, "")
    numbers = json.loads((tmp_path / "out" / "evaluation.json").read_text("utf-8"))
    assert numbers["models"][0]["model_generalisation"]["mean_mm"][1] < 0.02
    assert 0.8 < numbers["dataset"]["observed_fraction"] < 0.9
    with np.load(tmp_path / "out" / "per_vertex.npz") as found:
        assert np.isnan(found["tubes/model"][:, ::7]).all()
