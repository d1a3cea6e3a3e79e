# SPDX-License-Identifier: GPL-3.0-or-later
"""habitus in Blender: bodies with sliders, pose blend shapes that follow the bones, motions and
their soft tissue.
"""

from pathlib import Path

import bpy
from bpy.app.handlers import persistent
from bpy.props import (
    BoolProperty,
    BoolVectorProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    StringProperty,
)

from .baking import write_fbx
from .core import Motion, read_arrays, whose
from .motions import add_markers, animate, simulate, write_motion
from .person import (
    BETAS,
    SHIPPED,
    TONES,
    add_person,
    body_called,
    body_of,
    by_hand,
    correct,
    fit_measures,
    is_person,
    known,
    snap_to_ground,
    tell,
    wear_skin,
)
from .tailor import NAMES

bl_info = {
    "name": "habitus body",
    "author": "habitus contributors",
    "version": (0, 2, 0),
    "blender": (3, 4, 0),
    "location": "3D View > Sidebar > habitus; File > Import",
    "description": "habitus' bodies: sliders for sex, age, measurements; live pose blend shapes; "
    "motions, soft tissue",
    "category": "Animation",
}
_RANGES = {
    "height": (1.0, 2.1),
    "weight": (15.0, 160.0),
    "chest": (0.5, 1.5),
    "waist": (0.4, 1.6),
    "hip": (0.5, 1.6),
    "inseam": (0.4, 1.1),
}


@persistent
def _follow(scene, *_):
    for person in scene.objects:
        if is_person(person) and person.data.shape_keys is not None:
            correct(person)


class _OfPerson:
    """Operators on a habitus body that is selected."""

    @classmethod
    def poll(cls, context):
        """Only for a habitus body."""
        return is_person(context.object)


class _OfFile:
    """Operators that ask for a file."""

    filepath: StringProperty(subtype="FILE_PATH")
    filter_glob: StringProperty(default="*.npz", options={"HIDDEN"})

    def invoke(self, context, _event):
        """Ask for the file."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def refused(self, error):
        """Say why nothing was done."""
        self.report({"ERROR"}, f"{Path(self.filepath).name}: {error}")
        return {"CANCELLED"}


class HABITUS_OT_add(bpy.types.Operator):
    """Add the habitus body."""

    bl_idname, bl_label, bl_options = "habitus.add", "habitus body", {"REGISTER", "UNDO"}
    sex: EnumProperty(items=[(name, name.capitalize(), "") for name in SHIPPED])

    def execute(self, context):
        """Add it."""
        person = add_person(context, self.sex)
        snap_to_ground(context, person)
        context.view_layer.objects.active = person
        return {"FINISHED"}


class HABITUS_OT_body(_OfFile, bpy.types.Operator):
    """Add the body of a file in SMPL's form, as habitus train, save_body and the SMPL family have
    them.
    """

    bl_idname, bl_label, bl_options = (
        "habitus.add_file",
        "Body of a file (.npz)",
        {"REGISTER", "UNDO"},
    )

    def execute(self, context):
        """Add it."""
        path = bpy.path.abspath(self.filepath)
        try:
            model = body_called(path)
        except (OSError, ValueError, KeyError) as error:
            return self.refused(error)
        person = add_person(context, path)
        snap_to_ground(context, person)
        context.view_layer.objects.active = person
        if model.num_betas > BETAS:
            self.report({"INFO"}, f"the first {BETAS} of its {model.num_betas} betas have sliders")
        return {"FINISHED"}


class HABITUS_OT_import(_OfFile, bpy.types.Operator):
    """Import a fit's body.npz or another motion: of habitus' bodies, or of the selected body of a
    file.
    """

    bl_idname, bl_label, bl_options = (
        "habitus.import_npz",
        "habitus or AMASS motion (.npz)",
        {"REGISTER", "UNDO"},
    )
    markers: BoolProperty(
        name="Markers", description="Add the fit's markers as empties", default=False
    )

    def execute(self, context):
        """Import it."""
        try:
            arrays = read_arrays(self.filepath)
            name = whose(arrays) or (
                context.object.habitus_file if is_person(context.object) else ""
            )
            if "poses" in arrays and not name:
                message = str(
                    arrays.get(
                        "surface_model_type", arrays.get("body", "a body that it does not name")
                    )
                )
                raise ValueError(
                    f"is of {message}; add that body's file, select it, and import again"
                )
            motion = Motion(self.filepath, arrays, body_called(name or "neutral"))
        except (OSError, ValueError, KeyError) as error:
            return self.refused(error)
        person = add_person(context, name, motion.betas, motion.age)
        animate(context, person, motion)
        if self.markers and add_markers(context, person, arrays) is None:
            self.report({"WARNING"}, "the file holds no markers")
        context.view_layer.objects.active = person
        if motion.missing:
            some = ", ".join(motion.missing[:3])
            self.report(
                {"WARNING"}, f"{len(motion.missing)} joints turn that this body has not: {some}, …"
            )
        if motion.left_out:
            self.report(
                {"INFO"}, "soft tissue was left out; habitus export has it, or simulate it here"
            )
        return {"FINISHED"}


class HABITUS_OT_export(_OfFile, _OfPerson, bpy.types.Operator):
    """Write the scene's frames as an npz under AMASS's names: habitus export makes FBX, USD, glTF,
    BVH of it.
    """

    bl_idname, bl_label = "habitus.export_npz", "habitus motion (.npz)"

    def execute(self, context):
        """Write it."""
        path = str(Path(self.filepath).with_suffix(".npz"))
        try:
            count = write_motion(context, context.object, path)
        except OSError as error:
            return self.refused(error)
        self.report({"INFO"}, f"{count} frames: {path}")
        return {"FINISHED"}


class HABITUS_OT_fbx(_OfFile, _OfPerson, bpy.types.Operator):
    """Write the scene's frames as FBX, with keyed blend shapes in the place of those that follow
    the bones here.
    """

    bl_idname, bl_label = "habitus.export_fbx", "habitus body in motion (.fbx)"
    filter_glob: StringProperty(default="*.fbx", options={"HIDDEN"})

    def execute(self, context):
        """Write it."""
        path = str(Path(self.filepath).with_suffix(".fbx"))
        try:
            count = write_fbx(context, context.object, path)
        except (OSError, RuntimeError) as error:
            return self.refused(error)
        self.report({"INFO"}, f"{count} blend shapes of the pose: {path}")
        return {"FINISHED"}


class HABITUS_OT_tissue(_OfPerson, bpy.types.Operator):
    """Key the soft tissue that the scene's frames shake."""

    bl_idname, bl_label, bl_options = (
        "habitus.soft_tissue",
        "Simulate soft tissue",
        {"REGISTER", "UNDO"},
    )
    strength: FloatProperty(name="Strength", default=1.0, min=0.0, soft_max=3.0)

    def execute(self, context):
        """Key it."""
        try:
            simulate(context, context.object, self.strength)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class HABITUS_OT_ground(_OfPerson, bpy.types.Operator):
    """Move the person so that the lowest point of this frame is on the ground."""

    bl_idname, bl_label, bl_options = "habitus.ground", "Snap to ground", {"REGISTER", "UNDO"}

    def execute(self, context):
        """Move it."""
        snap_to_ground(context, context.object)
        return {"FINISHED"}


class HABITUS_PT_panel(bpy.types.Panel):
    """The person's sliders."""

    bl_label, bl_space_type, bl_region_type, bl_category = "habitus", "VIEW_3D", "UI", "habitus"

    def draw(self, context):
        """Draw them."""
        layout, person = self.layout, context.object
        for operator in ("habitus.add", "habitus.add_file", "habitus.import_npz"):
            layout.operator(operator)
        if not is_person(person):
            return
        for operator in (
            "habitus.ground",
            "habitus.soft_tissue",
            "habitus.export_npz",
            "habitus.export_fbx",
        ):
            layout.operator(operator)
        if not person.habitus_file:
            layout.prop(person, "habitus_sex", text="Sex")
            layout.prop(person, "habitus_age", text="Age (0: adult)")
            layout.prop(person, "habitus_skin", text="Skin")
            for k, name in enumerate(NAMES):
                row = layout.row(align=True)
                row.prop(person, "habitus_known", index=k, text="")
                row.prop(person, f"habitus_{name}", text=name.capitalize())
            if known(person) and person.get("habitus_said"):
                layout.label(text=person["habitus_said"], icon="ERROR")
        for k in range(min(BETAS, body_of(person).num_betas)):
            layout.prop(person, "habitus_betas", index=k, text=f"Shape {k + 1}")


_CLASSES = (
    HABITUS_OT_add,
    HABITUS_OT_body,
    HABITUS_OT_import,
    HABITUS_OT_export,
    HABITUS_OT_fbx,
    HABITUS_OT_tissue,
    HABITUS_OT_ground,
    HABITUS_PT_panel,
)
_HANDLERS = ("frame_change_post", "depsgraph_update_post")


def _import_menu(self, _context):
    self.layout.operator("habitus.import_npz")


def _export_menu(self, _context):
    self.layout.operator("habitus.export_npz")
    self.layout.operator("habitus.export_fbx")


def _properties():
    sexes = [(name, name.capitalize(), "") for name in SHIPPED]
    tones = [(name, name.capitalize(), "") for name in (*TONES, "none")]
    properties = {
        "skin": EnumProperty(name="Skin", items=tones, default="medium", update=wear_skin),
        "file": StringProperty(name="Body's file"),
        "sex": EnumProperty(name="Sex", items=sexes, update=fit_measures),
        "age": FloatProperty(name="Age", min=0.0, max=90.0, update=fit_measures),
        "betas": FloatVectorProperty(
            name="Shape", size=BETAS, soft_min=-3.0, soft_max=3.0, update=by_hand
        ),
        "known": BoolVectorProperty(name="Known", size=len(NAMES), update=fit_measures),
    }
    for name, (least, most) in _RANGES.items():
        properties[name] = FloatProperty(
            name=name, min=0.1, soft_min=least, soft_max=most, precision=3, update=tell(name)
        )
    return properties


def register():
    """Blender calls this when the add-on is switched on."""
    for name, held in _properties().items():
        setattr(bpy.types.Object, f"habitus_{name}", held)
    for each in _CLASSES:
        bpy.utils.register_class(each)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).append(_follow)


def unregister():
    """Blender calls this when it is switched off."""
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(_follow)
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)
    for name in _properties():
        delattr(bpy.types.Object, f"habitus_{name}")
