from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import official_arrays, write_official

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import load_template, save_template
from habitus.mesh.mirror import find_mirror
from habitus.mesh.shapes import icosphere
from habitus.mesh.template import Template

TOML = """
mesh = "ball.ply"
unit = "mm"

[[joint]]
name = "root"
vertices = {low}

[[joint]]
name = "top"
parent = "root"
vertices = {high}
"""


def ball() -> Template:
    shape = icosphere(1)
    vertices = shape.vertices.numpy()
    faces = shape.faces.numpy()
    part = (vertices[:, 1] > 0).astype(np.int64)
    return Template(vertices, faces, part, (-1, 0), ("root", "top"))


def write_toml(folder, template, text=TOML, **changed):
    trimesh.Trimesh(1000 * template.vertices, template.faces, process=False).export(
        folder / "ball.ply"
    )
    words = {
        "low": template.part_vertices(0).tolist(),
        "high": template.part_vertices(1).tolist(),
    } | changed
    path = folder / "ball.toml"
    path.write_text(text.format(**words))
    return path


def same(one: Template, other: Template):
    assert np.allclose(one.vertices, other.vertices, atol=1e-6)
    for key in ("faces", "part", "mirror", "joint_mirror"):
        a = getattr(one, key)
        b = getattr(other, key)
        assert (a is None) == (b is None) and (a is None or np.array_equal(a, b)), key
    assert (one.parents, one.joint_names) == (other.parents, other.joint_names)


def test_the_default_body_is_a_template_with_both_mirrors():
    template = load_template("default")
    body = load_body("default")
    strongest = body.skinning_weights[np.arange(body.num_vertices), template.part]
    assert np.array_equal(strongest, body.skinning_weights.max(1))
    assert np.array_equal(template.mirror, body.mirror) and np.array_equal(
        template.vertices, body.v_template
    )
    assert (
        template.joint_names[template.joint_mirror[template.joint_names.index("left_knee")]]
        == "right_knee"
    )
    assert template.empty_joints == ()


def test_a_body_model_file_gives_each_vertex_its_strongest_joint(tmp_path):
    arrays = official_arrays("smpl", 300, seed=3)
    template = load_template(write_official(tmp_path / "SMPL_MALE.pkl", arrays))
    assert np.array_equal(template.part, np.asarray(arrays["weights"]).argmax(1))
    assert np.array_equal(template.faces, arrays["f"]) and template.mirror is None


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_saved_template_comes_back(tmp_path, mirrored):
    template = ball()
    if mirrored:
        template = replace(
            template,
            mirror=find_mirror(template.vertices, template.faces),
            joint_mirror=np.arange(2),
        )
    save_template(template, tmp_path / "deep" / "template.npz")
    same(load_template(tmp_path / "deep" / "template.npz"), template)
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["template.npz"]


@pytest.mark.parametrize("name", ["ball.toml", "ball.ply"])
def test_a_mesh_and_a_list_of_parts_make_a_template_in_metres(tmp_path, name):
    write_toml(tmp_path, ball())
    same(load_template(tmp_path / name), ball())
    write_toml(tmp_path, ball(), text=TOML.replace('mesh = "ball.ply"', ""))
    same(load_template(tmp_path / name), ball())


@pytest.mark.parametrize(
    ("text", "changed", "message"),
    [
        (TOML, {"high": []}, r"vertices \(first \d+\) belong to no joint"),
        (TOML, {"high": list(range(42))}, "vertex 0 belongs to 'root' and 'top'|belongs to 'root' "
                                          "and 'top'"),
        (TOML, {"high": [42]}, "joint 'top' are no list of numbers from 0 to 41"),
        (TOML, {"high": "[true]"}, "no list of numbers"),
        (TOML.replace('parent = "root"', 'parent = "hip"'), {}, "parent of joint 'top' is 'hip'"),
        (TOML.replace('parent = "root"', ""), {}, "parent of joint 'top' is ''"),
        (TOML.replace('name = "root"', 'name = "root"\nparent = "top"'), {}, "expected the root "
                                                                             "first"),
        (TOML.replace("mm", "ells"), {}, "unit is 'ells'"),
        (TOML.replace("ball.ply", "none.ply"), {}, "none.ply: No such file"),
        (TOML.replace("ball.ply", "ball.stl"), {}, "expected a mesh"),
        ("mesh = 3 =", {}, "no TOML"),
        ("unit = 'm'", {}, "no joints in it"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_list_of_parts_is_said_in_one_line(tmp_path, text, changed, message):
    path = write_toml(tmp_path, ball(), text, **changed)
    with pytest.raises(HabitusError, match=message) as refused:
        load_template(path)
    assert "\n" not in str(refused.value) and str(tmp_path) in str(refused.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"part": np.zeros(41, np.int64)}, "part"),
        ({"part": np.full(42, 2)}, "part"),
        ({"faces": np.full((4, 3), 42)}, "faces"),
        ({"parents": np.array([-1, 1])}, "parent of joint 1 is 1"),
        ({"parents": np.array([0, 0])}, "joint 0 is the root"),
        ({"joint_names": np.array(["a", "a"])}, "2 distinct ones"),
        ({"mirror": np.roll(np.arange(42), 1)}, "expected partners of each other"),
        ({"vertices": np.full((42, 3), np.nan)}, "vertices"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_an_archive_is_said_in_one_line(tmp_path, changed, message):
    template = ball()
    path = tmp_path / "template.npz"
    arrays = {
        key: getattr(template, key)
        for key in ("vertices", "faces", "part", "parents", "joint_names")
    }
    np.savez(path, **(arrays | changed))
    with pytest.raises(HabitusError, match=message) as refused:
        load_template(path)
    assert "template.npz" in str(refused.value) and "\n" not in str(refused.value)


@settings(max_examples=25, deadline=None)
@given(st.binary(max_size=200))
def test_bytes_that_are_no_template_are_refused(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("bytes")
    for name in ("body.npz", "body.pkl", "mesh.toml", "mesh.ply"):
        (folder / name).write_bytes(content)
        with pytest.raises(HabitusError):
            load_template(folder / name)


def test_a_file_that_is_not_there_is_named(tmp_path):
    for name in ("none.npz", "none.toml", "none.obj"):
        with pytest.raises(HabitusError, match=r"none\..*No such file"):
            load_template(tmp_path / name)


def test_a_template_is_saved_as_npz_only(tmp_path):
    with pytest.raises(HabitusError, match=r"expected \.npz"):
        save_template(ball(), tmp_path / "template.ply")


def test_a_mesh_without_its_table_of_parts_says_what_is_missing(tmp_path):
    write_toml(tmp_path, ball()).unlink()
    with pytest.raises(HabitusError, match=r"ball\.ply: no ball\.toml beside it"):
        load_template(tmp_path / "ball.ply")
