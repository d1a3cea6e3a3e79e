"""Measurements of files: bodies, people of them, meshes at rest; and what is refused."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from synthetic import synthetic_body

import habitus
from habitus.errors import HabitusError
from habitus.fit.from_measurements import ESTIMATE
from habitus.io.models.bodies import save_body
from habitus.jobs.estimates import body_from_measurements, save_estimate
from habitus.jobs.measuring import measure_file


@pytest.fixture(scope="module")
def body():
    return habitus.load_body("default")


def test_a_body_a_person_and_a_mesh_of_it_measure_alike(body, tmp_path):
    betas = np.array([1.0, -0.5, 0.8])
    truth = body.measure(betas)
    np.savez(
        tmp_path / "fit.npz", betas=betas, surface_model_type="default", poses=np.zeros((1, 72))
    )
    habitus.write_surface(body(betas), tmp_path / "rest.ply")
    habitus.write_surface(body(betas), tmp_path / "rest.obj")
    for name in ("fit.npz", "rest.ply", "rest.obj"):
        assert measure_file(tmp_path / name).values == pytest.approx(truth, abs=2e-3), name
    assert measure_file("default").values == body.measure()


def test_they_are_written_and_drawn(tmp_path):
    found = measure_file("default")
    for name in ("a.json", "a.csv"):
        found.save(tmp_path / name)
    found.draw(tmp_path / "a.svg")
    facts = json.loads((tmp_path / "a.json").read_text())
    assert facts["measurements"] == pytest.approx(found.values) and "arms level" in facts["pose"]
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert {row["name"]: float(row["value"]) for row in rows} == pytest.approx(
        found.values, rel=1e-4
    )
    assert (tmp_path / "a.svg").read_text().startswith("<svg")
    for write, name in ((found.save, "a.txt"), (found.draw, "a.jpg")):
        with pytest.raises(HabitusError, match=f"{name}: expected a name in"):
            write(tmp_path / name)


def test_a_posed_mesh_is_refused(body, tmp_path):
    habitus.write_surface(body(pose={"left_elbow": (0, -0.6, 0)}), tmp_path / "posed.ply")
    with pytest.raises(HabitusError, match=r"is posed \(a limb is 3\d degrees from rest\)"):
        measure_file(tmp_path / "posed.ply")


def test_of_an_unknown_mesh_only_what_is_safe_is_measured(tmp_path):
    block = trimesh.creation.box((0.4, 1.7, 0.2))
    block.export(tmp_path / "block.ply")
    found = measure_file(tmp_path / "block.ply")
    assert found.values == pytest.approx(
        {"height_m": 1.7, "mass_kg": 136.0, "volume_m3": 0.136, "surface_area_m2": 2.2}
    )
    assert "no known body" in found.notes[0]
    with pytest.raises(HabitusError, match="no tapes were laid"):
        found.draw(tmp_path / "block.svg")
    block.update_faces(np.arange(len(block.faces)) > 1)
    block.export(tmp_path / "open.ply")
    assert set(measure_file(tmp_path / "open.ply").values) == {"height_m"}
    block.apply_scale(1000).export(tmp_path / "millimetres.ply")
    with pytest.raises(HabitusError, match="expected a person in metres"):
        measure_file(tmp_path / "millimetres.ply")
    with pytest.raises(HabitusError, match="triangles are not those of default"):
        measure_file(tmp_path / "block.ply", "default")


def test_a_part_of_a_body_has_no_stature(body, tmp_path):
    surface = body()
    vertices, faces = np.asarray(surface.vertices), np.asarray(body.faces)
    for name, keep in {"upper": vertices[:, 1] > 0.0, "lower": vertices[:, 1] < 0.0}.items():
        trimesh.Trimesh(vertices, faces[keep[faces].all(1)], process=False).export(
            tmp_path / f"{name}.ply"
        )
        with pytest.raises(HabitusError, match="part of a body"):
            measure_file(tmp_path / f"{name}.ply")
    low = vertices[:, 1].min()
    soleless = faces[(vertices[faces][:, :, 1] > low + 0.02).all(1)]
    trimesh.Trimesh(vertices, soleless, process=False).export(tmp_path / "soleless.ply")
    found = measure_file(tmp_path / "soleless.ply")
    assert set(found.values) == {"height_m"} and "WARNING" in " ".join(found.notes)


def test_vertices_that_are_no_numbers_are_refused(body, tmp_path):
    vertices = np.array(body().vertices)
    vertices[100] = np.nan
    for faces in (body.faces, body.faces[10:]):
        trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "a.ply")
        with pytest.raises(HabitusError, match="no numbers"):
            measure_file(tmp_path / "a.ply")


def test_files_that_hold_no_person(tmp_path):
    np.savez(tmp_path / "amass.npz", betas=np.zeros(10), gender="female")
    with pytest.raises(HabitusError, match="betas name no body"):
        measure_file(tmp_path / "amass.npz")
    assert measure_file(tmp_path / "amass.npz", "default").values["height_m"] > 1.5
    np.savez(tmp_path / "smplh.npz", betas=np.zeros(10), surface_model_type="smplh")
    with pytest.raises(HabitusError, match="belong to the body 'smplh'; give"):
        measure_file(tmp_path / "smplh.npz")
    np.savez(tmp_path / "many.npz", betas=np.ones(400), surface_model_type="default")
    with pytest.raises(HabitusError, match="400 betas; default has 100"):
        measure_file(tmp_path / "many.npz")
    np.savez(tmp_path / "crowd.npz", betas=np.zeros((3, 4)), surface_model_type="default")
    with pytest.raises(HabitusError, match="of one person"):
        measure_file(tmp_path / "crowd.npz")
    save_body(synthetic_body("mano", 60), tmp_path / "hand.npz")
    with pytest.raises(HabitusError, match="no measurement landmarks"):
        measure_file(tmp_path / "hand.npz")
    with pytest.raises(HabitusError, match=r"none\.npz"):
        measure_file(tmp_path / "none.npz")


def test_an_estimated_person_is_measured_again(tmp_path):
    found = body_from_measurements(height=1.66, waist=0.8)
    save_estimate(found, tmp_path / "her.npz")
    save_estimate(found, tmp_path / "her.glb")
    assert measure_file(tmp_path / "her.npz").values == pytest.approx(found.measurements)
    assert (tmp_path / "her.glb").read_bytes()[:4] == b"glTF"


def test_sexes_and_ages_that_are_none():
    with pytest.raises(HabitusError, match="sex is 'other'; expected one of neutral, female, male"):
        body_from_measurements(sex="other", height=1.7)
    with pytest.raises(HabitusError, match="knows of no ages"):
        body_from_measurements(body=synthetic_body("smpl", 200), age=7, height=1.2)


def test_settings_say_how_rare_a_person_may_be():
    settings = replace(ESTIMATE, max_sd=1.0)
    with pytest.raises(HabitusError, match="standard deviations from the people"):
        body_from_measurements(height=2.05, settings=settings)
    assert body_from_measurements(height=2.05).measurements["height_m"] == pytest.approx(
        2.05, abs=0.01
    )


def test_a_child_is_made_and_measured_again(tmp_path):
    found = body_from_measurements(sex="female", age=8, height=1.27)
    assert found.measurements["height_m"] == pytest.approx(1.27, abs=3e-3) and found.age == 8
    save_estimate(found, tmp_path / "girl.npz")
    assert measure_file(tmp_path / "girl.npz").values == pytest.approx(found.measurements)


def test_a_mesh_of_either_level_of_any_space_is_known_for_what_it_is(tmp_path):
    for sex, level in (("male", "full"), ("female", "coarse")):
        body = habitus.load_body(sex, detail=level)
        betas = [1.0, -1.0, 1.5, 1.0]
        habitus.write_surface(body(betas), tmp_path / f"{sex}.ply")
        found = measure_file(tmp_path / f"{sex}.ply")
        assert (
            found.values == pytest.approx(body.measure(betas), abs=1e-4) and found.body.name == sex
        )


def test_skin_of_another_body_is_refused(tmp_path):
    """Taken without a word, the person would be measured as betas alone have them."""
    path = tmp_path / "person.npz"
    np.savez(
        path,
        betas=np.zeros(3),
        surface_model_type="neutral",
        gender="neutral",
        skin_offset=np.zeros(11),
    )
    with pytest.raises(HabitusError, match=r"skin_offset is \(11,\); expected \(7499,\)"):
        measure_file(path)


def test_segments_add_up_and_stand_where_the_body_does(body, tmp_path):
    found = measure_file("default")
    for name in ("a.json", "a.csv"):
        found.save_segments(tmp_path / name)
    facts = json.loads((tmp_path / "a.json").read_text())["segments"]
    assert sum(part["mass_kg"] for part in facts.values()) == pytest.approx(found.values["mass_kg"])
    volume = sum(part["volume_m3"] for part in facts.values())
    assert volume == pytest.approx(found.values["volume_m3"], rel=1e-6)
    for side in ("left", "right"):
        share = facts[f"{side}_thigh"]["mass_kg"] / found.values["mass_kg"]
        assert 0.08 < share < 0.16  # a thigh: Dempster .100, de Leva .142 and .148
    assert 0.42 < facts["trunk"]["mass_kg"] / found.values["mass_kg"] < 0.55
    rest = found.rest_vertices
    for part in facts.values():
        assert (rest.min(0) < part["centre_m"]).all() and (part["centre_m"] < rest.max(0)).all()
        assert (np.linalg.eigvalsh(part["inertia_kg_m2"]) > 0.0).all()
    left, right = (facts[f"{side}_shank"] for side in ("left", "right"))
    assert (
        np.abs(np.array(left["centre_m"]) - np.array(right["centre_m"]) * [-1, 1, 1]).max() < 0.002
    )
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert [row["segment"] for row in rows] == list(facts)
    with pytest.raises(HabitusError, match=r"a\.txt: expected a name in"):
        found.save_segments(tmp_path / "a.txt")
    trimesh.creation.cylinder(0.1, 1.7).apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    ).export(tmp_path / "tube.ply")
    with pytest.raises(HabitusError, match="no known body has no segments"):
        measure_file(tmp_path / "tube.ply").save_segments(tmp_path / "b.csv")
