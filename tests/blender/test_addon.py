"""The add-on in real Blenders: the body that its sliders and bones make is habitus' own, vertex by vertex."""

import importlib.util
import os
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from read_blender import PROGRAMS

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.body.up import up_rotation

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import bpy, sys, numpy as np
folder = sys.argv[-1]
bpy.ops.preferences.addon_enable(module="habitus_body")
context, scene = bpy.context, bpy.context.scene

def seen(person):
    posed = person.evaluated_get(context.evaluated_depsgraph_get())
    mesh = posed.to_mesh()
    points = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", points)
    whole = np.array(posed.matrix_world)
    return points.reshape(-1, 3) @ whole[:3, :3].T + whole[:3, 3]

found = {}
given = np.load(f"{folder}/given.npz")
bpy.ops.habitus.add()
person = context.object
for k in range(len(given["betas"])):
    person.habitus_betas = given["betas"][k].tolist()
    for bone, turn in zip(given["names"], given["quaternions"][k]):
        person.parent.pose.bones[str(bone)].rotation_quaternion = turn.tolist()  # as an animator turns it
    context.view_layer.update()
    found[f"posed{k}"] = seen(person)
person.parent.location.z += 0.7
bpy.ops.habitus.ground()
context.view_layer.update()
found["lowest"] = seen(person)[:, 2].min()
assert bpy.ops.habitus.import_npz(filepath=f"{folder}/motion.npz") == {"FINISHED"}
person = context.object
found["rate"] = scene.render.fps / scene.render.fps_base
for frame in (0, 3, 7):
    scene.frame_set(frame + 1)
    found[f"frame{frame}"] = seen(person)
try:
    bpy.ops.habitus.import_npz(filepath=f"{folder}/given.npz")
    found["refused"] = ""
except RuntimeError as error:
    found["refused"] = str(error)
np.savez(f"{folder}/found.npz", **found)
"""


@pytest.fixture(scope="module")
def addon(tmp_path_factory):
    spec = importlib.util.spec_from_file_location("build_addon", ROOT / "blender" / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    folder = tmp_path_factory.mktemp("scripts")
    path = module.build(folder / "habitus_body.zip")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder / "addons")
    return folder


HERE = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(command is None, reason=f"no {name} here: apt-get install blender, pip install bpy"),
    )
    for name, command in PROGRAMS.items()
]


@pytest.mark.parametrize("program", HERE)
def test_the_body_in_blender_is_the_body(tmp_path, addon, program):
    body, rng = hb.load_body("default"), np.random.default_rng(3)
    betas, pose = rng.normal(size=(2, body.num_betas)), rng.normal(0, 0.4, (2, body.num_joints, 3))
    pose[:, 0] = 0
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    turns = np.concatenate([np.cos(angle / 2), pose * 0.5 * np.sinc(angle / (2 * np.pi))], -1)
    np.savez(tmp_path / "given.npz", betas=betas, quaternions=turns, names=np.array(body.joint_names))
    moving = BodyMotion(
        body,
        betas[0],
        rng.normal(0, 0.3, (8, body.num_joints, 3)),
        rng.normal(size=(8, 3)),
        119.88,
        body_name="default",
    )
    moving.export(tmp_path / "motion.npz")
    (tmp_path / "drive.py").write_text(SCRIPT)
    run = subprocess.run(
        [*PROGRAMS[program], str(tmp_path / "drive.py"), "--", str(tmp_path)],
        env=os.environ | {"BLENDER_USER_SCRIPTS": str(addon)},
        capture_output=True,
        timeout=180,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    with np.load(tmp_path / "found.npz") as found:
        turn = up_rotation("+z").T  # from +y up to +z up
        for k in range(2):
            known = body.full(betas[k], pose[k]).vertices @ turn.T
            assert np.linalg.norm(found[f"posed{k}"] - known, axis=1).max() < 1e-4
        assert abs(found["lowest"]) < 1e-5 and found["rate"] == pytest.approx(119.88, rel=1e-5)
        for frame in (0, 3, 7):
            known = next(moving.surfaces([frame], body=body.full)).vertices[0]
            assert np.linalg.norm(found[f"frame{frame}"] - known, axis=1).max() < 1e-4
        assert "holds no poses" in str(found["refused"])
