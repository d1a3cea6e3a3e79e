"""A real importer's bones, driven by the JSON beside the file: an FBX in Blender takes any pose as
the body does.
"""

from pathlib import Path

import numpy as np
import pytest
from hinged_body import KNEE, with_hinges
from read_blender import PROGRAMS, run
from scipy.spatial.transform import Rotation
from synthetic_fit import synthetic_fit, tube_body

FOLDER = Path(__file__).resolve().parents[2] / "programs"
SCRIPT = """
import bpy, sys, numpy as np
programs, folder, operator = sys.argv[sys.argv.index("--") + 1 :]
sys.path.insert(0, programs)
from habitus_correctives import Correctives, from_matrices
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="io_scene_fbx")
group, call = operator.split(".")
options = {"automatic_bone_orientation": True} if group == "import_scene" else {}  # bones along their children
getattr(getattr(bpy.ops, group), call)(filepath=f"{folder}/a.fbx", **options)
mesh = next(o for o in bpy.data.objects if o.type == "MESH")
bones = next(o for o in bpy.data.objects if o.type == "ARMATURE")
for thing in (bones, mesh.data.shape_keys):
    thing.animation_data_clear()
with open(f"{folder}/a.correctives.json") as file:
    told = Correctives(file.read())
rest = {bone.name: np.array(bone.matrix_local) for bone in bones.data.bones}
axes = told.axes({name: rest[name][:3, 3].tolist() for name in told.joints})
given = np.load(f"{folder}/given.npz")
base = np.zeros((3, 3))
for body, (of_mesh, sign) in enumerate(axes):
    base[of_mesh, body] = sign
found = {"turned": np.abs(rest["left_knee"][:3, :3] - np.eye(3)).max()}
from mathutils import Matrix
for name, turn in zip(map(str, given["names"]), given["turns"]):
    own, bone = rest[name][:3, :3], bones.pose.bones[name]
    bone.rotation_mode, bone.location = "QUATERNION", (0, 0, 0)
    bone.rotation_quaternion = Matrix((own.T @ base @ turn @ base.T @ own).tolist()).to_quaternion()
bpy.context.view_layer.update()
def flat(matrix):
    return np.array(matrix).T.ravel().tolist()
posed = bones.pose.bones
turns = {name: from_matrices(flat(np.linalg.inv(rest[name])), flat(posed[name].matrix)) for name in told.joints}
for channel, weight in zip(told.channels, told.weights(turns, axes)):
    mesh.data.shape_keys.key_blocks[channel].value = weight
posed = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
points = np.empty(3 * len(posed.data.vertices))
posed.to_mesh().vertices.foreach_get("co", points)
whole = np.array(posed.matrix_world)
np.savez(f"{folder}/found.npz", vertices=points.reshape(-1, 3) @ whole[:3, :3].T + whole[:3, 3], **found)
"""


@pytest.mark.parametrize(
    ("program", "operator"),
    [("blender", "import_scene.fbx"), ("bpy", "import_scene.fbx"), ("bpy", "wm.fbx_import")],
)
def test_any_pose_of_an_imported_person_is_the_bodys(tmp_path, program, operator):
    if PROGRAMS[program] is None:
        pytest.skip(f"no {program} here: apt-get install blender python3-numpy, or pip install bpy")
    fit = synthetic_fit(3, soft=False, body=with_hinges(tube_body(posedirs=True)))
    rng = np.random.default_rng(6)
    fit.export(tmp_path / "a.fbx", correctives="all")
    pose = rng.normal(0, 0.5, (fit.body.num_joints, 3))
    pose[0] = 0
    pose[fit.body.joint_names.index(KNEE), 0] = 2.2  # into a fold
    names = np.array(fit.body.joint_names)
    np.savez(tmp_path / "given.npz", turns=Rotation.from_rotvec(pose).as_matrix(), names=names)
    (tmp_path / "drive.py").write_text(SCRIPT)
    run([*PROGRAMS[program], tmp_path / "drive.py", "--", FOLDER, tmp_path, operator])
    with np.load(tmp_path / "found.npz") as found:
        known = fit.body(fit.betas, pose).vertices[:, [0, 2, 1]] * [1, -1, 1]  # +y up to +z up
        assert np.linalg.norm(found["vertices"] - known, axis=1).max() < 1e-4
        assert found["turned"] > 0.1  # bones with axes of their own
