"""`habitus gait --opensim-model`: a made generic model scaled to a child's two walks, and checked."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from opensim_models import write_small_model

import habitus as hb
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.jobs.gait import gait, gaits
from habitus.jobs.opensim import LANDMARKS_MM, RMS_MM, _verdict, in_stance, scaled_model, solve

NAMES = ("HC030A05", "HC030A22")


@pytest.fixture(scope="module")
def opensim():
    pytest.importorskip("opensim", reason="pip install opensim")
    from habitus.export.opensim_engine import engine

    return engine()


@pytest.fixture(scope="module")
def walks(shared, opensim, tmp_path_factory):
    """Two walks of a child over plates, and what the command wrote of them."""
    folder = tmp_path_factory.mktemp("opensim")
    generic = write_small_model(opensim, folder / "generic.osim")
    captures = [shared / "mocap" / f"{name}.c3d" for name in NAMES]
    results = gaits(captures, folder / "out", opensim_model=generic)
    return results, folder / "out", generic


def check_of(out: Path, name: str) -> dict:
    return json.loads((out / name / "opensim" / "check.json").read_text())


def columns(path: Path) -> dict[str, np.ndarray]:
    lines = path.read_text().splitlines()
    start = lines.index("endheader") + 1
    rows = [[float(x) for x in line.split()] for line in lines[start + 1 :]]
    return dict(zip(lines[start].split("\t"), np.array(rows).T, strict=True))


def test_a_trial_that_placed_nothing_is_followed_well(walks):
    """5 mm as measured; its markers were placed on the other one."""
    _, out, _ = walks
    one, other = (check_of(out, name) for name in NAMES)
    assert one["markers_placed_on"] == other["markers_placed_on"] == NAMES[0]
    assert one["unused_frames_marker_rms_mm"] is None and one["verdict"]["level"] == "doubtful"
    assert other["unused_frames_marker_rms_mm"] == other["marker_rms_mm"] < 8.0
    assert one["scale_factors"] == other["scale_factors"]


def test_the_scaled_model_is_as_large_as_the_child(walks):
    results, out, _ = walks
    check = check_of(out, NAMES[1])
    model, fit = (check["joints_mm"][name] for name in ("scaled_model", "fit"))
    assert set(model) == set(fit) and len(fit) == 5
    for name, value in model.items():
        assert abs(value - fit[name]) < 35.0, name  # of a generic one that is 120 mm taller
    assert model["left_hip to left_knee"] == pytest.approx(model["right_hip to right_knee"])
    assert check["mass_kg"] == pytest.approx(results[0].masses.total)
    bodies = ElementTree.parse(out / NAMES[1] / "opensim" / "scaled_model.osim").iter("Body")
    mass = sum(float(body.findtext("mass") or 0.0) for body in bodies)
    assert mass == pytest.approx(check["mass_kg"], rel=1e-6)


def test_the_set_ups_give_in_opensim_what_was_written(walks, opensim, tmp_path, monkeypatch):
    _, out, _ = walks
    folder = tmp_path / "opensim"
    shutil.copytree(out / NAMES[1] / "opensim", folder)
    before = columns(folder / "inverse_kinematics.mot")
    monkeypatch.chdir(folder)
    opensim.InverseKinematicsTool("inverse_kinematics.xml").run()
    after = columns(folder / "inverse_kinematics.mot")
    assert np.array_equal(before["time"], after["time"])
    for name in ("hip_flexion_r", "knee_angle_l", "ankle_angle_r", "pelvis_ty"):
        np.testing.assert_allclose(
            after[name], before[name], atol=1.0, err_msg=name
        )  # of its accuracy


def test_inverse_dynamics_balances_the_plates(walks):
    """Forces that nobody exerts are some percent of the body weight, as without OpenSim."""
    results, out, _ = walks
    for result in results:
        check = check_of(out, result.name)
        assert result.residual_share < 0.05
        assert 0.0 < check["residual_share_of_weight"] < 0.1
        forces = columns(out / result.name / "opensim" / "inverse_dynamics.sto")
        assert len(forces["time"]) == len(result.residual)


def test_check_stands_in_the_numbers_and_on_the_page(walks):
    results, out, _ = walks
    numbers = json.loads((out / NAMES[1] / "gait.json").read_text())
    assert numbers["opensim"] == check_of(out, NAMES[1])
    page = (out / NAMES[1] / "gait.html").read_text()
    assert "<h2>OpenSim</h2>" in page and "in frames that nothing was taken from" in page
    results[1].save(out.parent / "plain", opensim=True)
    assert "<h2>OpenSim</h2>" not in (out.parent / "plain" / "gait.html").read_text()


def test_one_trial_is_checked_on_its_second_half(walks):
    results, _, generic = walks
    fit = results[0].motion
    model = scaled_model([fit], generic, 45.8)
    assert model.placed_until == fit.num_frames // 2
    folder = generic.parent / "alone"
    folder.mkdir()
    result = results[0]
    check = solve(model, fit, result.plates, result.contacts, result.residual, folder)
    assert check["unused_frames"] == fit.num_frames - fit.num_frames // 2
    assert check["unused_frames_marker_rms_mm"] < 10.0


def test_nothing_is_printed_and_no_log_is_left(walks, tmp_path, monkeypatch, capfd):
    results, _, generic = walks
    results[0].motion.save(tmp_path / "fit")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    out = str(tmp_path / "out")
    given = [str(tmp_path / "fit"), "--out", out, "--opensim-model", str(generic), "--quiet"]
    main(["gait", *given])
    printed = capfd.readouterr()
    assert not printed.err and "MODEL" not in printed.out
    assert not list((tmp_path / "here").iterdir())
    assert (tmp_path / "out" / "opensim" / "check.json").is_file()


def test_wrong_models_are_refused_in_a_line_and_nothing_is_written(walks, opensim, tmp_path):
    results, _, generic = walks
    fit = results[0].motion
    fit.save(tmp_path / "fit")
    bare = write_small_model(opensim, tmp_path / "bare.osim", markers=False)
    text = generic.read_text()
    (tmp_path / "entity.osim").write_text('<!DOCTYPE a [<!ENTITY b "c">]><OpenSimDocument/>')
    (tmp_path / "other.osim").write_text("<robot/>")
    (tmp_path / "half.osim").write_text(text[: len(text) // 2])
    for name, message in (
        ("bare.osim", "labels of its 0 markers"),
        ("entity.osim", "entity"),
        ("other.osim", "expected an <OpenSimDocument>"),
        ("half.osim", "expected a file of OpenSim's"),
        ("none.osim", "none.osim"),
    ):
        with pytest.raises(HabitusError, match=message) as caught:
            gaits([tmp_path / "fit"], tmp_path / "out", opensim_model=tmp_path / name)
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "out" / "gait.json").exists()
    with pytest.raises(HabitusError, match="give --opensim-model"):
        gaits([tmp_path / "fit"], tmp_path / "out", opensim_markers=bare)
    with pytest.raises(HabitusError, match="different body shapes"):
        scaled_model([fit, replace(fit, betas=fit.betas + 0.1)], generic, 45.8)


def test_markers_of_a_model_without_come_from_a_marker_set(walks, opensim, tmp_path):
    from habitus.export.opensim_engine import load_model

    results, _, generic = walks
    bare = write_small_model(opensim, tmp_path / "bare.osim", markers=False)
    model = load_model(generic)  # a set is its model's: it must stay
    model.getMarkerSet().printToXML(str(tmp_path / "markers.xml"))
    fit = results[0].motion
    one = scaled_model([fit], generic, 45.8)
    other = scaled_model([fit], bare, 45.8, tmp_path / "markers.xml")
    for body, factors in one.scaling.factors.items():
        np.testing.assert_allclose(other.scaling.factors[body], factors, rtol=1e-6)


def test_suspect_markers_place_and_follow_nothing(walks):
    from habitus.fit.markers.suspects import Suspect

    results, _, generic = walks
    fit = results[0].motion
    wrong = replace(fit, suspects=(Suspect("LKNE", "made", 10),))
    model = scaled_model([wrong], generic, 45.8)
    assert "LKNE" in model.left_out and "RKNE" in model.labels


def test_the_stance_has_arms_as_in_the_motion_and_legs_as_at_rest(shared):
    fit = hb.mosh(shared / "mocap" / "HC030A05.c3d")[0]
    at = {label: k for k, label in enumerate(fit.labels)}
    stance = 1e3 * in_stance(fit, fit.latent_markers)
    seen = np.nanmedian(
        1e3 * np.linalg.norm(
            fit.observed_markers[:, at["LSHO"]] - fit.observed_markers[:, at["RSHO"]], axis=1
        )
    )  # fmt: skip
    assert np.linalg.norm(stance[at["LSHO"]] - stance[at["RSHO"]]) == pytest.approx(seen, abs=15.0)
    rest = 1e3 * fit.latent_markers
    for one, other in (("LKNE", "LANK"), ("LASI", "RASI"), ("LHEE", "LTOE")):
        before, after = (np.linalg.norm(p[at[one]] - p[at[other]]) for p in (rest, stance))
        assert after == pytest.approx(before, abs=0.1)
    assert stance[at["RASI"], 2] > 0.0 > stance[at["LASI"], 2]  # z to the right


@pytest.mark.parametrize(
    ("rms", "landmarks", "factor", "level"),
    [(5.0, 15.0, 1.0, "good"), (RMS_MM.doubtful + 1.0, 15.0, 1.0, "doubtful"),
     (RMS_MM.failed + 1.0, 15.0, 1.0, "failed"), (None, 15.0, 1.0, "doubtful"),
     (5.0, LANDMARKS_MM.doubtful + 1.0, 1.0, "doubtful"), (5.0, 15.0, 0.6, "doubtful")],
)  # fmt: skip
def test_verdicts(rms, landmarks, factor, level):
    factors = {"pelvis": [1.0] * 3, "torso": [0.9] * 3, "femur_r": [factor] * 3}
    found = {"unused_frames_marker_rms_mm": rms, "landmark_rms_mm": landmarks}
    found |= {"scale_factors": factors, "fit_verdict": "good"}
    verdict = _verdict(found)
    assert verdict["level"] == level and verdict["reasons"]
    assert _verdict(found | {"fit_verdict": "failed"})["level"] != "good"
    assert ("femur_r" in " ".join(verdict["reasons"])) == (factor != 1.0)


def test_without_opensim_the_extra_is_named(shared, tmp_path, monkeypatch):
    import importlib.util

    fit = hb.mosh(shared / "mocap" / "HC030A05.c3d")[0]
    fit.save(tmp_path / "fit")
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "opensim" else real(name, *a)
    )
    with pytest.raises(HabitusError, match=r"habitus\[opensim\]"):
        gaits([tmp_path / "fit"], tmp_path / "out", opensim_model=tmp_path / "generic.osim")
    assert not (tmp_path / "out").exists()
    gait(fit).save(tmp_path / "plain", opensim=True)  # the folder alone needs none
