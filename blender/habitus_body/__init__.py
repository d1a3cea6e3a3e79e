# SPDX-License-Identifier: GPL-3.0-or-later
"""habitus in Blender: the default body with sliders, pose blend shapes that follow the bones, motions of fits."""

from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import FloatVectorProperty, StringProperty
from mathutils import Matrix

from .core import Body, Motion, quaternions

bl_info = {
    "name": "habitus body",
    "author": "habitus contributors",
    "version": (0, 1, 0),
    "blender": (3, 4, 0),
    "location": "3D View > Sidebar > habitus; File > Import",
    "description": "The habitus body: shape sliders, live pose blend shapes, motions of fits",
    "category": "Animation",
}
BETAS, KEY = 24, "correctives"
UPRIGHT = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
"""From the body's space (+y up) to Blender's (+z up)."""
_loaded: dict = {}


def body() -> Body:
    """The body that came with the add-on, read once."""
    if "body" not in _loaded:
        _loaded["body"] = Body(Path(__file__).parent / "body.npz")
    return _loaded["body"]


def add_body(context, betas=()):
    """A new person: an armature, and under it the mesh with its skin and its live blend shapes. The mesh comes back."""
    model = body()
    armature = bpy.data.objects.new("habitus", bpy.data.armatures.new("habitus"))
    mesh = bpy.data.meshes.new("habitus body")
    mesh.from_pydata(model.rest(betas).tolist(), [], model.arrays["quads"].tolist())
    person = bpy.data.objects.new("habitus body", mesh)
    for each in (armature, person):
        context.collection.objects.link(each)
    layer = mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", model.arrays["uv"][model.arrays["quad_uv"]].ravel().astype(np.float32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    _make_bones(context, armature)
    groups = [person.vertex_groups.new(name=name) for name in model.joint_names]
    skin = model.arrays["skinning_index"], model.arrays["skinning_value"]
    for vertex, (index, value) in enumerate(zip(*skin, strict=True)):
        for joint, weight in zip(index.tolist(), value.tolist(), strict=True):
            if weight > 0:
                groups[joint].add([vertex], weight, "ADD")
    person.parent = armature
    person.modifiers.new("skin", "ARMATURE").object = armature
    person.shape_key_add(name="Basis")
    person.shape_key_add(name=KEY).value = 1.0
    armature.matrix_world = UPRIGHT
    person["habitus"] = 1
    padded = np.zeros(BETAS)
    padded[: len(betas)] = np.asarray(betas)[:BETAS]
    person.habitus_betas = padded.tolist()  # shapes it
    return person


def _make_bones(context, armature):
    with _editing(context, armature):
        for name, parent in zip(body().joint_names, body().parents, strict=True):
            bone = armature.data.edit_bones.new(name)
            bone.head, bone.tail = (0, 0, 0), (0, 0.05, 0)
            if parent >= 0:
                bone.parent = armature.data.edit_bones[body().joint_names[parent]]
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"


class _editing:
    """The armature in edit mode, and everything as it was afterwards."""

    def __init__(self, context, armature):
        self.context, self.armature = context, armature

    def __enter__(self):
        layer = self.context.view_layer
        self.before = layer.objects.active
        if self.before is not None and self.before.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = self.armature
        bpy.ops.object.mode_set(mode="EDIT")

    def __exit__(self, *_):
        bpy.ops.object.mode_set(mode="OBJECT")
        self.context.view_layer.objects.active = self.before or self.armature


def reshape(person, context):
    """Bring vertices and bones to the person's betas."""
    betas, armature = np.array(person.habitus_betas), person.parent
    points = body().rest(betas).astype(np.float32).ravel()
    person.data.vertices.foreach_set("co", points)
    person.data.shape_keys.key_blocks["Basis"].data.foreach_set("co", points)
    with _editing(context, armature):
        for name, place in zip(body().joint_names, body().joints(betas), strict=True):
            bone = armature.data.edit_bones[name]  # turned like the body: along y, no roll
            bone.head, bone.tail, bone.roll = place, place + np.array([0, 0.05, 0]), 0.0
    correct(person)


def correct(person):
    """Bring the live blend shape to how the bones are turned."""
    rotations = np.stack([_local(person.parent.pose.bones[name]) for name in body().joint_names])
    keys = person.data.shape_keys.key_blocks
    rest = np.empty(3 * len(person.data.vertices), np.float32)
    keys["Basis"].data.foreach_get("co", rest)
    moved = rest + body().correctives(rotations).astype(np.float32).ravel()
    before = np.empty_like(rest)
    keys[KEY].data.foreach_get("co", before)
    if np.abs(moved - before).max() > 1e-7:
        keys[KEY].data.foreach_set("co", moved)
        person.data.update_tag()
        person.data.shape_keys.update_tag()


def _local(bone):
    """A bone's turn against its parent, in the body's axes (3, 3)."""
    rest = np.array(bone.bone.matrix_local.to_3x3())
    return rest @ np.array(bone.matrix_basis.to_quaternion().to_matrix()) @ rest.T


@persistent
def _follow(scene, *_):
    for person in scene.objects:
        if person.get("habitus") and person.parent is not None and person.data.shape_keys is not None:
            correct(person)


def animate(context, person, motion):
    """Key a motion on the person's bones, a key a frame from frame 1 on, at the scene's new rate."""
    armature, frames = person.parent, len(motion.pose)
    context.scene.render.fps = max(1, round(motion.rate))
    context.scene.render.fps_base = context.scene.render.fps / motion.rate
    context.scene.frame_start, context.scene.frame_end = 1, frames
    armature.matrix_world = Matrix((np.array(UPRIGHT.to_3x3()) @ motion.upright).tolist()).to_4x4()
    curves = _curves(armature, person.habitus_take or "habitus")
    times = np.arange(1, frames + 1, dtype=np.float32)
    for joint, name in enumerate(body().joint_names):
        values = quaternions(motion.pose[:, joint])
        flips = np.cumsum((values[1:] * values[:-1]).sum(-1) < 0) % 2
        values[1:][flips == 1] *= -1
        for part in range(4):
            _key(curves, f'pose.bones["{name}"].rotation_quaternion', part, times, values[:, part])
    for part in range(3):
        _key(curves, f'pose.bones["{body().joint_names[0]}"].location', part, times, motion.trans[:, part])
    context.scene.frame_set(1)


def _curves(armature, name):
    """The curves of a new action, in old Blenders and in those whose actions have layers and slots."""
    action = bpy.data.actions.new(name)
    data = armature.animation_data_create()
    data.action = action
    if hasattr(action, "fcurves"):
        return action.fcurves
    slot = action.slots.new("OBJECT", armature.name)
    data.action_slot = slot
    return action.layers.new("motion").strips.new(type="KEYFRAME").channelbag(slot, ensure=True).fcurves


def _key(curves, path, part, times, values):
    curve = curves.new(path, index=part)
    curve.keyframe_points.add(len(times))
    curve.keyframe_points.foreach_set("co", np.stack([times, values], 1).astype(np.float32).ravel())
    curve.keyframe_points.foreach_set("interpolation", np.ones(len(times), np.int32))  # straight lines
    curve.update()


class HABITUS_OT_add(bpy.types.Operator):
    """Add the habitus body."""

    bl_idname, bl_label, bl_options = "habitus.add", "habitus body", {"REGISTER", "UNDO"}

    def execute(self, context):
        """Add it."""
        context.view_layer.objects.active = add_body(context)
        return {"FINISHED"}


class HABITUS_OT_import(bpy.types.Operator):
    """Import a fit's body.npz, or another motion of the default body."""

    bl_idname, bl_label, bl_options = "habitus.import_npz", "habitus or AMASS motion (.npz)", {"REGISTER", "UNDO"}
    filepath: StringProperty(subtype="FILE_PATH")
    filter_glob: StringProperty(default="*.npz", options={"HIDDEN"})

    def invoke(self, context, _event):
        """Ask for the file."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        """Import it."""
        try:
            motion = Motion(self.filepath, body())
        except (OSError, ValueError, KeyError) as error:
            self.report({"ERROR"}, f"{Path(self.filepath).name}: {error}")
            return {"CANCELLED"}
        person = add_body(context, motion.betas)
        person.habitus_take = Path(self.filepath).parent.name or Path(self.filepath).stem
        animate(context, person, motion)
        context.view_layer.objects.active = person
        if motion.soft:
            self.report({"INFO"}, "soft tissue was left out; habitus export has it, in FBX, glTF and USD")
        return {"FINISHED"}


class HABITUS_OT_ground(bpy.types.Operator):
    """Move the person so that the lowest point of this frame is on the ground."""

    bl_idname, bl_label, bl_options = "habitus.ground", "Snap to ground", {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        """Only for a habitus body."""
        return context.object is not None and bool(context.object.get("habitus"))

    def execute(self, context):
        """Move it."""
        person = context.object
        correct(person)
        seen = person.evaluated_get(context.evaluated_depsgraph_get())
        mesh = seen.to_mesh()
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        world = np.array(seen.matrix_world)
        person.parent.location.z -= float((points.reshape(-1, 3) @ world[2, :3] + world[2, 3]).min())
        seen.to_mesh_clear()
        return {"FINISHED"}


class HABITUS_PT_panel(bpy.types.Panel):
    """The person's sliders."""

    bl_label, bl_space_type, bl_region_type, bl_category = "habitus", "VIEW_3D", "UI", "habitus"

    def draw(self, context):
        """Draw them."""
        self.layout.operator("habitus.add")
        self.layout.operator("habitus.import_npz")
        if context.object is not None and context.object.get("habitus"):
            self.layout.operator("habitus.ground")
            self.layout.prop(context.object, "habitus_betas", text="Shape")


_CLASSES = (HABITUS_OT_add, HABITUS_OT_import, HABITUS_OT_ground, HABITUS_PT_panel)
_HANDLERS = ("frame_change_post", "depsgraph_update_post")


def _import_menu(self, _context):
    self.layout.operator("habitus.import_npz")


def register():
    """Blender calls this when the add-on is switched on."""
    bpy.types.Object.habitus_betas = FloatVectorProperty(
        name="Shape", size=BETAS, soft_min=-3.0, soft_max=3.0, update=reshape
    )
    bpy.types.Object.habitus_take = StringProperty(name="Take")
    for each in _CLASSES:
        bpy.utils.register_class(each)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).append(_follow)


def unregister():
    """Blender calls this when it is switched off."""
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(_follow)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)
    del bpy.types.Object.habitus_betas, bpy.types.Object.habitus_take
