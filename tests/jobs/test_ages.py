"""The age of a fit's person: asked for or told by the file, kept in what is written, refused where
it is none.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import habitus as hb
from habitus.body.prior import prior_of
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.jobs.bodies import aged_body, of_sex
from habitus.jobs.measuring import measure_file
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

AGE = 8.0
FIRST, LAST = hb.load_body("neutral").ages.years[[0, -1]].tolist()


HASTY = MoshSettings(annealing=(10.0,), frames=3)


@pytest.fixture(scope="module")
def child():
    return hb.load_body("female").at_age(AGE)


@pytest.fixture(scope="module")
def capture(child) -> Capture:
    rng = np.random.default_rng(5)
    layout = load_layout("cmu-41")
    prior = prior_of(child).for_joints(child.joint_names)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 20, 60.0, rng)
    places = layout.vertices(child), layout.distances()
    truth = simulate_capture(child, np.zeros(child.num_betas), pose, trans, *places, Faults(), rng)
    return Capture(
        "walk",
        layout.labels,
        truth.observed,
        60.0,
        "+y",
        recorded={"age_years": AGE, "sex": "female"},
    )


@pytest.fixture(scope="module")
def written(capture, tmp_path_factory):
    """The fit of a child whose file says sex and age, and the folder that it was written to."""
    out = tmp_path_factory.mktemp("child")
    write_c3d(capture, out / "walk.c3d")
    recipe = hb.Mosh(soft_tissue="none", sex="auto", age="auto", settings=HASTY)
    return recipe.fit(out / "walk.c3d", out=out), out / "walk"


def numbers(glb: bytes) -> np.ndarray:
    """All of a glb's binary part; correctives that are equally strong may come in either order,
    with either sign.
    """
    start = 20 + int.from_bytes(glb[12:16], "little") + 8
    return np.frombuffer(glb[start:], np.float32)


def test_an_aged_fit_is_its_file(written, child, tmp_path):
    fit, folder = written
    assert (fit.body.name, fit.body.age, fit.gender) == ("female", AGE, "female")
    assert abs(fit.body.measure(fit.betas)["height_m"] - child.measure()["height_m"]) < 0.06
    assert sum("age auto: the capture's file says 8 years" in note for note in fit.warnings) == 1
    read = hb.load_fit(folder / "body.npz")
    assert (read.body.name, read.body.age) == ("female", AGE)
    np.testing.assert_allclose(read.vertices([0, 9]), fit.vertices([0, 9]), atol=1e-5)
    assert np.allclose(
        hb.load_fit(folder / "body.npz", body="female").vertices(3), fit.vertices(3), atol=1e-5
    )
    assert json.loads((folder / "metrics.json").read_text("utf-8"))["age_years"] == AGE
    assert "body female, 8 years" in (folder / "report.html").read_text("utf-8")
    for end in ("again.glb", "again.npz"):
        read.export(tmp_path / end)
    again, first = ((place).read_bytes() for place in (tmp_path / "again.glb", folder / "body.glb"))
    assert len(again) == len(first)
    np.testing.assert_allclose(
        *(np.sort(np.abs(numbers(one))) for one in (again, first)), rtol=1e-3, atol=1e-7
    )
    assert measure_file(folder / "body.npz").values == pytest.approx(
        fit.body.measure(fit.betas), abs=1e-5
    )
    read.save(tmp_path / "amass", npz_style="amass")
    assert np.load(tmp_path / "amass" / "body.npz")["age_years"] == AGE


def test_a_fit_without_an_age_says_none(written, tmp_path):
    fit, _ = written
    grown = replace(fit, body=hb.load_body("female"))
    grown.export(tmp_path / "grown.npz")
    assert "age_years" not in np.load(tmp_path / "grown.npz")


def test_the_model_of_a_sex_has_the_age_of_the_body_in_whose_place_it_comes():
    assert of_sex(hb.load_body("default").at_age(AGE), "male").age == AGE
    assert hb.Mosh(age="12.5").body("neutral").age == 12.5
    assert hb.load_body("neutral").at_age(AGE).female_direction is None
    assert hb.load_body("neutral").at_age(40).female_direction is not None


@pytest.mark.parametrize(
    ("said", "age", "note"),
    [
        ([7.0, 7.0], 7.0, "says 7 years"),
        ([7.0], 7.0, "says 7 years"),
        ([0.5], FIRST, f"says 0.5 years, the nearest age of the body is {FIRST:g}"),
        ([7.0, 9.0], None, "the files differ"),
        ([None], None, "gives none"),
    ],
)
def test_auto_believes_files_that_agree(said, age, note):
    captures = [SimpleNamespace(recorded={} if one is None else {"age_years": one}) for one in said]
    body, notes = aged_body(hb.load_body("male"), "auto", SimpleNamespace(captures=captures))
    assert body.age == age and len(notes) == 1 and note in notes[0]


@pytest.mark.parametrize("age", ["eight", "nan", "", [8]])
def test_what_is_no_age_is_refused(age):
    with pytest.raises(HabitusError, match="expected years, such as 8, or auto"):
        hb.Mosh(age=age)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--age", "eight"), "age is 'eight'; expected years"),
        (("--age", "0.5"), f"age 0.5: this body knows {FIRST:g} to {LAST:g} years"),
    ],
)
def test_a_command_with_a_wrong_age_ends_in_one_line(words, reason, capture, tmp_path, capsys):
    write_c3d(capture, tmp_path / "walk.c3d")
    with pytest.raises(SystemExit) as ended:
        main(["mosh", str(tmp_path / "walk.c3d"), "--out", str(tmp_path / "out"), *words])
    told = capsys.readouterr().err
    assert ended.value.code == 2 and reason in told and told.count("\n") == 1


def test_a_body_that_knows_no_ages_is_refused(tmp_path):
    from synthetic import synthetic_body

    with pytest.raises(HabitusError, match="knows of no ages"):
        hb.Mosh(age=AGE).body(synthetic_body("smpl", 200))
    with pytest.raises(HabitusError, match="female of 8 years cannot be brought to 9"):
        hb.Mosh(age=9).body(hb.load_body("female").at_age(AGE))
