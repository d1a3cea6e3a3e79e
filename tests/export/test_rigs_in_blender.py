"""Rigs in Blender: bones lie along limbs, and IK on a knee reaches, without any option.

Skips where Blender is missing, as `test_blender` does.
"""

import json

import pytest
from read_blender import PROGRAMS, READERS, run

from habitus.jobs.exporting import export_file

SCRIPT = """
import bpy, json, sys
from mathutils import Vector
out, *files = sys.argv[sys.argv.index("--") + 1 :]
found = []
for path, operator, thigh, shin, foot in zip(*[iter(files)] * 5):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if operator == "import_scene.fbx":
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
    group, call = operator.split(".")
    getattr(getattr(bpy.ops, group), call)(filepath=path)
    rig = next(o for o in bpy.data.objects if o.type == "ARMATURE")
    angles = {}
    for bone in rig.data.bones:
        if len(bone.children) == 1:
            way = bone.children[0].head_local - bone.head_local
            angles[bone.name] = way.angle(bone.tail_local - bone.head_local)
    rig.animation_data_clear()
    for bone in rig.pose.bones:
        bone.matrix_basis.identity()
    bpy.context.view_layer.update()
    hip, ankle = (rig.matrix_world @ rig.pose.bones[name].head for name in (thigh, foot))
    goal = bpy.data.objects.new("goal", None)
    bpy.context.scene.collection.objects.link(goal)
    goal.location = ankle + 0.3 * (hip - ankle)
    solver = rig.pose.bones[shin].constraints.new("IK")
    solver.target, solver.chain_count = goal, 2
    bpy.context.view_layer.update()
    posed = rig.evaluated_get(bpy.context.evaluated_depsgraph_get())
    foot, knee = (posed.matrix_world @ posed.pose.bones[name].head for name in (foot, shin))
    found.append(
        {
            "angles": angles,
            "miss": (foot - goal.location).length,
            "forward": (hip.y + goal.location.y) / 2 - knee.y,
        }
    )
with open(out, "w") as file:
    json.dump(found, file)
"""
LEGS = {
    None: ("left_hip", "left_knee", "left_ankle"),
    "mixamo": ("mixamorig:LeftUpLeg", "mixamorig:LeftLeg", "mixamorig:LeftFoot"),
    "manny": ("thigh_l", "calf_l", "foot_l"),
}


@pytest.mark.parametrize("program", READERS)
def test_ik_reaches_and_knees_bend_forward(tmp_path, program):
    if PROGRAMS[program] is None:
        pytest.skip(f"no {program} here: apt-get install blender python3-numpy, or pip install bpy")
    words = []
    for rig, leg in LEGS.items():
        for name, (ending, operator) in READERS[program].items():
            if ":" in leg[0] and ending == "usdc":
                continue  # USD allows no colon
            path = tmp_path / f"{rig}-{name}.{ending}"
            export_file("neutral", path, rig=rig, root_bone=rig == "manny")
            words += [path, operator, *leg]
    (tmp_path / "script.py").write_text(SCRIPT)
    run([*(PROGRAMS[program] or []), tmp_path / "script.py", "--", tmp_path / "out.json", *words])
    found = json.loads((tmp_path / "out.json").read_text())
    assert len(found) == len(words) // 5
    for row, path in zip(found, words[::5], strict=True):
        angles = {bone: angle for bone, angle in row["angles"].items() if bone != "root"}
        assert len(angles) > 10 and max(angles.values()) < 2e-3, path
        assert row["miss"] < 1e-3 and row["forward"] > 0.1, (path, row["miss"], row["forward"])
