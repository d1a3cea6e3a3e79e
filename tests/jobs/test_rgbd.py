"""From a folder of views to results: what is planted is found, what is written can be read, bad
folders say so.
"""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from read_glb import Glb
from rgbd_scene_small import QUICK_DEPTH, small_scene

import habitus as hb
from habitus.cli.main import main
from habitus.files import locked
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.io.rgbd.write import write_views


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The folder of results of the command, and what was planted."""
    folder = tmp_path_factory.mktemp("rgbd")
    body, scene = small_scene()
    write_views(scene.capture, folder / "views")
    fit = hb.fit_rgbd(hb.read_views(folder / "views"), body, settings=QUICK_DEPTH)
    fit.save(folder / "out")
    return folder / "out", body, scene, fit


def test_joint_angles_come_by_the_same_call_as_of_marker_fits(results):
    fit = results[3]
    table = fit.angles("isb")
    assert table.values.shape == (len(fit.pose), len(table.names))
    assert np.isfinite(table.values).all() and not table.validated.any()


def test_the_planted_person_is_found(results):
    out, body, scene, _ = results
    motion = hb.load_motion(out / "body.npz")
    numbers = json.loads((out / "metrics.json").read_text())
    with np.load(out / "body.npz") as file:
        ways = file["T_world_sensor"]
    for k, way in enumerate(ways):
        true = scene.surfaces[k] @ way[:3, :3].T + way[:3, 3]
        assert np.linalg.norm(motion.vertices(k) - true, axis=1).mean() < 0.045
    assert numbers["verdict"]["level"] in ("good", "doubtful")
    true = body.measure_rest(scene.rest)
    assert abs(numbers["body_measurements"]["height_m"] - true["height_m"]) < 0.03
    assert (
        abs(numbers["body_measurements"]["waist_circumference_m"] - true["waist_circumference_m"])
        < 0.06
    )


def test_the_command_says_what_it_found(results, tmp_path, monkeypatch, capsys):
    out, _, _, fit = results
    asked = {}

    def found(views, body, **options):
        settings = options.pop("settings")
        asked.update(
            options, views=len(views.views), body=body, clothes=settings.clothes, hair=settings.hair
        )
        return replace(fit, appearance=None)

    monkeypatch.setattr("habitus.jobs.rgbd.fit_rgbd", found)
    main(
        [
            "rgbd",
            str(out.parent / "views"),
            "--out",
            str(tmp_path / "out"),
            "--turns",
            "0",
            "45",
            "--body",
            "female",
            "--clothes-mm",
            "2",
        ]
    )
    said = capsys.readouterr().out
    told = {"clothes": 0.002, "hair": RgbdSettings().hair}
    assert asked == {"views": 2, "body": "female", "turns": (0.0, 45.0), "age": None, **told}
    assert (
        fit.verdict.level in said
        and "waist" in said
        and (tmp_path / "out" / "report.html").exists()
    )


def test_the_files_say_the_same(results):
    out, _, _, _ = results
    assert {path.name for path in out.iterdir()} == {
        "body.npz", "body.glb", "measurements.csv", "metrics.json", "report.html",
    }  # fmt: skip
    numbers = json.loads((out / "metrics.json").read_text())
    with (out / "measurements.csv").open() as lines:
        rows = {row["name"]: float(row["value"]) for row in csv.DictReader(lines)}
    assert rows.keys() == numbers["body_measurements"].keys()
    assert all(
        abs(rows[name] - value) < 1e-4 * max(value, 1)
        for name, value in numbers["body_measurements"].items()
    )
    main(["measure", str(out / "body.npz"), "--out", str(out.parent / "again.json")])
    again = json.loads((out.parent / "again.json").read_text())["measurements"]
    assert all(abs(again[name] - value) < 1e-4 * max(value, 1) for name, value in rows.items())
    with np.load(out / "body.npz") as file:
        assert 1e-4 < file["skin_offset"].std() < 0.01
    page = (out / "report.html").read_text()
    assert (
        page.count("data:image/png") >= 13
        and "Albedo" in page
        and "http" not in page.replace("http-equiv", "")
    )


def test_metrics_hold_the_status_and_the_cost_of_each_term(results):
    out, _, _, fit = results
    numbers = json.loads((out / "metrics.json").read_text())
    assert numbers["status"] == fit.status
    assert numbers["status"] in ("converged", "iterations", "stalled")
    assert {"depth", "floor", "shape", "pose", "skin", "colour"} <= numbers["costs"].keys()
    assert numbers["costs"] == pytest.approx(dict(fit.costs))


def test_the_glb_carries_the_texture(results):
    out, _, _, _ = results
    document = Glb(out / "body.glb")
    material = document.json["materials"][0]["pbrMetallicRoughness"]
    assert (
        material["baseColorTexture"]["index"] == 0
        and document.json["images"][0]["mimeType"] == "image/png"
    )


def test_bad_folders_give_one_line(tmp_path, capsys):
    _, scene = small_scene()
    write_views(scene.capture, tmp_path / "views")
    said = []
    for spoil in (_no_depth, _no_cameras, _no_intrinsics, _wrong_unit, _nobody):
        place = tmp_path / spoil.__name__
        shutil.copytree(tmp_path / "views", place)
        spoil(place)
        with pytest.raises(SystemExit) as end:
            main(["rgbd", str(place), "--out", str(tmp_path / "out")])
        line = capsys.readouterr().err.strip()
        said.append(line)
        assert end.value.code == 2 and line.startswith("habitus: ") and "\n" not in line
    for words, line in zip(
        ("no depth image", "no intrinsics", "fx, fy", "unit", "person"), said, strict=True
    ):
        assert words in line
    assert not (tmp_path / "out").exists()


def _no_depth(place):
    shutil.rmtree(place / "depth")
    shutil.rmtree(place / "background")


def _no_cameras(place):
    (place / "cameras.json").unlink()


def _no_intrinsics(place):
    (place / "cameras.json").write_text('{"depth": {"width": 224, "height": 168}}')


def _wrong_unit(place):
    table = json.loads((place / "cameras.json").read_text())
    (place / "cameras.json").write_text(json.dumps(table | {"depth_scale": 0.00001}))


def _nobody(place):
    for image in (place / "depth").iterdir():
        shutil.copy(place / "background" / "depth.png", image)


@pytest.mark.parametrize(("strict", "code"), [([], 0), (["--strict"], 3)])
def test_strict_ends_with_code_3_where_the_fit_failed(results, tmp_path, monkeypatch, strict, code):
    out, _, _, fit = results
    evidence = replace(fit.evidence, beta_max=12.0)
    failed = replace(fit, evidence=evidence, appearance=None)
    monkeypatch.setattr("habitus.jobs.rgbd.fit_rgbd", lambda *_, **__: failed)
    arguments = ["rgbd", str(out.parent / "views"), "--out", str(tmp_path / "out"), *strict]
    if not code:
        main(arguments)
        return
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == code and (tmp_path / "out" / "metrics.json").exists()


def test_a_folder_in_which_another_run_works_is_refused(results, tmp_path, capsys):
    with locked(tmp_path / "out"), pytest.raises(SystemExit) as end:
        main(["rgbd", str(results[0].parent / "views"), "--out", str(tmp_path / "out")])
    assert end.value.code == 2 and "out" in capsys.readouterr().err
    assert not (tmp_path / "out" / "metrics.json").exists()
