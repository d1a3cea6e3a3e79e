"""What is written, in Blender: its importers and its armature give the body's surface back.

Skips where Blender is missing: the program itself (``apt-get install blender python3-numpy``), or
its Python module.
"""

import numpy as np
import pytest
from read_blender import PROGRAMS, READERS, in_blender, run
from synthetic_fit import synthetic_fit, tube_body

from habitus.export.motion import export_motion
from habitus.export.obj import fitted_vertices

FRAMES = (0, 25, 59)


@pytest.mark.parametrize("program", READERS)
def test_blender_shows_the_body(tmp_path, program):
    if PROGRAMS[program] is None:
        pytest.skip(f"no {program} here: apt-get install blender python3-numpy, or pip install bpy")
    fit = synthetic_fit(60, body=tube_body(posedirs=True), rate_hz=60.0)
    endings = {ending for ending, _ in READERS[program].values()}
    told = {
        ending: export_motion(fit, tmp_path / f"a.{ending}", correctives="pca:40")
        for ending in endings
    }
    files = [(told[ending].path, operator) for ending, operator in READERS[program].values()]
    for found, (path, operator) in zip(in_blender(program, files, 60, FRAMES), files, strict=True):
        written = told[path.suffix[1:]]
        assert (found["fps"], found["keys"]) == (60, written.morphs), operator
        for frame, expected in zip(FRAMES, fitted_vertices(fit, FRAMES), strict=True):
            away = np.linalg.norm(found[frame] - expected, axis=1)  # z is up in both
            assert away.max() < 1e-4 + written.worst, operator


AGAIN = """
import bpy, sys
out, path = sys.argv[sys.argv.index("--") + 1 :][:2]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="io_scene_fbx")
bpy.ops.import_scene.fbx(filepath=path)
bpy.ops.export_scene.fbx(filepath=out, add_leaf_bones=False)
"""


def test_skin_and_channels_survive_a_round_trip(tmp_path):
    ufbx = pytest.importorskip("ufbx", reason="no pyufbx here: pip install pyufbx")
    program = PROGRAMS["bpy"] or PROGRAMS["blender"]
    if program is None:
        pytest.skip("no Blender here: apt-get install blender python3-numpy, or pip install bpy")
    synthetic_fit(10, body=tube_body(posedirs=True), rate_hz=60.0).export(
        tmp_path / "a.fbx", correctives="pca:5"
    )
    (tmp_path / "again.py").write_text(AGAIN)
    run([*program, tmp_path / "again.py", "--", tmp_path / "b.fbx", tmp_path / "a.fbx"])
    kept = []
    for name in ("a.fbx", "b.fbx"):
        with ufbx.load_file(str(tmp_path / name)) as scene:
            (mesh,), skin = scene.meshes, scene.meshes[0].skin_deformers[0]
            weights = {cluster.name: cluster.num_weights for cluster in skin.clusters}
            channels = {channel.name for channel in mesh.blend_deformers[0].channels}
            kept.append((weights, channels, mesh.num_vertices, mesh.num_faces, len(scene.bones)))
    assert kept[0] == kept[1]


BVH = """
import bpy, sys, numpy as np
out, path, *frames = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_anim.bvh(filepath=path, global_scale=0.01, update_scene_fps=True)
(bones,) = bpy.data.objects
found = {"fps": bpy.context.scene.render.fps}
for frame in map(int, frames):
    bpy.context.scene.frame_set(frame + 1)
    for bone in bones.pose.bones:
        found[f"{frame} {bone.name}"] = np.array(bones.matrix_world @ bone.head)
np.savez(out, **found)
"""


def test_joints_of_a_bvh(tmp_path):
    """With the options that the documentation names."""
    if PROGRAMS["bpy"] is None:
        pytest.skip("no bpy here: pip install bpy")
    fit = synthetic_fit(60, rate_hz=60.0)
    fit.export(tmp_path / "a.bvh")
    (tmp_path / "read.py").write_text(BVH)
    words = [tmp_path / "found.npz", tmp_path / "a.bvh", *map(str, FRAMES)]
    run([*PROGRAMS["bpy"], tmp_path / "read.py", "--", *words])
    with np.load(tmp_path / "found.npz") as found:
        assert found["fps"] == 60
        for frame in FRAMES:
            for name, joint in zip(fit.body.joint_names, fit.joints(frame), strict=True):
                assert np.linalg.norm(found[f"{frame} {name}"] - joint) < 1e-4
