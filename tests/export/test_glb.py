import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from read_glb import Glb
from soft_tubes import planted_regressor, swaying
from synthetic import with_features
from synthetic_fit import synthetic_fit, tube_body

from habitus.body.dynamics import Dynamics
from habitus.errors import HabitusError
from habitus.export import glb as writer
from habitus.export import write_glb
from habitus.export.correctives import WORST
from habitus.export.obj import fitted_vertices
from habitus.io.people import read_fit
from habitus.rotations import UP_AXES, up_rotation

FRAMES = (0, 17, 44, 89)


@pytest.mark.parametrize("posedirs", [False, True])
@pytest.mark.parametrize("soft", [False, True])
def test_glb_equals_the_body(tmp_path, soft, posedirs):
    fit = synthetic_fit(soft=soft, body=tube_body(posedirs=posedirs))
    write_glb(fit, tmp_path / "a.glb", correctives="all")
    glb = Glb(tmp_path / "a.glb")
    turn = up_rotation(fit.up_axis)
    for frame, expected in zip(FRAMES, fitted_vertices(fit, FRAMES), strict=True):
        found = glb.vertices(frame / fit.rate_hz)
        assert np.abs(found - expected @ turn.T).max() < 1e-4


@pytest.mark.parametrize("posedirs", [False, True])
def test_glb_holds_soft_tissue_that_the_body_predicts(tmp_path, posedirs):
    body = tube_body(posedirs=posedirs)
    joints = ("pelvis", "spine2", "left_knee")
    known = replace(planted_regressor(), joints=joints, limits=np.full(27, 100.0))
    body = replace(body, dynamics=Dynamics(swaying(body, 2), known))
    fit = synthetic_fit(soft=False, body=body)
    moving = fit.with_dynamics(2.0)
    away = np.linalg.norm(moving.vertices(FRAMES) - fit.vertices(FRAMES), axis=-1)
    assert away.max() > 1e-3 and np.abs(moving.joints() - fit.joints()).max() < 1e-12
    write_glb(moving, tmp_path / "a.glb", correctives="all")
    glb = Glb(tmp_path / "a.glb")
    turn = up_rotation(fit.up_axis)
    for frame, expected in zip(FRAMES, fitted_vertices(moving, FRAMES), strict=True):
        assert np.abs(glb.vertices(frame / fit.rate_hz) - expected @ turn.T).max() < 1e-4
    still = moving.with_dynamics(0.0)
    np.testing.assert_allclose(still.vertices(FRAMES), fit.vertices(FRAMES), atol=1e-12)
    np.testing.assert_allclose(still.predicted_soft_tissue, fit.predicted_pose_stage, atol=1e-9)
    moving.export(tmp_path / "body.npz")
    again = read_fit(tmp_path / "body.npz", body)
    np.testing.assert_allclose(again.vertices(FRAMES), moving.vertices(FRAMES), atol=1e-9)


def test_by_itself_no_vertex_is_further_away_than_said(tmp_path):
    fit = synthetic_fit(body=tube_body(posedirs=True))
    written = write_glb(fit, tmp_path / "a.glb")
    glb = Glb(tmp_path / "a.glb")
    turn = up_rotation(fit.up_axis)
    assert 0 < written.morph_worst <= WORST
    for frame, expected in zip(FRAMES, fitted_vertices(fit, FRAMES), strict=True):
        assert np.abs(glb.vertices(frame / fit.rate_hz) - expected @ turn.T).max() < 1.1 * WORST


def with_local_shapes(body):
    """Each joint's pose blend shapes move the vertices that it carries, and no others."""
    shapes = (
        body.posedirs.reshape(body.num_vertices, 3, -1, 9)
        * (body.skinning_weights[:, 1:] > 0)[:, None, :, None]
    )
    return replace(body, posedirs=shapes.reshape(body.posedirs.shape))


def test_shapes_of_few_vertices_are_stored_as_such(tmp_path):
    fit = synthetic_fit(20, body=with_local_shapes(tube_body(posedirs=True)), soft=False)
    write_glb(fit, tmp_path / "a.glb", correctives="all")
    glb = Glb(tmp_path / "a.glb")
    turn = up_rotation(fit.up_axis)
    accessors = [
        glb.json["accessors"][t["POSITION"]]
        for t in glb.json["meshes"][0]["primitives"][0]["targets"]
    ]
    assert len(accessors) == 15 * 23 and all("sparse" in each for each in accessors)
    for frame, expected in zip((0, 19), fitted_vertices(fit, (0, 19)), strict=True):
        assert np.abs(glb.vertices(frame / fit.rate_hz) - expected @ turn.T).max() < 2e-5


VALIDATE = """
const validator = require("gltf-validator"), data = require("fs").readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(data)).then((report) => console.log(JSON.stringify(report.issues)));
"""


def test_khronos_validator_finds_nothing(tmp_path):
    node = shutil.which("node")
    if (
        not node
        or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode
    ):
        pytest.skip("no validator here: npm install gltf-validator, NODE_PATH")
    for name, body in (
        ("a", tube_body(posedirs=True)),
        ("b", with_local_shapes(tube_body(posedirs=True))),
    ):
        write_glb(synthetic_fit(5, body=body), tmp_path / f"{name}.glb")
        run = subprocess.run(
            [node, "-e", VALIDATE, tmp_path / f"{name}.glb"], capture_output=True, text=True
        )
        assert json.loads(run.stdout)["messages"] == []


@pytest.mark.parametrize("up", UP_AXES)
def test_up_becomes_plus_y(tmp_path, up):
    fit = synthetic_fit(frames=3, up_axis=up, soft=False)
    turn = up_rotation(up)
    assert np.allclose(turn @ turn.T, np.eye(3)) and np.isclose(np.linalg.det(turn), 1)
    axis = (1 if up[0] == "+" else -1) * np.eye(3)["xyz".index(up[1])]
    assert np.allclose(turn @ axis, [0, 1, 0])
    write_glb(fit, tmp_path / "a.glb")
    expected = next(fitted_vertices(fit, [1])) @ turn.T
    assert np.abs(Glb(tmp_path / "a.glb").vertices(1 / fit.rate_hz) - expected).max() < 1e-4


def test_structure(tmp_path):
    fit = synthetic_fit()
    write_glb(fit, tmp_path / "a.glb")
    glb = Glb(tmp_path / "a.glb")
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    assert np.allclose(np.linalg.norm(glb.array(attributes["NORMAL"]), axis=1), 1, atol=1e-5)
    weights = glb.array(attributes["WEIGHTS_0"])
    assert (
        np.allclose(weights.sum(1), 1, atol=1e-6)
        and glb.array(attributes["JOINTS_0"]).dtype == np.uint8
    )
    assert [node["name"] for node in glb.json["nodes"][:24]] == list(fit.body.joint_names)
    times = glb.array(glb.json["animations"][0]["samplers"][0]["input"])
    assert len(times) == len(fit.pose) and np.isclose(times[-1], (len(fit.pose) - 1) / fit.rate_hz)
    for channel in glb.json["animations"][0]["channels"]:
        if channel["target"]["path"] == "rotation":
            q = glb.array(glb.json["animations"][0]["samplers"][channel["sampler"]]["output"])
            assert np.all((q[1:] * q[:-1]).sum(1) > 0)


def test_more_than_four_influences(tmp_path):
    body = tube_body()
    index = np.concatenate([body.skinning_index, body.skinning_index[:, :1:-1]], 1)
    value = np.concatenate([body.skinning_value, 0.1 * np.ones((body.num_vertices, 2))], 1)
    value = value / value.sum(1, keepdims=True)
    from dataclasses import replace

    fit = synthetic_fit(body=replace(body, skinning_index=index, skinning_value=value))
    write_glb(fit, tmp_path / "a.glb")
    expected = next(fitted_vertices(fit, [30])) @ up_rotation("+z").T
    glb = Glb(tmp_path / "a.glb")
    assert "JOINTS_1" in glb.json["meshes"][0]["primitives"][0]["attributes"]
    assert np.abs(glb.vertices(30 / fit.rate_hz) - expected).max() < 1e-4


def test_morph_weights_lie_between_zero_and_one(tmp_path):
    write_glb(synthetic_fit(body=tube_body(posedirs=True)), tmp_path / "a.glb")
    glb = Glb(tmp_path / "a.glb")
    weights = next(
        c for c in glb.json["animations"][0]["channels"] if c["target"]["path"] == "weights"
    )
    values = glb.array(glb.json["animations"][0]["samplers"][weights["sampler"]]["output"])
    assert values.min() == 0 and values.max() == 1


@pytest.mark.parametrize(
    ("soft", "posedirs", "correctives", "kind"),
    [
        (True, False, "auto", "soft_tissue"),
        (False, True, "pca:3", "pose_correction"),
        (True, True, "pca:3", "soft_tissue_and_pose"),
        (False, True, "auto", "(left|right|spine|neck|head)\\w*"),
    ],
)
def test_shape_keys_say_what_they_are(tmp_path, soft, posedirs, correctives, kind):
    fit = synthetic_fit(soft=soft, body=tube_body(posedirs=posedirs))
    write_glb(fit, tmp_path / "a.glb", correctives=correctives)
    mesh = Glb(tmp_path / "a.glb").json["meshes"][0]
    names = mesh["extras"]["targetNames"]
    assert len(names) == len(mesh["primitives"][0]["targets"]) == len(set(names))
    assert all(re.fullmatch(kind + r"_\d\d(_back)?", name) for name in names)


def test_texture_coordinates_double_the_vertices_along_seams(tmp_path):
    fit = synthetic_fit()
    rng = np.random.default_rng(0)
    faces = fit.body.faces
    uv_faces = faces.copy()
    uv_faces[: len(faces) // 2] += fit.body.num_vertices  # two pieces, with a seam between them
    uv = rng.uniform(size=(2 * fit.body.num_vertices, 2))
    body = replace(fit.body, extras={"vt": uv, "ft": uv_faces.astype(np.uint32)})
    write_glb(replace(fit, body=body), tmp_path / "a.glb", correctives="all")
    glb = Glb(tmp_path / "a.glb")
    primitive = glb.json["meshes"][0]["primitives"][0]
    corners = glb.array(primitive["indices"]).reshape(-1, 3)
    assert np.allclose(
        glb.array(primitive["attributes"]["TEXCOORD_0"])[corners], uv[uv_faces] * [1, -1] + [0, 1]
    )
    expected = next(fitted_vertices(fit, [17])) @ up_rotation(fit.up_axis).T
    found = glb.vertices(17 / fit.rate_hz)
    assert len(found) > len(expected) and np.abs(found[corners] - expected[faces]).max() < 1e-4
    write_glb(
        replace(fit, body=replace(body, extras={"vt": uv[:5], "ft": uv_faces})), tmp_path / "b.glb"
    )
    assert (
        "TEXCOORD_0" not in Glb(tmp_path / "b.glb").json["meshes"][0]["primitives"][0]["attributes"]
    )


def test_trimesh_reads_it(tmp_path):
    fit = synthetic_fit(frames=5)
    write_glb(fit, tmp_path / "a.glb")
    mesh = next(iter(trimesh.load(tmp_path / "a.glb", process=False).geometry.values()))
    rest = fit.body.rest_vertices(torch.as_tensor(fit.betas))
    assert mesh.faces.shape == tuple(fit.body.faces.shape)
    assert np.allclose(mesh.vertices, rest, atol=1e-5)


def test_stride_keeps_time(tmp_path):
    fit = synthetic_fit(frames=60, soft=False)
    write_glb(fit, tmp_path / "a.glb", stride=4)
    expected = next(fitted_vertices(fit, [20])) @ up_rotation("+z").T
    assert np.abs(Glb(tmp_path / "a.glb").vertices(20 / fit.rate_hz) - expected).max() < 1e-4


def test_unwritable_place_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(HabitusError, match="cannot write"):
        write_glb(synthetic_fit(frames=2), tmp_path / "file" / "a.glb")


@pytest.mark.parametrize(
    ("features", "shapes"), [("angles", 0), ("quaternions", 0), ("rotations", 2)]
)
def test_pose_blend_shapes_of_other_features_are_refused(tmp_path, features, shapes):
    fit = synthetic_fit(frames=2, body=tube_body(posedirs=True))
    with pytest.raises(
        HabitusError, match=f"driven by '{features}'.*; animations need 'rotations' alone"
    ):
        write_glb(replace(fit, body=with_features(fit.body, features, shapes)), tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())


def test_an_animation_of_too_many_frames_is_thinned_and_says_so(tmp_path, monkeypatch):
    fit = synthetic_fit(frames=90)
    assert writer.thinning_note(fit) == ()
    monkeypatch.setattr(writer, "GLB_FRAMES", 40)
    write_glb(fit, tmp_path / "a.glb")
    glb = Glb(tmp_path / "a.glb")
    turn = up_rotation(fit.up_axis)
    times = glb.array(glb.json["animations"][0]["samplers"][0]["input"])
    np.testing.assert_allclose(times, np.arange(0, 90, 3) / fit.rate_hz, rtol=1e-6)
    expected = next(fitted_vertices(fit, [27])) @ turn.T
    assert np.abs(glb.vertices(27 / fit.rate_hz) - expected).max() < 1e-3
    (note,) = writer.thinning_note(fit)
    assert "one in 3" in note and f"{fit.rate_hz / 3:.3g} Hz" in note
    write_glb(fit, tmp_path / "all.glb", stride=1)
    glb = Glb(tmp_path / "all.glb")
    assert len(glb.array(glb.json["animations"][0]["samplers"][0]["input"])) == 90
